# SPDX-License-Identifier: Apache-2.0
"""What a viewer hears of running nodes, as messages for its page. It publishes nothing."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from rlml_slam.cli.support.heard_map import HeardMap
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.evaluation.scan_log import thinned
from rlml_slam.params import Parameters
from rlml_slam.report.viewer import columns
from rlml_slam.report.viewer.columns import Columns, as_lists
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.frame_messages import read_points, read_record
from rlml_slam.ros.codecs.reflector_clouds import read_associated, read_reflector_map
from rlml_slam.ros.message_guard import LARGE, MessageGuard, guard_of, waiting
from rlml_slam.ros.systems.simulator_messages import TRUE_REFLECTORS
from rlml_slam.se2 import wrap
from rlml_slam.types import Frame, Health, Level, Status

HISTORY = 3000  # frames that a page gets when it opens
PATH_POINTS = 3000  # of the optimised path
WAIT = 0.12  # [s] that a frame waits for its scan and its detections
SHARE = 40.0  # of the time that passes, one part is spent on map, path and graph together
SLOWEST = 1.0  # [s] between two looks at the same one of them
# best effort: the publishers never wait for a viewer
QUICK = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)
NEWEST = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass
class _Answer:
    """A frame, when it was heard, and what belongs to it."""

    frame: Frame
    heard: float
    scan: bytes = b''  # serialized: only the newest is shown
    seen: tuple[int, int] | None = None


@dataclass
class _Slow:
    """A topic whose newest message is looked into from time to time."""

    kind: Any
    use: Callable[[Any], Mapping[str, Columns]]
    due: float = 0.0
    was_read: bool = False

    def columns(self, data: bytes) -> Mapping[str, Columns]:
        """What a message shows, as lists."""
        found = self.use(deserialize_message(data, self.kind))
        return {name: as_lists(of) for name, of in found.items()}


class ViewListener:
    """Subscriptions of ``node``, emptied by ``poll``; memory is bounded by HISTORY.

    It needs no executor: messages wait in DDS, which keeps the newest ones.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._guard: MessageGuard = guard_of(node)
        self._start: int | None = None
        self._answers: dict[int, _Answer] = {}
        self._truth: dict[int, bytes] = {}  # serialized: of five poses, one belongs to a frame
        self._reasons: dict[int, str] = {}
        self._rows: deque[Columns] = deque(maxlen=HISTORY)
        self._shown: dict[str, Columns] = {}
        self._due = 0.0  # when there is time again for a slow one
        self._map = HeardMap()
        self._slow = {
            'map': _Slow(OccupancyGridMsg, self._on_grid),
            'trajectory': _Slow(Path, self._on_path),
            'graph': _Slow(MarkerArray, self._on_graph),
            'reflector_map_points': _Slow(PointCloud2, self._on_reflectors),
            TRUE_REFLECTORS: _Slow(PointCloud2, self._on_true_reflectors),
        }
        self._quick: dict[str, tuple[Any, Callable[[bytes], None]]] = {
            'rlml/frames': (PointCloud2, self._on_frame),
            'reflectors/associated': (PointCloud2, self._on_associated),
            'deskewed_points': (PointCloud2, self._on_points),
            'ground_truth': (Odometry, self._on_truth),
            'front_end/health': (DiagnosticStatus, self._on_health),
            'slam/health': (DiagnosticStatus, self._on_health),
        }
        subscribe = node.create_subscription
        self._subscriptions = {
            topic: subscribe(kind, topic, self._ignore, QUICK, raw=True)
            for topic, (kind, _) in self._quick.items()
        }
        self._subscriptions |= {
            topic: subscribe(slow.kind, topic, self._ignore, NEWEST, raw=True)
            for topic, slow in self._slow.items()
        }

    @staticmethod
    def _ignore(data: bytes) -> None:
        """Never called: nobody spins."""

    def poll(self, is_watched: bool = True) -> dict[str, Any] | None:
        """What came since the last call, as a message for the pages; None if nothing did.

        Without anybody who watches, large messages are kept and not looked into.
        """
        for topic, (kind, use) in self._quick.items():
            for data in self._taken(topic, kind, QUICK.depth):
                self._guard.pass_on(topic, partial(use, data))
        now = time.monotonic()
        message = self._complete(now, is_watched)
        replaced = self._look_into_next(now) if is_watched else {}
        if replaced:
            self._shown |= replaced
            message = message or {}
            message['replace'] = replaced
            message['extent'] = self._extent()
        return message

    def snapshot(self) -> dict[str, Any]:
        """All that a page needs that has just been opened."""
        names = columns.SOURCES['frames']
        frames = {c: [v for row in self._rows for v in row[c]] for c in names}
        shown = {**self._shown, 'frames': frames}
        return {'start': True, 'replace': shown, 'extent': self._extent()}

    def _taken(self, topic: str, kind: Any, depth: int) -> list[bytes]:
        """Serialized messages that wait, of a size that can be meant."""
        messages = waiting(self._subscriptions[topic], kind, depth)
        return [data for data in messages if len(data) <= LARGE]

    def _look_into_next(self, began: float) -> Mapping[str, Columns]:
        """What is new of the slow topic that has waited longest, if it is time for one.

        The first message of each is looked into at once.
        """
        may = [t for t, s in self._slow.items() if began >= max(s.due, self._due * s.was_read)]
        if not may:
            return {}
        topic = min(may, key=lambda name: self._slow[name].due)
        slow = self._slow[topic]
        found: Mapping[str, Columns] = {}
        slow.due = began + SLOWEST
        for data in self._taken(topic, slow.kind, NEWEST.depth):
            slow.was_read = True
            found = self._guard.pass_on(topic, partial(slow.columns, data), {})
            self._due = began + SHARE * (time.monotonic() - began)
        return {name: of for name, of in found.items() if of != self._shown.get(name)}

    # --- messages of one frame ---

    def _on_frame(self, data: bytes) -> None:
        frame = read_record(deserialize_message(data, PointCloud2)).of.frame
        self._answers[frame.stamp] = _Answer(frame, time.monotonic())

    def _on_points(self, data: bytes) -> None:
        answer = self._answers.get(decode.serialized_stamp(data))
        if answer is not None:
            answer.scan = data

    def _on_associated(self, data: bytes) -> None:
        associated = read_associated(deserialize_message(data, PointCloud2))
        answer = self._answers.get(associated.detections.stamp)
        if answer is not None:
            used = int(np.sum(associated.statuses == Status.USED))
            answer.seen = (len(associated.statuses), used)

    def _on_truth(self, data: bytes) -> None:
        self._truth[decode.serialized_stamp(data)] = data
        while len(self._truth) > 1000:
            del self._truth[next(iter(self._truth))]

    def _on_health(self, data: bytes) -> None:
        msg = deserialize_message(data, DiagnosticStatus)
        level = msg.level[0] if isinstance(msg.level, bytes) else msg.level
        self._reasons[int(level)] = msg.message if level else ''

    def _complete(self, now: float, is_watched: bool) -> dict[str, Any] | None:
        """The frames that have all that belongs to them, or have waited long enough."""
        log, newest = FrameLog(), None
        for stamp in sorted(self._answers):
            a = self._answers[stamp]
            if now - a.heard < WAIT and not (a.scan and a.seen):
                break
            del self._answers[stamp]
            if self._start is not None and stamp < self._start:
                self._rows.clear()  # another run
                self._start = None
            self._start = stamp if self._start is None else self._start
            f = a.frame
            reason = self._reasons.get(int(f.health.level), '')
            log.add_pose(stamp, f.T_map_base, f.cov_map, Health(
                Level(f.health.level), (reason,) if reason else ()))  # fmt: skip
            log.wall_ms.append(f.wall_ms)
            seen, used = a.seen or (0, 0)
            log.seen.append(seen)
            log.used.append(used)
            newest = a
        if newest is None or self._start is None:
            return None
        made = columns.frames(log, self._start)
        self._guard.pass_on('ground_truth', partial(self._add_errors, made, log))
        rows = as_lists(made)
        self._rows.extend({c: [v[k]] for c, v in rows.items()} for k in range(len(log.stamps)))
        message: dict[str, Any] = {'stream': {'frames': rows}, 'state': ''}
        message['stamp'] = round(1e3 * (time.time() - (now - newest.heard)), 1)
        if newest.scan and is_watched:
            shown = partial(self._scan, newest.scan, rows['t'][-1])
            message['scan'] = self._guard.pass_on('deskewed_points', shown)
        return message

    @staticmethod
    def _scan(data: bytes, t: float) -> Columns:
        points = thinned(read_points(deserialize_message(data, PointCloud2)))
        return {'t': t, 'x': points[:, 0].tolist(), 'y': points[:, 1].tolist()}

    def _add_errors(self, made: Columns, log: FrameLog) -> None:
        """Errors [cm, deg] of the frames whose truth was heard."""
        for k, (stamp, pose) in enumerate(zip(log.stamps, log.poses, strict=True)):
            data = self._truth.get(stamp)
            if data is not None:
                msg = deserialize_message(data, Odometry)
                true = decode.planar_pose(msg.pose.pose, 'ground_truth')
                made['error'][k] = 100.0 * np.hypot(*(pose - true)[:2])
                made['error_theta'][k] = np.degrees(wrap(pose[2] - true[2]))

    # --- messages that are looked into from time to time ---

    def _on_grid(self, msg: Any) -> dict[str, Columns]:
        self._map.use_grid(msg)
        grid = self._map.grid
        return {} if grid is None or not grid.cells.size else {'grid': columns.grid(grid, False)}

    def _on_path(self, msg: Any) -> dict[str, Columns]:
        step = max(1, -(-len(msg.poses) // PATH_POINTS))
        msg.poses = msg.poses[::step]
        self._map.use_path(msg)
        path = self._map.path
        return {'path': columns.path(path.stamps, path.poses, self._start or 0)}

    def _on_graph(self, msg: Any) -> dict[str, Columns]:
        self._map.use_graph(msg)
        keyframes, closures = self._map.keyframes, self._map.closures
        return {
            'keyframes': {'x': keyframes[:, 0], 'y': keyframes[:, 1]},
            'closures': columns.closures(closures),
        }

    def _on_reflectors(self, msg: Any) -> dict[str, Columns]:
        return {'reflectors': columns.reflectors(read_reflector_map(msg))}

    def _on_true_reflectors(self, msg: Any) -> dict[str, Columns]:
        known = decode.detections(msg, Parameters().reflector, TRUE_REFLECTORS)
        x, y = known.points[:, 0], known.points[:, 1]
        return {'true_reflectors': {'x': x, 'y': y, 'name': [str(i) for i in known.ids.tolist()]}}

    def _extent(self) -> list[list[float]]:
        """Corners of the map."""
        known = columns.empty() | self._shown
        low, high = columns.extent(known)
        return [low.tolist(), high.tolist()]
