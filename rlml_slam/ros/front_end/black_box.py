# SPDX-License-Identifier: Apache-2.0
"""The black box: the last minute of inputs and outputs, written when something went wrong."""

from __future__ import annotations

import heapq
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger

from rlml_slam.errors import BagError
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.worker import Worker
from rlml_slam.ros.codecs.decode import serialized_stamp
from rlml_slam.ros.front_end.incident import Published, Received, free_name
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.types import Frame, Level

FOLDER = 'incidents'  # in map_directory
STATIC = 'tf_static'
MAX_STATIC = 100
MB = 1_000_000
SECOND = 1_000_000_000


class Triggers:
    """Says of each frame whether something went wrong with it, once for each episode."""

    def __init__(self, degraded_time: float) -> None:
        self._patience = degraded_time
        self._was_good = False  # the robot was not LOST
        self._was_ok = False  # and has been OK since it was
        self._degraded: float | None = None

    def reason(self, frame: Frame, now: float) -> str:
        """``lost``, ``degraded``, ``jump``, or nothing. ``now`` [s] is of any clock."""
        level, was_good, was_ok = frame.health.level, self._was_good, self._was_ok
        self._was_good = level < Level.LOST
        self._was_ok = level is Level.OK or (was_ok and self._was_good)
        if level is Level.OK:
            self._degraded = None
        elif self._degraded is None:
            self._degraded = now
        if level is Level.LOST:
            return 'lost' if was_good else ''
        if frame.jumped and was_ok:
            return 'jump'
        if self._degraded is not None and now - self._degraded > self._patience:
            self._degraded = float('inf')  # said once
            return 'degraded' if was_good else ''
        return ''


class BlackBox:
    """Keeps what came in the last ``incident.before`` seconds, within ``incident.max_memory``.

    After a trigger it waits ``incident.after`` seconds more, and a thread of its own writes the
    file: no pose waits for it.
    """

    def __init__(
        self, node: Any, params: Parameters, map_id: Callable[[], str] = lambda: ''
    ) -> None:
        self._map_id = map_id
        self._node, self._p, self._logger = node, params, node.get_logger()
        self._i = params.incident
        self._folder = Path(params.node.map_directory).absolute() / FOLDER
        self._received: deque[Received] = deque()
        self._static: deque[Received] = deque(maxlen=MAX_STATIC)
        self._published: deque[Published] = deque()
        self._bytes = 0
        self._fresh = 0  # of the newest received, whose order is not known yet
        self._began = time.time_ns() - time.monotonic_ns()  # later steps of the clock: no matter
        self._triggers = Triggers(self._i.degraded_time)
        self._last = float('-inf')  # [s] of the newest incident
        self._pending: tuple[float, Path, str] | None = None
        self._problem = ''
        guard = guard_of(node)
        self._worker = Worker(lambda error: guard.report('incident', error))
        node.every(1.0, self.write_if_due)
        node.create_service(Trigger, '~/save_incident', self.on_request)
        node.exits.callback(self.close)

    def tap(self, topic: str, kind: type[Any], data: bytes) -> None:
        """A message of a sensor, as it came."""
        if not self._i.record:
            return
        package = kind.__module__.partition('.')[0]
        name = sys.intern(f'{package}/msg/{kind.__name__}')
        received = Received(self._now(), topic, name, bytes(data))
        if topic.endswith(STATIC):
            self._static.append(received)
            return
        self._received.append(received)
        self._fresh += 1
        self._bytes += len(data)
        most, old = self._i.max_memory * MB, self._old()
        while self._received and (self._bytes > most or self._received[0].time < old):
            self._bytes -= len(self._received.popleft().data)

    def arrange(self, topics: Sequence[str]) -> None:
        """What was received since the last call, in the order in which it is used.

        The queues of ``topics`` are emptied one after the other, and after a pause each holds
        seconds; what was in them is used by stamp, and of equal ones by the order of ``topics``.
        """
        count, self._fresh = min(self._fresh, len(self._received)), 0
        if count < 2:
            return
        newest = [self._received.pop() for _ in range(count)][::-1]
        queues: defaultdict[str, list[tuple[int, Received]]] = defaultdict(list)
        for r in newest:
            is_tf = r.kind.endswith('TFMessage')  # its first transform has a header
            queues[r.topic].append((serialized_stamp(r.data, 4 if is_tf else 0), r))
        known = {topic: k for k, topic in enumerate(topics)}
        ordered = sorted(queues, key=lambda topic: known.get(topic, len(known)))
        merged = heapq.merge(*(queues[topic] for topic in ordered), key=lambda item: item[0])
        for came, (_, r) in zip(newest, merged, strict=True):
            self._received.append(replace(r, time=came.time))

    def _now(self) -> int:
        return self._began + time.monotonic_ns()

    def _old(self) -> int:
        after = 0.0 if self._pending is None else self._i.after
        return self._now() - int((self._i.before + after) * SECOND)

    def follow(self, frame: Frame) -> None:
        """A frame that was published."""
        if not self._i.record:
            return
        self._published.append(
            Published(self._now(), frame.stamp, frame.T_map_base, frame.cov_map, frame.health)
        )
        while self._published[0].time < self._old():
            self._published.popleft()
        now = time.monotonic()
        why = self._triggers.reason(frame, now)
        if why and self._pending is None and now - self._last >= self._i.min_period:
            self._begin(why, '; '.join(frame.health.reasons), now)
        self.write_if_due()

    def _begin(self, why: str, reasons: str, now: float) -> Path:
        self._last = now
        path = free_name(self._folder, why)
        self._pending = now + self._i.after, path, reasons
        self._logger.warning(f'incident ({why}): {path} is written in {self._i.after:g} s')
        return path

    def on_request(self, _request: Any, response: Any) -> Any:
        """Write what there is, for a user."""
        why = '' if self._i.record else 'incident.record is false'
        if not self._node.is_active:  # nothing comes, and no timer runs that would write it
            why = 'the node is not active'
        if why:
            response.success, response.message = False, f'nothing is written: {why}'
            return response
        if self._pending is None:
            self._begin('asked', '', time.monotonic())
        assert self._pending is not None
        response.success = True
        response.message = f'{self._pending[1]} is written in {self._i.after:g} s'
        return response

    def write_if_due(self) -> None:
        """Give the incident to the writing thread, once its time has come."""
        if self._pending is None or time.monotonic() < self._pending[0]:
            return
        (_, path, reasons), self._pending = self._pending, None
        n = self._p.node
        about: dict[str, object] = {
            'reasons': reasons, 'mode': n.mode, 'map': n.map_file_name, 'map_id': self._map_id(),
            'written': path.name,
        }  # fmt: skip
        parts = list(self._static), list(self._received), list(self._published), self._p
        self._worker.submit(lambda: self._save(path, about, *parts))

    def _save(self, path: Path, *parts: Any) -> None:
        try:
            from rlml_slam.ros.front_end import incident_file

            incident_file.write(path, *parts)
            incident_file.make_room(path.parent, self._i.max_disk * MB)
            self._problem = ''
            self._logger.warning(f'incident: {path}, {path.stat().st_size / MB:.1f} MB')
        except (ImportError, BagError, OSError) as e:
            self._problem = f'incident not written: {e}'
            self._logger.warning(self._problem)

    def problems(self) -> tuple[str, ...]:
        """Why the newest incident could not be written."""
        return (self._problem,) if self._problem else ()

    def close(self) -> None:
        """Write what is pending now; then end the thread."""
        if self._pending is not None:
            self._pending = float('-inf'), *self._pending[1:]
            self.write_if_due()
        self._worker.submit(lambda: None).result()
        self._worker.close()
