# SPDX-License-Identifier: Apache-2.0
"""What a replay estimated, beside its inputs, as messages that viewers show: one MCAP file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rlml_slam import se2
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.errors import BagError, InputError, MapError
from rlml_slam.evaluation.metrics import RunErrors
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.graph_markers import graph_markers
from rlml_slam.ros.codecs.markers import detection_markers, reflector_markers
from rlml_slam.ros.codecs.message_types import bag_types
from rlml_slam.ros.codecs.message_types import make_bag as make
from rlml_slam.ros.codecs.reflector_clouds import build_associated, build_reflector_map
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Frame, Health, Level, Verdict

MARKERS, CLOUD = 'visualization_msgs/msg/MarkerArray', 'sensor_msgs/msg/PointCloud2'
FLOAT, PLACES = 'std_msgs/msg/Float64', 'geometry_msgs/msg/PoseArray'
LATCHED = {
    '/map': 'nav_msgs/msg/OccupancyGrid',
    '/reflector_map': MARKERS,
    '/reflector_map_points': CLOUD,
    '/graph': MARKERS,
    '/tf_static': 'tf2_msgs/msg/TFMessage',
}
TOPICS = {
    **LATCHED,
    '/tf': 'tf2_msgs/msg/TFMessage',
    '/pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/reflectors/statuses': MARKERS,
    '/reflectors/associated': CLOUD,
    '/front_end/health': 'diagnostic_msgs/msg/DiagnosticStatus',
    '/search/places': PLACES,
    '/search/verdict': 'diagnostic_msgs/msg/DiagnosticStatus',
    '/rosout': 'rcl_interfaces/msg/Log',
}
FIRST, GROWTH = 16, 1.25  # frames before a picture of the map: all cost 5 times the last one
LOG_LEVEL = {Level.OK: 20, Level.DEGRADED: 30, Level.LOST: 40}  # of rcl_interfaces/msg/Log


class EstimateBag:
    """Writes a replay to ``writer``; two replays of one bag give the same bytes.

    Messages have the log time of the input that caused them. ``/tf`` holds the recorded
    transforms, map to odom as estimated and, where the bag lacks it, odom to base of the
    odometry. Times of computing are left out.
    """

    def __init__(self, writer: BagWriter, inputs: BagInputs) -> None:
        self._writer, self._inputs, self._n = writer, inputs, inputs.params.node
        for topic, kind in TOPICS.items():
            self._writer.add_topic(topic, kind, latched=topic in LATCHED)
        self._times: list[int] = []  # of the frames
        self._drawn_at = float(FIRST)
        self._updates, self._logs, self._searches = 0, 0, 0
        self._health = Health()
        self._placed: set[str] = set()
        self._last: tuple[int, Frame] | None = None
        self._has_odometry = inputs.has_odometry_on_tf or 'odom' in inputs.topics

    # --- inputs ----------------------------------------------------------------------------------

    def copy(self, path: str | Path) -> None:
        """The inputs, from the bag opened once more: the replay counts what cannot be read."""
        copies = [self._copy_inputs, self._copy_transforms]
        if self._has_odometry and not self._inputs.has_odometry_on_tf:
            copies.append(self._copy_odometry)
        with BagReader(path) as bag:
            for copy in copies:
                with contextlib.suppress(BagError):  # damaged: what comes before
                    copy(bag)

    def _copy_inputs(self, bag: BagReader) -> None:
        """Those of standard types, but for one that has the name of an estimate."""
        known = bag_types().fielddefs
        kinds = {t: bag.topics[t].msgtype for t in self._inputs.shown()}
        kinds = {t: k for t, k in kinds.items() if k in known and TOPICS.get(t, k) == k}
        for topic, kind in kinds.items():
            self._writer.add_topic(topic, kind, bag.is_latched(topic))
        for time, topic, data in bag.serialized(kinds):
            self._writer.write_serialized(topic, data, time)

    def _copy_transforms(self, bag: BagReader) -> None:
        """The recorded transforms, without those that would give odom or base two parents."""
        base, odom = decode.frame(self._n.base_frame), decode.frame(self._n.odom_frame)
        ours = {odom} if self._inputs.has_odometry_on_tf else {odom, base}
        if not self._inputs.tf:
            return
        for time, _, message in bag.messages([self._inputs.tf]):
            kept = [t for t in message.transforms if decode.frame(t.child_frame_id) not in ours]
            if kept:
                self._writer.write('/tf', encode.tf_message(make, kept), time)

    def _copy_odometry(self, bag: BagReader) -> None:
        """Odom to base as a transform."""
        frames, topic = (self._n.odom_frame, self._n.base_frame), self._inputs.topics['odom']
        for time, _, message in bag.messages([topic]):
            with contextlib.suppress(InputError):  # the replay counts it
                T = decode.planar_pose(message.pose.pose, topic)
                moved = encode.transform(make, decode.stamp(message, topic), frames, T)
                self._writer.write('/tf', encode.tf_message(make, [moved]), time)

    # --- estimates -------------------------------------------------------------------------------

    def add(self, time: int, frames: Iterable[Frame], slam: Slam | EkfSlam) -> None:
        """The frames that an input of this log time gave, and what the map became by them."""
        for frame in frames:
            self._add_frame(time, frame)
            self._last = time, frame
        if isinstance(slam, Slam):
            self._add_events(time, slam)
        if len(self._times) >= self._drawn_at and self._last is not None:
            self._draw(slam)
            self._drawn_at = GROWTH * len(self._times)

    def finish(self, slam: Slam | EkfSlam, errors: RunErrors | None) -> None:
        """The final map, and the errors of the live poses where truth is known."""
        if self._last is not None:
            self._draw(slam)
        if errors is None:
            return
        live = errors.live
        rows = zip(live.indices, live.distances, live.errors[:, 2], errors.nees, strict=True)
        for k, distance, heading, nees in rows:
            self._number('error/position', distance, self._times[k])
            self._number('error/heading', heading, self._times[k])
            self._number('error/nees', nees, self._times[k])

    def _add_frame(self, time: int, frame: Frame) -> None:
        n, write, seen = self._n, self._writer.write, frame.observation.detections
        self._times.append(time)
        pose = encode.pose_with_covariance(
            make, frame.stamp, n.map_frame, frame.T_map_base, frame.cov_map
        )
        write('/pose', pose, time)
        self._locate(time, frame)
        self._place_laser(time, frame)
        if seen is not None:
            points, frame_id = seen.points, n.base_frame
            colored = detection_markers(make, frame.stamp, frame_id, points, frame.statuses)
            write('/reflectors/statuses', colored, time)
            write('/reflectors/associated', build_associated(make, frame, frame_id), time)
        self._add_health(time, frame)

    def _locate(self, time: int, frame: Frame) -> None:
        """Map to odom; in a bag without odometry map to base."""
        n, T, odom = self._n, frame.T_map_base, frame.observation.odom_pose
        frames = (n.map_frame, n.base_frame)
        if self._has_odometry:
            if odom is None:  # a gap: the last one holds
                return
            T, frames = se2.compose(T, se2.inverse(odom)), (n.map_frame, n.odom_frame)
        placed = encode.transform(make, frame.stamp, frames, T)
        self._writer.write('/tf', encode.tf_message(make, [placed]), time)

    def _place_laser(self, time: int, frame: Frame) -> None:
        """A laser that the bag does not place: where the parameters place it."""
        scan, T = frame.observation.scan, frame.observation.T_base_laser
        if scan is None or T is None or scan.frame_id in self._placed:
            return
        self._placed.add(scan.frame_id)
        base = decode.frame(self._n.base_frame)
        if not self._inputs.extrinsics.hangs(base, scan.frame_id):
            frames = (self._n.base_frame, scan.frame_id)
            static = encode.tf_message(make, [encode.transform(make, frame.stamp, frames, T)])
            self._writer.write('/tf_static', static, time)

    def _add_health(self, time: int, frame: Frame) -> None:
        sigma = np.sqrt(np.maximum(np.diag(frame.cov_map), 0.0))
        used = int(np.sum(frame.statuses == 0))
        values = {
            'sigma_x': f'{sigma[0]:.4f}', 'sigma_y': f'{sigma[1]:.4f}',
            'sigma_yaw': f'{sigma[2]:.5f}', 'reflectors_seen': len(frame.statuses),
            'reflectors_used': used, 'scan_used': frame.scan_used,
            'scan_score': f'{frame.scan_score:.3f}', 'jumped': frame.jumped,
        }  # fmt: skip
        status = encode.diagnostic_status(make, 'front_end', frame.health, values)
        status.level = int(frame.health.level)  # a byte is a number in bags
        self._writer.write('/front_end/health', status, time)
        self._number('sigma/position', float(np.hypot(sigma[0], sigma[1])), time)
        self._number('sigma/heading', float(sigma[2]), time)
        self._number('health', float(frame.health.level), time)
        if frame.health != self._health:
            self._health = frame.health
            text = '; '.join(frame.health.reasons) or 'healthy'
            level = frame.health.level
            self._log(time, frame.stamp, LOG_LEVEL[level], f'{level.name}: {text}')

    def _add_events(self, time: int, slam: Slam) -> None:
        """Closures and what the conductor says, as lines of the log."""
        stamp = time if self._last is None else self._last[1].stamp
        for update in slam.updates[self._updates :]:
            for state, closures in (('found', update.closures), ('changed', update.changed)):
                for c in closures:
                    if c.accepted:
                        text = f'loop closure {c.i} to {c.j} {state}'
                        self._log(time, stamp, LOG_LEVEL[Level.OK], text)
        for log in slam.logs[self._logs :]:
            self._log(time, stamp, 20 + 10 * int(log.severity), log.text)
        for found in slam.searched[self._searches :]:
            self._add_search(time, stamp, found)
        self._updates, self._logs = len(slam.updates), len(slam.logs)
        self._searches = len(slam.searched)

    def _add_search(self, time: int, stamp: int, found: Relocation) -> None:
        """The verdict of a search, and the places that fit: the best one first."""
        places = [*found.rivals] if found.pose is None else [found.pose, *found.rivals]
        shown = make(
            PLACES, header=encode.header(make, stamp, self._n.map_frame),
            poses=[encode.pose(make, T) for T in places],
        )  # fmt: skip
        self._writer.write('/search/places', shown, time)
        is_unique = found.verdict is Verdict.UNIQUE
        health = Health(Level.OK if is_unique else Level.DEGRADED, (found.why,))
        values = {
            'verdict': found.verdict.value, 'score': f'{found.score:.3f}',
            'second': f'{found.second:.3f}', 'places': len(places),
        }  # fmt: skip
        status = encode.diagnostic_status(make, 'search', health, values)
        status.level = int(health.level)  # a byte is a number in bags
        self._writer.write('/search/verdict', status, time)
        text = f'search: {found.verdict.value}: {found.why}'
        self._log(time, stamp, LOG_LEVEL[health.level], text)

    def _draw(self, slam: Slam | EkfSlam) -> None:
        """The map as it is now."""
        assert self._last is not None
        (time, frame), n, write = self._last, self._n, self._writer.write
        with contextlib.suppress(MapError):  # too large to be drawn: the replay reports it
            grid = slam.occupancy_grid()
            if grid is not None:
                write('/map', encode.occupancy_grid(make, frame.stamp, n.map_frame, grid), time)
        reflectors = slam.reflectors()
        markers = reflector_markers(make, frame.stamp, n.map_frame, reflectors)
        write('/reflector_map', markers, time)
        cloud = build_reflector_map(make, frame.stamp, n.map_frame, reflectors)
        write('/reflector_map_points', cloud, time)
        if isinstance(slam, Slam) and slam.system.map is None:
            graph = graph_markers(make, frame.stamp, n.map_frame, slam.back_end.graph)
            write('/graph', graph, time)

    def _number(self, name: str, value: float, time: int) -> None:
        self._writer.write(f'/estimate/{name}', make(FLOAT, data=float(value)), time)

    def _log(self, time: int, stamp: int, level: int, text: str) -> None:
        line = make(
            'rcl_interfaces/msg/Log', stamp=encode.time(make, stamp), level=level,
            name='rlml', msg=text, file='', function='', line=0,
        )  # fmt: skip
        self._writer.write('/rosout', line, time)
