# SPDX-License-Identifier: Apache-2.0
"""Which reflector is it? Several answers are kept until the evidence is in (Reid 1979).

What the front end could not match for sure it keeps apart under a key of its own. Here each such
key is either one of the known reflectors or one that was not known before; every consistent set
of answers is a hypothesis with its own filter (:mod:`hypothesis_filter`) and weight, and each
later sighting of any reflector speaks for some and against others.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.matching.reflectors import hypothesis_filter
from rlml_slam.matching.reflectors.hypothesis_filter import POSE
from rlml_slam.se2 import Array

MAX_HYPOTHESES = 64
MEMORY = 2e7  # values of all covariances: with very many reflectors there are fewer hypotheses
LEAD = 14.0  # of log weight over a hypothesis that is given up: it is right once in e^14 = 1e6
GATE = 30.0  # squared distance beyond which a reflector is no answer: e^-15 = 3e-7 of the true
UNKNOWN = 0.05  # share of the first sightings that are of a reflector not yet mapped
OUTLIER = math.log(0.02 / 50.0)  # 2 % of sightings are of nothing, anywhere within 50 m²
TOGETHER = -3.0  # log prior that two keys in view at one time are one reflector after all


@dataclass(frozen=True)
class Sight:
    """One key seen at z (2,) with covariance R (2, 2) in the frame of the present pose."""

    key: int
    z: Array
    R: Array


class MultiHypothesis:
    """Weighted answers; seeded with a pose, known reflectors and their joint covariance."""

    def __init__(
        self, pose: Array, keys: NDArray[np.int64], points: Array, cov: Array, density: float
    ) -> None:
        """Begin with one hypothesis.

        ``pose`` (3,), ``points`` (m, 2) of the reflectors ``keys`` (m,), ``cov``
        (3 + 2m, 3 + 2m) of both, in map axes; ``density`` [1/m²] of unmapped reflectors.
        """
        n = POSE + 2 * len(points)
        M = hypothesis_filter.to_invariant(pose, points)
        self._x = np.concatenate([pose, points.ravel()])[None]
        self._P = (M @ cov @ M.T)[None]
        self._sizes = np.array([n])
        self._weights = np.zeros(1)  # logarithms
        self._column = {int(k): j for j, k in enumerate(keys)}  # of all keys seen so far
        self._labels = np.arange(len(keys))[None]  # (K, keys) reflector of each key
        self._log_new = math.log(UNKNOWN * density)
        self._pending: set[int] = set()

    def __len__(self) -> int:
        return len(self._sizes)

    def __contains__(self, key: int) -> bool:
        return key in self._column

    @property
    def pending(self) -> frozenset[int]:
        """Keys that may still be one thing or another."""
        return frozenset(self._pending)

    def move(self, delta: Array, cov: Array) -> None:
        """The robot moved by ``delta`` (3,) with covariance (3, 3), in the frame it was in."""
        hypothesis_filter.predict(self._x, self._P, self._sizes, delta, cov)

    def see(self, sights: Collection[Sight]) -> None:
        """What is in view from the present pose; known keys first, they say where that is."""
        now = {s.key for s in sights}
        for sight in sorted(sights, key=lambda s: s.key not in self._column):
            if sight.key in self._column:
                self._update(sight)
            else:
                self._branch(sight, now & self._column.keys())
        self._prune()

    def answers(self, sure: float) -> dict[int, int]:
        """Pending keys whose answer has at least the probability ``sure``: key to earlier key.

        A key that is a reflector of its own is its own answer. Hypotheses that say otherwise
        are given up, and the keys are no longer pending.
        """
        found: dict[int, int] = {}
        keys = list(self._column)
        for key in sorted(self._pending, key=self._column.__getitem__):
            at = self._column[key]
            weights = np.exp(self._weights - self._weights.max())
            weights /= weights.sum()
            # (K, at + 1): the same as each earlier key, or as none
            same = self._labels[:, :at] == self._labels[:, at : at + 1]
            options = np.concatenate([same, ~same.any(axis=1, keepdims=True)], axis=1)
            odds = weights @ options
            best = int(np.argmax(odds))
            if odds[best] >= sure:
                found[key] = keys[best]
                self._pending.discard(key)
                self._keep(np.flatnonzero(options[:, best]))
        return found

    def _update(self, sight: Sight) -> None:
        labels = np.ascontiguousarray(self._labels[:, self._column[sight.key]])
        self._weights += hypothesis_filter.update(
            self._x, self._P, self._sizes, labels, sight.z, sight.R, OUTLIER
        )

    def _branch(self, sight: Sight, together: set[int]) -> None:
        """Every hypothesis splits into: it is this one, or that one, or a new one."""
        density, d2 = hypothesis_filter.rate(self._x, self._P, self._sizes, sight.z, sight.R)
        taken = self._labels[:, [self._column[k] for k in together]]
        for h in range(len(self)):
            density[h, taken[h]] += TOGETHER
        density[d2 > GATE] = -np.inf
        options = np.concatenate([density, np.full((len(self), 1), self._log_new)], axis=1)
        options += self._weights[:, None]
        flat = np.argsort(-options, axis=None, kind='stable')[: self._most()]
        flat = flat[options.ravel()[flat] > options.max() - LEAD]
        parent, label = np.divmod(flat, options.shape[1])
        new = label == options.shape[1] - 1
        label = np.where(new, (self._sizes[parent] - POSE) // 2, label)
        weights = options.ravel()[flat]
        self._keep(parent)
        self._weights = weights
        self._column[sight.key] = self._labels.shape[1]
        self._labels = np.concatenate([self._labels, label[:, None]], axis=1)
        if new.any():
            self._make_room()
        for h in np.flatnonzero(new).tolist():
            hypothesis_filter.augment(
                self._x[h], self._P[h], int(self._sizes[h]), sight.z, sight.R
            )
            self._sizes[h] += 2
        used = np.where(new, -1, label)
        # the weight has this sighting's density already
        hypothesis_filter.update(self._x, self._P, self._sizes, used, sight.z, sight.R, -np.inf)
        self._pending.add(sight.key)

    def _make_room(self) -> None:
        """One more reflector fits into every hypothesis."""
        if self._x.shape[1] >= self._sizes.max() + 2:
            return
        k, n = self._x.shape
        x, P = np.zeros((k, n + 8)), np.zeros((k, n + 8, n + 8))
        x[:, :n], P[:, :n, :n] = self._x, self._P
        self._x, self._P = x, P

    def _most(self) -> int:
        return int(np.clip(MEMORY / self._x.shape[1] ** 2, 2, MAX_HYPOTHESES))

    def _prune(self) -> None:
        alive = np.flatnonzero(self._weights > self._weights.max() - LEAD)
        self._keep(alive[np.argsort(-self._weights[alive], kind='stable')][: self._most()])

    def _keep(self, which: NDArray[np.int64]) -> None:
        if len(which) == len(self) and bool((which == np.arange(len(self))).all()):
            return
        for name in ('_x', '_P', '_sizes', '_weights', '_labels'):
            setattr(self, name, getattr(self, name)[which])
        self._weights -= self._weights.max()
