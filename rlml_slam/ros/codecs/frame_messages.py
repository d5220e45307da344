# SPDX-License-Identifier: Apache-2.0
"""A front end's frame on its way to the back end, as clouds that RViz shows as well.

``rlml/frames`` has one point, the local pose, whose fields are all figures of the frame, exactly.
``deskewed_points`` are the end points of its scan, ``reflectors/associated`` its detections, both
in the base frame. The back end sees no sensor: it works on what the front end saw.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.decode import covariances, stamp
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import bounded, build_cloud, read_table
from rlml_slam.ros.codecs.reflector_clouds import Associated
from rlml_slam.se2 import Array
from rlml_slam.slam.conversation import SessionFrame
from rlml_slam.slam.front_end.submaps import FAR
from rlml_slam.types import Frame, Health, Level, Motion, Observation

LEAST_VARIANCE = 1e-18  # [rad^2/s^2] of a bias
MAX_BEHIND = 20  # frames that may overtake one whose points or detections are still on their way

# x, y, z for RViz; odom_pose is NaN without odometry; the health's reasons are on /diagnostics
RECORD = np.dtype(
    [
        ('x', '<f4'), ('y', '<f4'), ('z', '<f4'),
        ('session', '<u4'), ('request', '<u4'), ('mode', '<u4'),
        ('has_points', 'u1'), ('has_detections', 'u1'),
        ('T_local_base', '<f8', (3,)), ('cov_local', '<f8', (9,)),
        ('T_map_base', '<f8', (3,)), ('cov_map', '<f8', (9,)),
        ('odom_pose', '<f8', (3,)), ('origin', '<f8', (2,)),
        ('delta', '<f8', (3,)), ('cov', '<f8', (9,)), ('known', 'u1'),
        ('bias_gain', '<f8', (3,)), ('bias', '<f8'), ('bias_var', '<f8'),
        ('level', 'u1'), ('scan_score', '<f8'), ('scan_used', 'u1'), ('chi2', '<f8'),
        ('unconfirmed', 'u1'), ('jumped', 'u1'),
        ('iterations', '<i4'), ('wall_ms', '<f8'),
    ]
)  # fmt: skip
# single precision for RViz; `exact` is what the front end has
POINT = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('exact', '<f8', (2,))])
_FRAME = ('T_local_base', 'cov_local', 'T_map_base', 'cov_map')
_FIGURES = ('scan_score', 'scan_used', 'unconfirmed', 'jumped', 'chi2', 'iterations', 'wall_ms')
_MOTION = ('delta', 'cov', 'known', 'bias_gain', 'bias', 'bias_var')


@dataclass(frozen=True)
class Record:
    """A frame without its points and detections, and which of the two it has."""

    of: SessionFrame
    has_points: bool
    has_detections: bool


def build_record(make: Make, record: SessionFrame, local_frame: str) -> Any:
    """PointCloud2 of one point with every figure of the frame."""
    frame = record.frame
    observation = frame.observation
    r = np.zeros(1, dtype=RECORD)
    r['x'], r['y'] = frame.T_local_base[:2]
    r['session'], r['request'], r['mode'] = record.session, record.request, record.mode
    r['has_points'] = observation.points is not None
    r['has_detections'] = observation.detections is not None
    r['odom_pose'] = np.nan if observation.odom_pose is None else observation.odom_pose
    r['origin'] = np.nan if observation.origin is None else observation.origin
    r['level'] = int(frame.health.level)
    for names, source in ((_FRAME, frame), (_FIGURES, frame), (_MOTION, observation.motion)):
        for name in names:
            r[name] = np.reshape(getattr(source, name), r[name].shape)
    return build_cloud(make, encode.header(make, frame.stamp, local_frame), r)


def read_record(msg: Any, topic: str = 'rlml/frames') -> Record:
    """The inverse of build_record; InputError if it is another kind of cloud."""
    r, time = read_table(msg, RECORD, topic, one=True)[0], stamp(msg, topic)
    for name in ('T_local_base', 'T_map_base', 'delta', 'bias_gain', 'bias'):
        bounded(r[name], f'{topic}: {name}')
    for name in ('cov_local', 'cov_map', 'cov'):
        covariances(r[name].reshape(3, 3), f'{topic}: {name}')
    for name in ('odom_pose', 'origin'):
        bounded(np.nan_to_num(r[name]), f'{topic}: {name}')
    if not r['bias_var'] >= LEAST_VARIANCE:  # infinite without an IMU
        raise InputError(f'{topic}: bias_var {r["bias_var"]} is no variance')
    if r['level'] > max(Level):
        raise InputError(f'{topic}: {r["level"]} is no level of health')

    def array(name: str) -> Array:
        value = np.array(r[name], dtype=np.float64)
        return value.reshape(3, 3) if value.size == 9 else value

    motion = Motion(
        array('delta'), array('cov'), bool(r['known']), array('bias_gain'), float(r['bias']),
        float(r['bias_var']),
    )  # fmt: skip
    odom_pose = None if np.isnan(r['odom_pose']).any() else array('odom_pose')
    origin = None if np.isnan(r['origin']).any() else array('origin')
    none = np.zeros(0, dtype=np.int64)
    frame = Frame(
        time, Observation(time, motion, origin=origin, odom_pose=odom_pose),
        array('T_local_base'), array('cov_local'), array('T_map_base'), array('cov_map'),
        none, none,
        health=Health(Level(int(r['level']))),
        scan_score=float(r['scan_score']),
        scan_used=bool(r['scan_used']),
        unconfirmed=bool(r['unconfirmed']),
        jumped=bool(r['jumped']),
        chi2=float(r['chi2']),
        iterations=int(r['iterations']),
        wall_ms=float(r['wall_ms']),
    )  # fmt: skip
    of = SessionFrame(int(r['session']), frame, int(r['request']), int(r['mode']))
    return Record(of, bool(r['has_points']), bool(r['has_detections']))


def build_points(make: Make, time: int, base_frame: str, points: Array) -> Any:
    """PointCloud2 of points (n, 2)."""
    cloud = np.zeros(len(points), dtype=POINT)
    cloud['x'], cloud['y'], cloud['exact'] = points[:, 0], points[:, 1], points
    return build_cloud(make, encode.header(make, time, base_frame), cloud)


def read_points(msg: Any, topic: str = 'deskewed_points') -> Array:
    """Points (n, 2)."""
    points: Array = read_table(msg, POINT, topic)['exact'].astype(np.float64)
    bounded(points, f'{topic}: a point', FAR)
    return points


class FrameAssembler:
    """Records, points and detections of one stamp become frames again, in the records' order.

    ``incomplete`` counts frames whose points or detections did not come.
    """

    def __init__(self) -> None:
        self._records: deque[Record] = deque()
        self._points: dict[int, Array] = {}
        self._associated: dict[int, Associated] = {}
        self.incomplete = 0

    def add_points(self, time: int, points: Array) -> list[SessionFrame]:
        """End points of a scan."""
        _put(self._points, time, points)
        return self._complete()

    def add_associated(self, associated: Associated) -> list[SessionFrame]:
        """Detections with their landmarks."""
        _put(self._associated, associated.detections.stamp, associated)
        return self._complete()

    def add_record(self, record: Record) -> list[SessionFrame]:
        """A frame without its points and detections; returns records whose frames are whole."""
        self._records.append(record)
        return self._complete()

    def _complete(self) -> list[SessionFrame]:
        out = []
        while self._records:
            head, time = self._records[0], self._records[0].of.frame.stamp
            whole = (not head.has_points or time in self._points) and (
                not head.has_detections or time in self._associated
            )
            if not whole and len(self._records) <= MAX_BEHIND:
                break
            self.incomplete += not whole
            self._records.popleft()
            points, seen = self._points.get(time), self._associated.get(time)
            self._forget(time)
            out.append(replace(head.of, frame=_whole(head.of.frame, points, seen)))
        return out

    def _forget(self, time: int) -> None:
        """What belongs to this frame or an earlier one; later stamps may be another session's."""
        parts: tuple[dict[int, Any], ...] = (self._points, self._associated)
        for of in parts:
            for old in [t for t in of if t <= time]:
                del of[old]


def _put(parts: dict[int, Any], time: int, part: Any) -> None:
    """Keep a part; the oldest goes where no record comes for them."""
    parts[time] = part
    if len(parts) > 2 * MAX_BEHIND:
        del parts[next(iter(parts))]


def _whole(frame: Frame, points: Array | None, seen: Associated | None) -> Frame:
    detections = None if seen is None else seen.detections
    observation = replace(frame.observation, points=points, detections=detections)
    if seen is None:
        return replace(frame, observation=observation)
    return replace(
        frame, observation=observation, landmarks=seen.landmarks, statuses=seen.statuses
    )
