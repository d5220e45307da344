# SPDX-License-Identifier: Apache-2.0
"""What deformable_slam hears of the carrier and says of it, beside the robot's own sensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.deformable.suggest import suggest_twist
from rlml_slam.deformable.window import CarrierVelocity, Features, WindowEstimate
from rlml_slam.errors import InputError
from rlml_slam.params import DeformableParameters, Node
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.decode import FASTEST, frame, stamp
from rlml_slam.ros.codecs.markers import reflector_markers
from rlml_slam.ros.codecs.message_types import Make, make_rclpy, rclpy_class
from rlml_slam.ros.codecs.point_cloud import bounded, build_cloud
from rlml_slam.types import Reflectors

# z = 0 for RViz; key is never reused, id is the feature's own or -1
FEATURE = np.dtype(
    [
        ('x', '<f4'), ('y', '<f4'), ('z', '<f4'),
        ('cov_xx', '<f4'), ('cov_xy', '<f4'), ('cov_yy', '<f4'), ('key', '<i4'), ('id', '<i4'),
    ]
)  # fmt: skip
TOPICS = {
    'pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'features': 'sensor_msgs/msg/PointCloud2',
    'markers': 'visualization_msgs/msg/MarkerArray',
}
SUGGESTED = 'cmd_vel_suggested'


def read_velocity(
    msg: Any, params: Node, topic: str = 'carrier_velocity'
) -> tuple[int, CarrierVelocity, bool]:
    """TwistStamped: stamp, velocity, and whether it is in the robot's axes instead of the map's.

    An empty frame is the map. InputError for another one, or a velocity that is not finite.
    """
    axes = frame(msg.header.frame_id)
    if axes not in ('', params.map_frame, params.base_frame):
        raise InputError(
            f'{topic}: header.frame_id is {axes!r}, neither {params.map_frame!r} nor '
            f'{params.base_frame!r}'
        )
    linear = np.array([msg.twist.linear.x, msg.twist.linear.y], dtype=np.float64)
    angular = float(msg.twist.angular.z)
    bounded([*linear, angular], f'{topic}: twist', FASTEST)
    return stamp(msg, topic), CarrierVelocity(linear, angular), axes == params.base_frame


def build_features(make: Make, time: int, map_frame: str, features: Features) -> Any:
    """PointCloud2 of the features with their covariances."""
    cloud = np.zeros(len(features.keys), dtype=FEATURE)
    cloud['x'], cloud['y'] = features.points[:, 0], features.points[:, 1]
    cloud['cov_xx'], cloud['cov_xy'] = features.cov[:, 0, 0], features.cov[:, 0, 1]
    cloud['cov_yy'] = features.cov[:, 1, 1]
    cloud['key'], cloud['id'] = features.keys, features.ids
    return build_cloud(make, encode.header(make, time, map_frame), cloud)


class EstimatePublisher:
    """Publishes estimates, stamped as the detections; markers only where somebody looks."""

    def __init__(self, node: Any, params: DeformableParameters) -> None:
        self._p = params
        topics = dict(TOPICS)
        if params.deformable.suggest != 'off':
            topics[SUGGESTED] = 'geometry_msgs/msg/Twist'
        self._publishers = {
            topic: node.create_publisher(rclpy_class(kind), topic, 10)
            for topic, kind in topics.items()
        }

    def publish(self, estimate: WindowEstimate, velocity: CarrierVelocity) -> None:
        """Send everything of one estimate; ``velocity`` is the carrier's newest."""
        make, time, map_frame = make_rclpy, estimate.stamp, self._p.node.map_frame
        say = self._publishers
        say['pose'].publish(
            encode.pose_with_covariance(make, time, map_frame, estimate.pose, estimate.cov)
        )
        say['features'].publish(build_features(make, time, map_frame, estimate.features))
        if say['markers'].get_subscription_count():
            drawn = _as_reflectors(estimate.features)
            say['markers'].publish(reflector_markers(make, time, map_frame, drawn))
        if SUGGESTED in say:
            twist = suggest_twist(estimate, velocity, self._p)
            if twist is not None:
                say[SUGGESTED].publish(encode.velocity(make, twist))


def _as_reflectors(features: Features) -> Reflectors:
    n = len(features.keys)
    return Reflectors(
        features.keys, features.points, features.cov, features.ids,
        np.zeros(n, dtype=np.int64), np.full(n, np.nan),
    )  # fmt: skip
