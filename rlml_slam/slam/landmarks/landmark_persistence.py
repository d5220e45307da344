# SPDX-License-Identifier: Apache-2.0
"""Persistence of mapped reflectors: Bayes filter of whether each one is still present.

A reflector is visible where the scan shows a free line of sight, in a cell of the floor from which
it was detected before. There it is detected with probability p, estimated from its detections and
misses from this cell; at an empty place something is detected with probability q, the density of
ghosts times their area:

    log odds += log(p / q) if it is detected, log((1 - p) / (1 - q)) if not

The log odds stay within those of ``reflector.persistence_threshold`` either way, for anything may
be moved later. p depends on the cell, because a flat reflector, or one behind a corner, is missed
from the same cells again and again. Consecutive misses may have a common cause, such as a person
whom the beams of a coarse scan pass: with probability h a present reflector is hidden for all of
HIDDEN_TIME, so that its misses multiply the odds by h + (1 - h) prod (1 - p) / (1 - q).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph import Graph
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Interval, Keyframe
from rlml_slam.slam.landmarks.landmark import Cell, Landmark
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.slam.landmarks.visibility import expected, sectors

CELL = 0.5  # [m] side of a cell, and travel between two misses that count as independent
NEW_UNTIL = 30  # detections after which it is decided whether a reflector is new
# Not measured: people pass, and what stays for longer is larger than the gaps of a scan.
HIDDEN, HIDDEN_TIME = 0.05, 10_000_000_000  # probability h, and its duration [ns]
PRIOR_COUNT = 2.0  # observations that a cell begins with, one of them a miss (Laplace)


@dataclass
class _Misses:
    """Misses within one HIDDEN_TIME: its begin, the log odds then, and their sum since."""

    since: int
    odds: float
    sum: float = 0.0


class LandmarkPersistence:
    """Compares the visible reflectors with the detected ones after each keyframe."""

    def __init__(self, params: Parameters, graph: Graph, reflectors: ReflectorGraph) -> None:
        p = params.reflector
        self._p = p
        self._muted = sectors(p.muted_sectors)
        self._missing = params.relocalization.missed_share
        self._empty = min(p.unmapped_density * math.pi * p.min_separation**2, 0.5)
        self._graph = graph
        self._reflectors = reflectors
        self._missed_from: dict[int, Array] = {}  # position of the last miss that counted, by key
        self._misses: dict[int, _Misses] = {}

    def update(self, keys: Sequence[Keyframe], interval: Interval) -> tuple[int, ...]:
        """Update with the detections near the newest keyframe; keys of removed reflectors."""
        key = keys[-1]
        key.detector_ran = interval.detector_ran
        alive = self._reflectors.alive()
        if not (alive and self._p.persistence_threshold and interval.detector_ran):
            return ()
        if key.points is None or key.origin is None:
            return ()
        pose = self._graph.poses[key.index]
        places = self._graph.landmarks[[m.index for m in alive]].reshape(-1, 2)
        seen, near = self._seen(alive, se2.transform(se2.inverse(pose), places), interval)
        cell = cell_of(pose)
        known = np.array([cell in m.views for m in alive], dtype=np.bool_)
        missed = known & ~seen & ~near
        if missed.any():
            scan = key.points.astype(np.float64)
            missed &= expected(pose, places, scan, key.origin, math.inf, self._muted)
        # where most are missed, the pose or the detector is wrong
        if seen.sum() < max(1, missed.sum()):
            return ()
        removed = []
        for k in np.flatnonzero(seen | missed).tolist():
            m = alive[k]
            if self._update_odds(m, bool(seen[k]), pose, interval.last_stamp):
                removed.append(m)
            elif seen[k] and not m.history.is_new and m.history.hits < NEW_UNTIL:
                m.history.is_new = self._was_absent(m, keys[:-1])
        for m in removed:
            self._missed_from.pop(m.key, None)
            self._misses.pop(m.key, None)
        return self._reflectors.remove(removed)

    def _seen(
        self, alive: Sequence[Landmark], places: Array, interval: Interval
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which (m,) of ``places`` (m, 2) were detected, and near which something unknown was.

        Places are in the keyframe's frame; detections of other mapped reflectors are known.
        """
        keys = {self._reflectors.resolve(k) for k in interval.sightings}
        seen = np.array([m.key in keys for m in alive], dtype=np.bool_)
        mapped = {m.key for m in alive}
        others = [z for k, z in interval.detected if self._reflectors.resolve(k) not in mapped]
        if not others:
            return seen, np.zeros(len(alive), dtype=np.bool_)
        gap = np.linalg.norm(places[:, None] - np.array(others)[None], axis=-1)
        near: NDArray[np.bool_] = gap.min(axis=1) < 2.0 * self._p.min_separation
        return seen, near

    def _update_odds(self, m: Landmark, is_seen: bool, pose: Array, stamp: int) -> bool:
        """Bayes' rule for one observation; whether the reflector has to be removed."""
        last, cell, history = self._missed_from.get(m.key), cell_of(pose), m.history
        if not is_seen:
            if last is not None and np.hypot(*(pose[:2] - last)) < CELL:
                return False
            self._missed_from[m.key] = pose[:2].copy()
        hits, misses = m.views.get(cell, (0, 0))
        m.views[cell] = (hits + is_seen, misses + (not is_seen))
        history.hits += is_seen
        history.misses += not is_seen
        p, q = (0.5 * PRIOR_COUNT + hits) / (PRIOR_COUNT + hits + misses), self._empty
        limit = math.log((1.0 - self._p.persistence_threshold) / self._p.persistence_threshold)
        if is_seen:
            self._misses.pop(m.key, None)
            history.odds = min(history.odds + math.log(p / q), limit)
            return False
        row = self._misses.get(m.key)
        if row is None or not 0 <= stamp - row.since < HIDDEN_TIME:
            row = self._misses[m.key] = _Misses(stamp, history.odds)
        row.sum += math.log((1.0 - p) / (1.0 - q))
        history.odds = row.odds + math.log(HIDDEN + (1.0 - HIDDEN) * math.exp(row.sum))
        return history.odds < -limit

    def _was_absent(self, m: Landmark, keys: Sequence[Keyframe]) -> bool:
        """Whether keyframes before its first detection would have detected it.

        Those count that were in cells from which it is detected now.
        """
        place = self._graph.landmarks[m.index][None]
        num_missed = 0
        for k in keys:
            pose = self._graph.poses[k.index]
            if (
                not k.detector_ran
                or k.scan_stamp >= m.history.first
                or cell_of(pose) not in m.views
            ):
                continue
            if k.points is not None and k.origin is not None:
                scan = k.points.astype(np.float64)
                due = expected(pose, place, scan, k.origin, math.inf, self._muted)
                num_missed += bool(due[0])
        return bool(self._missing**num_missed < self._p.persistence_threshold)


def cell_of(pose: Array) -> Cell:
    """Cell of the floor of a pose (3,) of the map."""
    return math.floor(pose[0] / CELL), math.floor(pose[1] / CELL)
