# SPDX-License-Identifier: Apache-2.0
"""The carrier's nominal velocity over time, as it was announced."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np

from rlml_slam.deformable.window import CarrierVelocity

MAX_KEPT = 10_000  # announcements: more than a minute of silence of everything else at 100 Hz


class VelocityHistory:
    """Each velocity holds from its stamp to the next one's; the first one held before it as well.

    Announcements may come in any order. What no later ``mean`` can ask for is forgotten. One is
    not relied upon more than ``timeout`` seconds after its stamp or before it.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = int(timeout * 1e9)
        self._stamps: list[int] = []
        self._velocities: list[CarrierVelocity] = []
        self._latest: int | None = None  # stamp of the one that came last

    def add(self, stamp: int, velocity: CarrierVelocity) -> None:
        """The velocity from ``stamp`` [ns] on; another one for the same stamp replaces it."""
        self._latest = stamp
        k = bisect_left(self._stamps, stamp)
        if k < len(self._stamps) and self._stamps[k] == stamp:
            self._velocities[k] = velocity
            return
        self._stamps.insert(k, stamp)
        self._velocities.insert(k, velocity)
        self._forget(len(self._stamps) - MAX_KEPT)

    def age(self, stamp: int) -> float | None:
        """How long the velocity of ``stamp`` has held [s], 0 before the first, None without."""
        if not self._stamps:
            return None
        return max(stamp - self._stamps[self._at(stamp)], 0) * 1e-9

    def lead(self, stamp: int) -> float:
        """By how much the velocity that came last is stamped after ``stamp`` [s], 0 without."""
        return 0.0 if self._latest is None else (self._latest - stamp) * 1e-9

    def mean(self, start: int, end: int) -> CarrierVelocity:
        """Mean velocity from ``start`` to ``end`` > start [ns]; 0 where none was announced.

        Its sigma is the speed itself for the share of the time beyond the timeout: the carrier may
        have stopped, or go another way. Times before ``start`` must not be asked for afterwards.
        """
        if not self._stamps:
            return CarrierVelocity(np.zeros(2))
        first, last = self._at(start), self._at(end)
        cuts = np.array([start, *self._stamps[first + 1 : last + 1], end], dtype=np.int64)
        share = np.diff(cuts) / (end - start)
        held = self._velocities[first : last + 1]
        linear = share @ np.stack([v.linear for v in held])
        base_linear = share @ np.stack([v.base_linear for v in held])
        angular = float(share @ np.array([v.angular for v in held]))
        stamps = np.array(self._stamps[first : last + 1])
        late = np.maximum(cuts[1:] - np.maximum(cuts[:-1], stamps + self._timeout), 0)
        early = np.maximum(np.minimum(cuts[1:], stamps - self._timeout) - cuts[:-1], 0)
        speed = np.array([np.hypot(*(v.linear + v.base_linear)) for v in held])
        sigma = float((late + early) / (end - start) @ speed)
        self._forget(first)
        return CarrierVelocity(linear, angular, sigma, base_linear)

    def _at(self, stamp: int) -> int:
        return max(bisect_right(self._stamps, stamp) - 1, 0)

    def _forget(self, count: int) -> None:
        if count > 0:
            del self._stamps[:count], self._velocities[:count]
