# SPDX-License-Identifier: Apache-2.0
"""Core types become messages, through a ``Make`` of rclpy or of rosbags (see messages.py)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import build_cloud
from rlml_slam.se2 import Array
from rlml_slam.types import Detections, Health, Imu, Level, Scan

_PLANAR = np.array([0, 1, 5])  # x, y, yaw among ROS's x, y, z, roll, pitch, yaw


def time(make: Make, stamp: int) -> Any:
    """Time of a stamp [ns]."""
    sec, nanosec = divmod(int(stamp), 1_000_000_000)
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def header(make: Make, stamp: int, frame_id: str) -> Any:
    """Header of a stamp [ns] and a frame."""
    return make('std_msgs/msg/Header', stamp=time(make, stamp), frame_id=frame_id)


def clock(make: Make, stamp: int) -> Any:
    """Clock."""
    return make('rosgraph_msgs/msg/Clock', clock=time(make, stamp))


def vector(make: Make, x: float, y: float, z: float, kind: str = 'Vector3') -> Any:
    """Vector3 or Point."""
    return make(f'geometry_msgs/msg/{kind}', x=float(x), y=float(y), z=float(z))


def quaternion(make: Make, yaw: float) -> Any:
    """Rotation by yaw [rad] about z."""
    return make(
        'geometry_msgs/msg/Quaternion',
        x=0.0, y=0.0, z=float(np.sin(0.5 * yaw)), w=float(np.cos(0.5 * yaw)),
    )  # fmt: skip


def pose(make: Make, T: Array) -> Any:
    """Pose of T (3,)."""
    return make(
        'geometry_msgs/msg/Pose',
        position=vector(make, T[0], T[1], 0.0, 'Point'),
        orientation=quaternion(make, T[2]),
    )


def velocity(make: Make, twist: Array) -> Any:
    """Twist of (vx, vy, yaw rate)."""
    return make(
        'geometry_msgs/msg/Twist',
        linear=vector(make, twist[0], twist[1], 0.0),
        angular=vector(make, 0.0, 0.0, twist[2]),
    )


def covariance(cov: Array) -> Array:
    """ROS's (36,) of a planar (3, 3)."""
    full = np.zeros((6, 6))
    full[np.ix_(_PLANAR, _PLANAR)] = cov
    return full.reshape(-1)


def pose_with_covariance(make: Make, stamp: int, frame_id: str, T: Array, cov: Array) -> Any:
    """PoseWithCovarianceStamped."""
    return make(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header(make, stamp, frame_id),
        pose=_pose_cov(make, T, cov),
    )


def _pose_cov(make: Make, T: Array, cov: Array) -> Any:
    return make(
        'geometry_msgs/msg/PoseWithCovariance', pose=pose(make, T), covariance=covariance(cov)
    )


def odometry(
    make: Make,
    stamp: int,
    frames: tuple[str, str],
    T: Array,
    cov: Array,
    twist: Array | None = None,
    twist_cov: Array | None = None,
) -> Any:
    """Odometry of frames (parent, child); ``twist`` (3,) = (vx, vy, yaw rate) in the child."""
    return make(
        'nav_msgs/msg/Odometry',
        header=header(make, stamp, frames[0]),
        child_frame_id=frames[1],
        pose=_pose_cov(make, T, cov),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=velocity(make, np.zeros(3) if twist is None else twist),
            covariance=covariance(np.zeros((3, 3)) if twist_cov is None else twist_cov),
        ),
    )


def imu(make: Make, sample: Imu, frame_id: str, variance: float = 0.0) -> Any:
    """Imu with a yaw rate alone: orientation and acceleration are marked as not measured."""
    absent, rate = np.zeros(9), np.zeros(9)
    absent[0] = -1.0
    rate[8] = variance
    return make(
        'sensor_msgs/msg/Imu',
        header=header(make, sample.stamp, frame_id),
        orientation=quaternion(make, 0.0),
        orientation_covariance=absent,
        angular_velocity=vector(make, 0.0, 0.0, sample.yaw_rate),
        angular_velocity_covariance=rate,
        linear_acceleration=vector(make, 0.0, 0.0, 0.0),
        linear_acceleration_covariance=absent.copy(),
    )


def laser_scan(make: Make, scan: Scan, scan_time: float = 0.0) -> Any:
    """LaserScan; ``scan_time`` [s] between two scans."""
    last = scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1)
    return make(
        'sensor_msgs/msg/LaserScan',
        header=header(make, scan.stamp, scan.frame_id),
        angle_min=float(scan.angle_min),
        angle_max=float(last),
        angle_increment=float(scan.angle_increment),
        time_increment=float(scan.time_increment),
        scan_time=float(scan_time),
        range_min=float(scan.range_min),
        range_max=float(scan.range_max),
        ranges=np.ascontiguousarray(scan.ranges, dtype=np.float32),
        intensities=np.ascontiguousarray(scan.intensities, dtype=np.float32),
    )


DETECTION = np.dtype(
    [
        ('x', '<f4'), ('y', '<f4'), ('id', '<i4'),
        ('sigma_range', '<f4'), ('sigma_bearing', '<f4'), ('diameter', '<f4'),
    ]
)  # fmt: skip
BRIGHT_DETECTION = np.dtype([*DETECTION.descr, ('intensity', '<f4')])


def detections(make: Make, seen: Detections, intensities: Array | None = None) -> Any:
    """PointCloud2 of reflectors; the sigmas are those of the covariance along and across.

    ``intensities`` (n,), where there are, of their brightest beams.
    """
    r = np.maximum(np.hypot(seen.points[:, 0], seen.points[:, 1]), 1e-9)
    u = seen.points / r[:, None]
    t = np.stack([-u[:, 1], u[:, 0]], -1)
    cloud = np.zeros(len(seen), dtype=DETECTION if intensities is None else BRIGHT_DETECTION)
    if intensities is not None:
        cloud['intensity'] = intensities
    cloud['x'], cloud['y'] = seen.points[:, 0], seen.points[:, 1]
    cloud['id'] = seen.ids
    cloud['sigma_range'] = np.sqrt(np.einsum('ni,nij,nj->n', u, seen.cov, u))
    cloud['sigma_bearing'] = np.sqrt(np.einsum('ni,nij,nj->n', t, seen.cov, t)) / r
    cloud['diameter'] = seen.diameters
    return build_cloud(make, header(make, seen.stamp, seen.frame_id), cloud)


def transform(make: Make, stamp: int, frames: tuple[str, str], T: Array) -> Any:
    """TransformStamped of frames (parent, child)."""
    return make(
        'geometry_msgs/msg/TransformStamped',
        header=header(make, stamp, frames[0]),
        child_frame_id=frames[1],
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=vector(make, T[0], T[1], 0.0),
            rotation=quaternion(make, T[2]),
        ),
    )


def tf_message(make: Make, transforms: Iterable[Any]) -> Any:
    """TFMessage of several TransformStamped."""
    return make('tf2_msgs/msg/TFMessage', transforms=list(transforms))


def map_metadata(make: Make, stamp: int, grid: OccupancyGrid) -> Any:
    """MapMetaData."""
    return make(
        'nav_msgs/msg/MapMetaData',
        map_load_time=time(make, stamp),
        resolution=float(grid.resolution),
        width=int(grid.cells.shape[1]),
        height=int(grid.cells.shape[0]),
        origin=pose(make, grid.T_map_grid),
    )


def occupancy_grid(make: Make, stamp: int, frame_id: str, grid: OccupancyGrid) -> Any:
    """OccupancyGrid, row by row from the lower left corner."""
    return make(
        'nav_msgs/msg/OccupancyGrid',
        header=header(make, stamp, frame_id),
        info=map_metadata(make, stamp, grid),
        data=np.ascontiguousarray(grid.cells, dtype=np.int8).reshape(-1),
    )


def diagnostic_status(make: Make, name: str, health: Health, values: Mapping[str, object]) -> Any:
    """DiagnosticStatus: the level, its reasons and the figures."""
    return make(
        'diagnostic_msgs/msg/DiagnosticStatus',
        level=bytes([int(health.level)]),
        name=name,
        message='; '.join(health.reasons) or Level(health.level).name,
        hardware_id='rlml_slam',
        values=[
            make('diagnostic_msgs/msg/KeyValue', key=key, value=str(value))
            for key, value in values.items()
        ],
    )


def diagnostics(
    make: Make, stamp: int, name: str, health: Health, values: Mapping[str, object]
) -> Any:
    """DiagnosticArray with one status."""
    return make(
        'diagnostic_msgs/msg/DiagnosticArray',
        header=header(make, stamp, ''),
        status=[diagnostic_status(make, name, health, values)],
    )
