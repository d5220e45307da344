# SPDX-License-Identifier: Apache-2.0
"""How well a keyframe is known by the ways that lead to it, each taken by itself.

The graph takes the errors of its edges for independent, and so averages out over a long way what
wheels err by for as long, and over many closures what these have in common. The front end's joint
state knows what lasts, but no loop that scans have closed. Its covariance is that of the way
driven; a closure brings another one, by the place that was seen again. What errors the two share
nobody knows, so they are fused by covariance intersection (Julier, Uhlmann 1997), which is right
whatever these are.

What a way grows by between two keyframes is taken to be what the front end's covariance does. It
is less where a lasting error cancels, out and back by one way, and more where it adds to itself:
a bound that is often near, and never the only one (:func:`correction.either`).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np

from rlml_slam.estimation.correction import Correction, ReferencePose, carried, positive, turned
from rlml_slam.graph.model.factor_table import FactorTable
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.keyframes import Keyframe

WEIGHTS = np.linspace(0.0, 1.0, 11)  # of one of two that are fused; the best of these is as good


class PathCovariance:
    """Covariances (3, 3) of keyframes in the map, each in the axes of its own pose.

    They are kept for keyframes at which a way other than the one driven came in. From the one
    before and the one after, they grow as the front end's does.
    """

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._known: list[ReferencePose] = []  # at these, as if the local frame were the map
        self._begun: list[int] = []
        self._num = 0  # closures below this number are in it

    def cov(self, key: Keyframe) -> Array:
        """That of a keyframe."""
        k = bisect_right(self._stamps, key.stamp)
        known = self._known[k - 1] if k else None
        _, cov = Correction(np.zeros(3), known).apply(key.T_local, key.cov_local)
        if k < len(self._stamps) and self._stamps[k] not in self._begun:
            later = self._known[k]
            way = later.pose[:2] - key.T_local[:2]
            grown = positive(later.cov_local - carried(key.cov_local, way))
            cov = intersection(cov, carried(later.cov_map + grown, -way))
        return turned(cov, -key.T_local[2])

    @property
    def newest(self) -> int:
        """Stamp of the last keyframe at which another way came in, -1 before the first."""
        return self._stamps[-1] if self._stamps else -1

    def begin(self, key: Keyframe) -> None:
        """No way leads to a keyframe: the front end says how well it found its place."""
        self._begun.append(key.stamp)
        self._enter(key, turned(key.cov_local, -key.T_local[2]))

    def close(
        self, closures: ClosureRecords, keys: Sequence[Keyframe], edges: FactorTable
    ) -> None:
        """Take in what is new of all closures; ``keys`` are the keyframes, by index."""
        fresh = [c for c in closures.accepted(self._num) if edges.enabled[c.edge]]
        for c in sorted(fresh, key=lambda c: c.number):
            self._num = c.number + 1
            T = edges.measured[c.edge]
            across = turned(carried(self.cov(keys[c.i]), T[:2]), -T[2])
            across += np.linalg.inv(edges.information[c.edge])
            self._enter(keys[c.j], intersection(self.cov(keys[c.j]), across))

    def forget(self) -> None:
        """Other closures are right than were: those that are come in anew."""
        at = [self._stamps.index(stamp) for stamp in self._begun]
        self._stamps, self._known = list(self._begun), [self._known[k] for k in at]
        self._num = 0

    def keep(self, keys: Sequence[Keyframe]) -> None:
        """Let go of what tells nothing of the keyframes that are left, however long it goes on.

        One of these is told of by the last entry up to it, and by the first one after it.
        """
        stamps = sorted(key.stamp for key in keys)
        self._begun = [self._begun[k] for k in _ends(stamps, self._begun)]
        begun = [self._stamps.index(stamp) for stamp in self._begun]
        kept = sorted({*_ends(stamps, self._stamps), *begun})
        self._stamps = [self._stamps[k] for k in kept]
        self._known = [self._known[k] for k in kept]

    def _enter(self, key: Keyframe, cov: Array) -> None:
        known = ReferencePose(key.T_local, key.cov_local, turned(cov, key.T_local[2]))
        k = bisect_right(self._stamps, key.stamp)
        self._stamps.insert(k, key.stamp)
        self._known.insert(k, known)


def _ends(stamps: Sequence[int], entries: Sequence[int]) -> list[int]:
    """Of the ``entries`` between each two neighbours of ``stamps``, the first one and the last.

    Both ascend; an entry at one of the ``stamps`` is before it.
    """
    gap = [bisect_left(stamps, entry) for entry in entries]
    last = len(entries) - 1
    return [
        k for k, g in enumerate(gap) if k in (0, last) or g != gap[k - 1] or g != gap[k + 1]
    ]  # fmt: skip


def held(sightings: FactorTable, pose: int, until: int) -> bool:
    """Whether reflectors seen at a pose of the graph hold it: two, in all three directions.

    Poses before it, up to ``until``, have to have seen these as well, else they tie it to nothing
    else. What they tell does not pass through the wheels, so no way by these need be asked then.
    """
    until = min(until, pose - 1)
    poses, landmarks = sightings.nodes[sightings.enabled].T
    return len(np.intersect1d(landmarks[poses == pose], landmarks[poses <= until])) >= 2


def intersection(P: Array, Q: Array) -> Array:
    """(w P^-1 + (1 - w) Q^-1)^-1 of covariances (3, 3), with the w for which it is smallest."""
    # P may be singular, that of the pose where all began
    if np.linalg.det(P) <= 0.0:
        return P
    A, B = np.linalg.inv(P), np.linalg.inv(Q)
    mixed = WEIGHTS[:, None, None] * A + (1.0 - WEIGHTS)[:, None, None] * B
    best: Array = mixed[int(np.argmax(np.linalg.det(mixed)))]
    return np.asarray(np.linalg.inv(best))
