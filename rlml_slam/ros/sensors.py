# SPDX-License-Identifier: Apache-2.0
"""The sensors of a live robot: subscriptions that feed a sequencer."""

from __future__ import annotations

import heapq
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.params import Node, Parameters
from rlml_slam.ros.codecs.decode import frame, known_stamp
from rlml_slam.ros.codecs.device_reflectors import as_poses, is_device
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.message_guard import SMALL, Listener, guard_of
from rlml_slam.ros.sensor_input import (
    PLACED,
    STREAMS,
    TF,
    USED_BY,
    SensorInput,
    counted_as,
    placement_problems,
    topics_of,
)
from rlml_slam.ros.tf import TF_MESSAGE, Extrinsics, subscribe_static
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.types import Observation
from rlml_slam.version import __version__

TF_PATIENCE = 1_000_000_000  # [ns] of stamps that a sensor's place on /tf_static is waited for
RELIABLE = QoSProfile(depth=10)
# a pause of the interpreter must not cost a message; and where the machine is too slow, scans are
# lost before the odometry that all later ones need: 2000 are 20 s of a 100 Hz IMU
DEPTH = 200
MOTION_DEPTH = 2000
SENSOR = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
MOTION = QoSProfile(depth=MOTION_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
LONG_AGO = -(1 << 62)  # [ns]: a transform that was waited for
PATIENCE = 5.0  # [s] of the wall clock, after which missing inputs are named in the log
SILENCE = 1.0  # [s] of the wall clock without any message, after which nothing more is waited for
POINT = 64  # bytes of a point in the cloud of a device
MAX_SENSORS = 100  # whose frames are remembered
REFUSED = ('',)  # in the place of what a message would have given
# the back end says with it that it runs, so that a front end notices where it does not
LEASE = 1.0  # [s]
ALIVE = QoSProfile(
    depth=50,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=LEASE),
)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Sensors:
    """Feeds the messages of the streams to a Synchronizer and its observations to ``handle``.

    Where the clock jumps back by more than the buffer holds, ``restart(False)`` is called and a
    new sequencer begins. At the start, scans and detections wait, in order, until /tf_static has
    where one of their sensors is, but no longer than TF_PATIENCE: then a sensor without a
    transform is taken to sit at ``laser_pose``, one for each topic; where its transform comes
    after all, a map begins again, by ``restart(True)``. Later, a message in another frame without
    transform is refused, and holds up nothing. Where all inputs fall silent, what still waits for
    odometry is used as it is.
    """

    def __init__(
        self,
        node: Any,
        params: Parameters,
        streams: Iterable[str],
        handle: Callable[[Observation], None],
        restart: Callable[[bool], None],
    ) -> None:
        self._logger = node.get_logger()
        self._p = params
        self._node = node
        self._guard = guard_of(node)
        self._handle = lambda o: self._guard.pass_on('observations', lambda: handle(o))
        self._restart = restart
        self._begin(Extrinsics())
        self._has_tf = self._waits = subscribe_static(node, self._feed.extrinsics)
        self._assumed: set[str] = set()  # sensors that are taken to sit at laser_pose
        self._since: dict[str, int] = {}  # stamp at which a sensor without a transform appeared
        self._held: list[tuple[str, Any]] = []
        self._frames: defaultdict[str, set[str]] = defaultdict(set)  # of sensors, by stream
        self._frame_of: dict[str, str] = {}  # of scans, by topic
        self._topics: Counter[str] = Counter()  # by stream
        self._queues: list[tuple[str, Listener]] = []
        self.arrange: Callable[[list[str]], None] = lambda topics: None  # of what was taken
        self._heard, self._began = time.monotonic(), 0.0  # the latter of being active
        for stream in streams:
            # without scan matching, a scan still asks for a pose at its stamp
            if getattr(params.node, USED_BY[stream]) or stream == 'scan':
                for topic in topics_of(params.node, stream):
                    self._listen(node, stream, topic, STREAMS[stream][1])
        if self._has_tf and not params.node.provide_odom_frame:  # else it is our own
            self._listen(node, TF, '/tf', TF_MESSAGE)
        inputs = ', '.join(f'{s} on {q.topic_name}' for s, q in self._queues)
        self._logger.info(f'rlml_slam {__version__}, {params.node.mode}: waits for {inputs}')
        self._came: set[str] = set()
        self._missing = [k for k, (s, _) in enumerate(self._queues) if s in ('scan', 'odom')]
        node.every(0.25 * SILENCE, self.flush_if_silent)

    def _listen(self, node: Any, stream: str, topic: str, kind: str) -> None:
        found, use = rclpy_class(kind), partial(self.receive, len(self._queues))
        if found is None:
            return  # of a package that is not installed
        self._topics[stream] += 1
        qos = SENSOR if stream in PLACED else MOTION
        listener = Listener(node, found, topic, use, qos, largest(self._p.node, stream))
        self._queues.append((stream, listener))

    def _begin(self, extrinsics: Extrinsics) -> None:
        self.synchronizer = Synchronizer(self._p)
        self._feed = SensorInput(self._p, self.synchronizer, self.synchronizer.inputs)
        self._feed.use_extrinsics(extrinsics)

    @property
    def extrinsics(self) -> Extrinsics:
        """Where the sensors sit, as far as /tf_static has them."""
        return self._feed.extrinsics

    def hangs(self, sensor: str) -> bool:
        """Whether a sensor hangs upside down."""
        return self._feed.hangs(sensor)

    def receive(self, index: int, msg: Any) -> None:
        """One message of a queue, and all that have arrived in the others as well, by stamp.

        The executor serves the queues in turn. After a pause, scans would overtake the odometry
        that is more frequent and lies in the queue beside theirs.
        """
        if self._node.is_active:
            self._take({index: self._plain(*self._queues[index], msg)})

    def _take(self, first: dict[int, list[tuple[str, Any]]]) -> int:
        """Use all that has arrived, ``first`` of each queue before the rest; how many.

        Odometry shows that scans before it are complete. It is taken from its queue before them,
        so that a scan that comes between the two takes is not found to be late.
        """
        queues = {k: first.get(k, []) + self._taken(k) for k in reversed(range(len(self._queues)))}
        self.arrange([listener.topic_name for _, listener in self._queues])
        self._missing = [k for k in self._missing if not queues[k]]
        ordered, path = (queues[k] for k in range(len(self._queues))), self._feed.tf.path
        items = list(heapq.merge(*ordered, key=lambda item: _stamp(item[1], path)))
        self.synchronizer.expect((_stamp(msg, path) for _, msg in items), time.monotonic())
        for item in items:
            self.add(*item)
        return len(items)

    def flush_if_silent(self) -> None:
        """Where nothing has come for a while: a pose for the scan that waits for odometry."""
        self._began = self._began or time.monotonic()
        self._tell_of_missing()
        if self._take({}) or time.monotonic() - self._heard < SILENCE:
            return
        for observation in self.synchronizer.flush():
            self._handle(observation)

    def problems(self) -> tuple[str, ...]:
        """Sensors in an assumed place, and those that several nodes publish where one is meant."""
        out = placement_problems(self._p.node, self._assumed, self._frame_of)
        for stream, listener in self._queues:
            if stream not in (*PLACED, TF):
                found = self._node.publishers_of(listener.topic_name)
                if len(found) > 1:
                    out.append(f'{stream} has {len(found)} publishers: {", ".join(found)}')
        return (*out, *self._feed.odometry_problems())

    def _tell_of_missing(self) -> None:
        """Say once which scans and odometry have never come, PATIENCE after it became active."""
        if time.monotonic() - self._began <= PATIENCE:
            return
        missing, self._missing = [self._queues[k] for k in self._missing], []
        is_on_tf = bool(self._feed.tf.path)
        named = [f'{s} on {q.topic_name}' for s, q in missing if s != 'odom' or not is_on_tf]
        if named:
            kinds = {STREAMS[stream][1]: stream for stream, _ in missing}
            others = _others(self._node, kinds, {q.topic_name for _, q in self._queues})
            self._logger.warning(f'waiting for {", ".join(named)}{others}')

    def _log_refused(self) -> None:
        """Log each reason why inputs of a stream are not used once; /diagnostics count all."""
        errors = self.synchronizer.inputs.new_errors
        while errors:
            stream, error = errors.popleft()
            if self._guard.is_new(stream, error):
                self._logger.warning(f'{stream}: not used: {error}')
        comparison = self.synchronizer.odometry.comparison
        if comparison.differ and self._guard.is_new(TF, 'the odometry topic differs'):
            self._logger.warning(f'the odometry topic and /tf differ: {comparison}')

    def _taken(self, index: int) -> list[tuple[str, Any]]:
        """Everything in a queue, in order of arrival."""
        stream, listener = self._queues[index]
        return [item for msg in listener.drained() for item in self._plain(stream, listener, msg)]

    def _plain(self, stream: str, listener: Listener, msg: Any) -> list[tuple[str, Any]]:
        """The message, of a device as a PoseArray; nothing where it cannot be used."""
        if stream == 'scan':
            self._frame_of[listener.topic_name] = frame(msg.header.frame_id)[:100]
        if not is_device(msg):
            return [(stream, msg)]
        most = self._p.node.max_beams
        plain = self._guard.pass_on(stream, lambda: as_poses(msg, most), REFUSED)
        return [] if plain is REFUSED else [(stream, plain)]

    def add(self, stream: str, msg: Any) -> None:
        """One message of a stream."""
        self._heard = time.monotonic()
        if stream not in self._came:
            self._came.add(stream)
            self._logger.info(f'first {stream}{_place(msg)}')
        if stream not in PLACED or not _stamp(msg):  # a stamp that is refused
            self._use(stream, msg)
            return
        if not self._waits:
            self._use_placed(stream, msg)
            return
        self._held.append((stream, msg))
        unknown = {frame(m.header.frame_id) for _, m in self._held if not self._is_placed(m)}
        late = not 0 <= _stamp(msg) - _stamp(self._held[0][1]) <= TF_PATIENCE
        late = late or len(self._held) >= DEPTH
        for stream, held in self._held:
            if self._is_placed(held):  # takes precedence over a frame that came before it
                self._frames[stream].add(frame(held.header.frame_id))
        if not late and not self._frames:
            return
        for sensor in unknown if late else ():
            self._since.setdefault(sensor, LONG_AGO)
        self._release()

    def stop_waiting(self) -> None:
        """Wait for no transform on /tf_static."""
        self._has_tf = False
        self._release()

    def _release(self) -> None:
        self._waits = False
        held, self._held = self._held, []
        for item in held:
            self._use_placed(*item)

    def _use_placed(self, stream: str, msg: Any) -> None:
        """A message of a sensor, refused where nobody says where it sits."""
        sensor, seen = frame(msg.header.frame_id), self._frames[stream]
        if self._has_tf and sensor not in seen and not self._is_placed(msg):
            why = f'no transform from {self._p.node.base_frame} to {sensor[:100]!r} on /tf_static'
            if len(seen) >= self._topics[stream] or self._may_come(sensor, _stamp(msg)):
                self._count_invalid(stream, f'{stream}: {why}')
                return
            self._logger.warning(f'{why}: laser_pose is used: {list(self._p.node.laser_pose)}')
            self._assumed.add(sensor)
        if sensor in self._assumed and self._is_placed(msg):
            self._assumed.discard(sensor)
            if _sits_elsewhere(self._feed, self._p.node, sensor):
                why = f'{stream}: the place of {sensor!r} is on /tf_static only now'
                self._start_again(why, misplaced=True)
        if len(seen) < MAX_SENSORS:
            seen.add(sensor)
        self._use(stream, msg)

    def _may_come(self, sensor: str, stamp: int) -> bool:
        """Whether the transform of a sensor that has just appeared is still waited for."""
        if sensor not in self._since and len(self._since) >= MAX_SENSORS:
            return True
        return stamp - self._since.setdefault(sensor, stamp) <= TF_PATIENCE

    def _count_invalid(self, stream: str, why: str) -> None:
        self.synchronizer.inputs.count(counted_as(stream), 'invalid', why)
        self._log_refused()

    def _is_placed(self, msg: Any) -> bool:
        try:
            return self._feed.is_placed(msg)
        except InputError:  # not planar: the feed refuses and counts it
            return True

    def _use(self, stream: str, msg: Any) -> None:
        # whatever a message does to the code costs that message alone
        use = self._guard.pass_on(stream, partial(self._observe, stream, msg), REFUSED)
        if use is REFUSED:
            self._count_invalid(stream, self._guard.last)

    def _start_again(self, why: str, misplaced: bool = False) -> None:
        self._logger.warning(f'{why}: the front end starts again')
        self._begin(self.extrinsics)
        self._restart(misplaced)

    def _observe(self, stream: str, msg: Any) -> None:
        try:
            observations = self._feed.add(stream, msg)
        except InputError as e:
            self._start_again(str(e))
            return
        self._log_refused()
        for observation in observations:
            self._handle(observation)


def _others(node: Any, kinds: dict[str, str], known: set[str]) -> str:
    """Other topics of types (by which: their stream), but for the node's own, in words."""
    own = f'{node.get_fully_qualified_name()}/'
    found = [
        f'{topic} ({kinds[t]})'
        for topic, types in sorted(node.get_topic_names_and_types())
        for t in types
        if t in kinds and topic not in known and not topic.startswith(own)
    ]
    return f'; of these types there are {", ".join(found[:8])}' if found else ''


def _sits_elsewhere(feed: SensorInput[Any], n: Any, sensor: str) -> bool:
    """Whether a map was begun with another place of a sensor than that of /tf_static.

    A saved map shows by itself where the robot is.
    """
    try:
        pose = feed.extrinsics.pose(n.base_frame, sensor)
    except InputError:  # not planar: the feed refuses and counts its messages
        return False
    is_near = pose is not None and np.abs(se2.between(np.array(n.laser_pose), pose)).max() < 1e-3
    return n.mode == 'mapping' and not (is_near and feed.hangs(sensor) == n.laser_upside_down)


def _place(msg: Any) -> str:
    """The frame of a message, in words; nothing for transforms."""
    header = getattr(msg, 'header', None)
    return '' if header is None else f', in frame {frame(header.frame_id)[:100]!r}'


def largest(params: Node, stream: str) -> int:
    """Bytes that a message of a stream may have."""
    has_beams = stream in ('scan', 'reflector_beams')
    most = params.max_beams if has_beams else params.max_reflectors
    room = most * (STREAMS[stream][3] if stream in STREAMS else 0)
    # a cloud may be a whole scan, in which a bit says what is a reflector
    return SMALL + max(room, params.max_beams * POINT if stream == 'reflectors' else 0)


def input_figures(synchronizer: Synchronizer) -> dict[str, object]:
    """Figures for /diagnostics: what became of the inputs, and where odometry comes from."""
    inputs, odometry = synchronizer.inputs, synchronizer.odometry
    out: dict[str, object] = {
        f'{stream} {what}': n
        for stream, counts in inputs.totals().items()
        for what, n in counts.items()
    }
    if inputs.last_error:
        out['last refused input'] = inputs.last_error
    if odometry.source:
        out['odometry is read from'] = '/tf' if odometry.source == TF else 'its topic'
    if synchronizer.delay.now:
        out['odometry is stamped'] = str(synchronizer.delay)
    apart = str(odometry.comparison)
    if apart:
        out['odometry topic against /tf'] = apart
    detected = str(synchronizer.reflectors)
    if detected:
        out['reflectors in the intensities of scans'] = detected
    return out


def _stamp(msg: Any, path: tuple[str, ...] = ()) -> int:
    """The stamp of a message, of one of /tf that of its odometry; 0 without one to believe."""
    if hasattr(msg, 'transforms'):
        msg = next((t for t in msg.transforms if frame(t.child_frame_id) in path), None)
    return 0 if msg is None else known_stamp(msg)
