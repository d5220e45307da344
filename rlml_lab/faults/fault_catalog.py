# SPDX-License-Identifier: Apache-2.0
"""Faults of odometry, laser and reflector detector, put into the messages of a recording.

Each is a function of the messages in order of arrival and a generator; the same seed gives the
same fault. Windows come every ``period`` seconds, the first at a phase that the seed chooses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.faults.recording import Message
from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Detections, Odometry, Scan

SECOND = 1_000_000_000
PERIOD = 60.0  # [s] between two windows of a fault
Messages = list[Message]
Fault = Callable[[Messages, np.random.Generator], Messages]


class Windows:
    """The windows [phase + k period, + length) of a recording, k = 0, 1, …; ``index`` of each."""

    def __init__(
        self, messages: Messages, rng: np.random.Generator, length: float, period: float = PERIOD
    ) -> None:
        start = min(m.stamp for m in messages)
        self._period, self._length = int(period * SECOND), int(length * SECOND)
        # the map needs a beginning: the first window is in the second half of the first period
        self._first = start + int((0.5 + 0.5 * rng.random()) * self._period)

    def index(self, stamp: int) -> int | None:
        """The number of the window that a stamp [ns] is in, None outside of all."""
        if stamp < self._first:
            return None
        k, into = divmod(stamp - self._first, self._period)
        return int(k) if into < self._length else None

    def begins(self, end: int) -> range:
        """Stamps [ns] at which windows begin, until ``end``."""
        return range(self._first, end, self._period)

    def count(self, stamp: int) -> int:
        """The number of windows that began until a stamp [ns]."""
        return max(0, (stamp - self._first) // self._period + 1)


def none(messages: Messages, _: np.random.Generator) -> Messages:
    """No fault."""
    return messages


def cut(length: float) -> Fault:
    """All messages of ``length`` [s] are missing; odometry goes on across the gap."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        windows = Windows(messages, rng, length)
        return [m for m in messages if windows.index(m.stamp) is None]

    return apply


def stall(length: float, catches_up: bool, period: float = PERIOD) -> Fault:
    """Odometry repeats its pose for ``length`` [s]; then all of it comes in one step, or never."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        windows, held = Windows(messages, rng, length, period), None
        lost = np.zeros(3)  # T of the odometry that is reported in that of the wheels
        out: Messages = []
        pose = np.zeros(3)
        for m in messages:
            if isinstance(m, Odometry):
                if windows.index(m.stamp) is not None:
                    held = pose if held is None else held
                    m = replace(m, pose=held)
                else:
                    if held is not None and not catches_up:
                        lost = se2.compose(held, se2.inverse(np.asarray(m.pose)))
                    held = None
                    m = replace(m, pose=se2.compose(lost, m.pose))
                pose = m.pose
            out.append(m)
        return out

    return apply


def reset(messages: Messages, rng: np.random.Generator) -> Messages:
    """Odometry begins at zero once in a period."""
    windows, last, begin = Windows(messages, rng, 0.0), 0, np.zeros(3)
    out: Messages = []
    for m in messages:
        if isinstance(m, Odometry):
            if windows.count(m.stamp) != last:
                last, begin = windows.count(m.stamp), np.asarray(m.pose)
            m = replace(m, pose=se2.between(begin, m.pose))
        out.append(m)
    return out


def _increments(messages: Messages, changed: Callable[[int, Array], Array]) -> Messages:
    """Odometry whose steps (3,), in the base frame, are ``changed`` at their stamps."""
    before: Array | None = None
    pose = np.zeros(3)
    out: Messages = []
    for m in messages:
        if isinstance(m, Odometry):
            at = np.asarray(m.pose)
            pose = (
                at
                if before is None
                else se2.compose(pose, changed(m.stamp, se2.between(before, at)))
            )
            before, m = at, replace(m, pose=pose)
        out.append(m)
    return out


def scale(speed: float, turn: float) -> Fault:
    """Odometry whose travel and turn are multiplied."""
    factor = np.array([speed, speed, turn])
    return lambda messages, _: _increments(messages, lambda _, step: step * factor)


def slip(length: float, speed: float, turn: float) -> Fault:
    """In windows, wheels slip: travel is multiplied by ``speed``, ``turn`` [rad/m] is added."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        windows = Windows(messages, rng, length)

        def changed(stamp: int, step: Array) -> Array:
            if windows.index(stamp) is None:
                return step
            return step * (speed, speed, 1.0) + (0.0, 0.0, turn * math.hypot(step[0], step[1]))

        return _increments(messages, changed)

    return apply


def late(delay: float) -> Fault:
    """Odometry is stamped ``delay`` [s] after it was measured."""

    def apply(messages: Messages, _: np.random.Generator) -> Messages:
        shift = int(delay * SECOND)
        moved = [
            (m.stamp + shift, replace(m, stamp=m.stamp + shift))
            if isinstance(m, Odometry)
            else (m.stamp, m)
            for m in messages
        ]
        return [m for _, m in sorted(moved, key=lambda pair: pair[0])]

    return apply


def jitter(sigma: float) -> Fault:
    """Stamps of all scans and of odometry have white noise of ``sigma`` [s]."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        out: Messages = []
        for m in messages:
            error = int(sigma * SECOND * rng.standard_normal())
            out.append(replace(m, stamp=m.stamp + error))
        return out

    return apply


def decimate(rate: float) -> Fault:
    """At most ``rate`` scans a second, detections with them."""

    def apply(messages: Messages, _: np.random.Generator) -> Messages:
        kept: dict[type, int] = {}
        out: Messages = []
        for m in messages:
            if isinstance(m, Scan | Detections):
                if m.stamp - kept.get(type(m), -(2**62)) < SECOND / rate - SECOND // 1000:
                    continue
                kept[type(m)] = m.stamp
            out.append(m)
        return out

    return apply


def _scans(messages: Messages, changed: Callable[[Scan], NDArray[Any]]) -> Messages:
    """Scans with the ranges (n,) that ``changed`` gives."""
    return [
        replace(m, ranges=changed(m).astype(np.float32)) if isinstance(m, Scan) else m
        for m in messages
    ]


def frozen(length: float) -> Fault:
    """In windows, the laser sends its last scan again and again with new stamps."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        windows = Windows(messages, rng, length)
        last: dict[str, NDArray[np.float32]] = {}

        def changed(scan: Scan) -> NDArray[Any]:
            if windows.index(scan.stamp) is None:
                last[scan.frame_id] = scan.ranges
            return last.get(scan.frame_id, scan.ranges)

        return _scans(messages, changed)

    return apply


def dirt(share: float) -> Fault:
    """The same ``share`` of the beams has no return all the time."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        seed = int(rng.integers(2**31))

        def changed(scan: Scan) -> NDArray[Any]:
            n = len(scan.ranges)
            dirty = np.random.default_rng(seed).random(n) < share
            return np.where(dirty, np.float32(np.nan), scan.ranges)

        return _scans(messages, changed)

    return apply


def view(width: float) -> Fault:
    """The laser sees ``width`` [rad] ahead of it; all other beams have no return."""

    def changed(scan: Scan) -> NDArray[Any]:
        angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        return np.where(np.abs(se2.wrap(angles)) <= 0.5 * width, scan.ranges, np.nan)

    return lambda messages, _: _scans(messages, changed)


def every(step: int) -> Fault:
    """The laser has the beams 0, ``step``, … alone."""

    def apply(messages: Messages, _: np.random.Generator) -> Messages:
        return [
            replace(
                m,
                angle_increment=m.angle_increment * step,
                time_increment=m.time_increment * step,
                ranges=m.ranges[::step],
                intensities=m.intensities[::step],
            )
            if isinstance(m, Scan)
            else m
            for m in messages
        ]

    return apply


def reach(most: float) -> Fault:
    """What is more than ``most`` [m] away has no return."""
    return lambda messages, _: _scans(
        messages, lambda scan: np.where(scan.ranges > most, np.inf, scan.ranges)
    )


def blocked(width: float, distance: float) -> Fault:
    """Something sticks to the robot: a sector of ``width`` [rad] sees it at ``distance`` [m]."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        at = rng.uniform(-1.0, 1.0)

        def changed(scan: Scan) -> NDArray[Any]:
            angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
            return np.where(np.abs(se2.wrap(angles - at)) < 0.5 * width, distance, scan.ranges)

        return _scans(messages, changed)

    return apply


def people(number: int) -> Fault:
    """People of .4 m walk along with the robot, about it, .8 to 2 m away."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        bearing, swing = rng.uniform(-2.0, 2.0, number), rng.uniform(0.1, 0.6, number)
        near, phase = rng.uniform(0.8, 2.0, number), rng.uniform(0.0, 6.0, number)

        def changed(scan: Scan) -> NDArray[Any]:
            angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
            out, t = scan.ranges.copy(), scan.stamp / SECOND
            for k in range(number):
                at = bearing[k] + swing[k] * math.sin(0.5 * t + phase[k])
                distance = near[k] + 0.2 * math.sin(0.7 * t + phase[k])
                off = distance * np.abs(se2.wrap(angles - at))
                body = distance - np.sqrt(np.maximum(0.2**2 - off**2, 0.0))
                hit = (off < 0.2) & ~(out < body)
                out[hit] = body[hit]
            return out

        return _scans(messages, changed)

    return apply


def bias(offset: float, factor: float) -> Fault:
    """Ranges are ``factor`` times the true ones plus ``offset`` [m]."""
    return lambda messages, _: _scans(messages, lambda s: s.ranges * factor + offset)


def noise(sigma: float) -> Fault:
    """Ranges have further white noise of ``sigma`` [m]."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        return _scans(messages, lambda s: s.ranges + sigma * rng.standard_normal(len(s.ranges)))

    return apply


def _detections(messages: Messages, changed: Callable[[Detections], Detections]) -> Messages:
    return [changed(m) if isinstance(m, Detections) else m for m in messages]


def _chosen(d: Detections, keep: NDArray[np.bool_]) -> Detections:
    return replace(
        d, points=d.points[keep], cov=d.cov[keep], ids=d.ids[keep], diameters=d.diameters[keep]
    )


def misses(share: float) -> Fault:
    """Each reflector is missed with this probability."""
    return lambda messages, rng: _detections(
        messages, lambda d: _chosen(d, rng.random(len(d)) >= share)
    )


def ghosts(number: float) -> Fault:
    """So many false detections per message, anywhere within 15 m."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        def changed(d: Detections) -> Detections:
            n = int(rng.poisson(number))
            r, angle = rng.uniform(0.5, 15.0, n), rng.uniform(-np.pi, np.pi, n)
            points = np.stack([r * np.cos(angle), r * np.sin(angle)], -1)
            return replace(
                d,
                points=np.concatenate([d.points, points]),
                cov=np.concatenate([d.cov, np.tile(0.03**2 * np.eye(2), (n, 1, 1))]),
                ids=np.concatenate([d.ids, np.full(n, ANONYMOUS)]).astype(np.int64),
                diameters=np.concatenate([d.diameters, np.full(n, np.nan)]),
            )

        return _detections(messages, changed)

    return apply


def wrong_ids(share: float) -> Fault:
    """Detections with an id get that of another one with this probability."""

    def apply(messages: Messages, rng: np.random.Generator) -> Messages:
        known = np.unique(np.concatenate([m.ids for m in messages if isinstance(m, Detections)]))
        known = known[known != ANONYMOUS]

        def changed(d: Detections) -> Detections:
            wrong = (rng.random(len(d)) < share) & (d.ids != ANONYMOUS)
            return replace(d, ids=np.where(wrong, rng.choice(known, len(d)), d.ids))

        return _detections(messages, changed) if len(known) else messages

    return apply


FAULTS: Mapping[str, Fault] = {
    'none': none,
    **{f'cut {s:g} s': cut(s) for s in (1.0, 3.0, 10.0, 30.0)},
    **{f'stall {s:g} s, catches up': stall(s, True) for s in (0.3, 0.8, 2.0)},
    **{f'stall {s:g} s, loses it': stall(s, False) for s in (0.3, 0.8, 2.0)},
    'odometry reset': reset,
    'travel +10 %, turn -10 %': scale(1.1, 0.9),
    'slip': slip(2.0, 1.5, 0.5),
    'wheels spin': slip(2.0, 3.0, 0.0),
    'wheels are locked': slip(2.0, 0.2, 0.0),
    **{f'odometry late by {1e3 * s:g} ms': late(s) for s in (0.05, 0.1, 0.2)},
    'stamps jittered by 20 ms': jitter(0.02),
    **{f'scans at {r:g} Hz': decimate(r) for r in (2.0, 1.0)},
    'frozen scans for 3 s': frozen(3.0),
    **{f'{100 * s:g} % of the beams lost': dirt(s) for s in (0.1, 0.3, 0.6)},
    'sector of 60° blocked': blocked(math.radians(60.0), 0.4),
    **{f'view of {d}°': view(math.radians(d)) for d in (120, 90)},
    'every second beam': every(2),
    'every fourth beam': every(4),
    'reach of 4 m': reach(4.0),
    'three people walk along': people(3),
    'range +5 cm': bias(0.05, 1.0),
    'range +1 %': bias(0.0, 1.01),
    'range noise of 1 cm': noise(0.01),
    'reflectors: 50 % missed': misses(0.5),
    'reflectors: 3 ghosts': ghosts(3.0),
    'reflectors: 10 % wrong ids': wrong_ids(0.1),
}


def chosen(words: list[str] | None) -> Iterator[tuple[str, Fault]]:
    """The faults whose name has one of the words, all of them without words; 'none' first."""
    yield 'none', none
    for name, fault in FAULTS.items():
        if name != 'none' and (not words or any(word in name for word in words)):
            yield name, fault
