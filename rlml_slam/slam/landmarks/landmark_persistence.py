# SPDX-License-Identifier: Apache-2.0
"""Whether the reflectors of a map are still there, by what should be seen and is not (Bayes).

A reflector is due where the scan shows the way to it free, in a cell of the floor from which it
was seen before. There it is detected with the probability p, estimated from how often it was from
this cell; at an empty place something is detected with q, the density of ghosts times their area:

    log odds += log(p / q) if it is seen, log((1 - p) / (1 - q)) if not

and they stay within the odds of ``reflector.persistence_threshold`` either way, for anything may
be moved later.
A probability of the reflector alone would not do: a flat one, or one behind a corner that the
beams pass, is missed from the same places again and again. Misses in a row have a common cause
now and then, such as a person whom the beams of a coarse scan pass: with the probability h, a
reflector that is there is hidden for the whole WHILE, so that its misses multiply the odds by
h + (1 - h) prod (1 - p) / (1 - q), and not by the product alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph.model.graph import Graph
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import Interval, Keyframe
from rlml_slam.slam.landmarks.landmark import Cell, Landmark
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.slam.landmarks.visibility import expected

APART = 0.5  # [m] side of a cell, and travel between two misses that count: nearer ones are alike
YOUNG = 30  # sightings after which it is settled whether a reflector is new
# Both by judgement: people pass, and what stays for longer is larger than the gaps of a scan.
HIDDEN, WHILE = 0.05, 10_000_000_000  # h, and [ns] how long that lasts
TWO = 2.0  # looks that a cell begins with, one of them a miss (Laplace)


@dataclass
class _Misses:
    """Those of one WHILE: when it began, the log odds of then, and what the misses add to them."""

    since: int
    odds: float
    sum: float = 0.0


class LandmarkPersistence:
    """Looks after each keyframe which of the mapped reflectors were seen that were due."""

    def __init__(self, params: Parameters, graph: Graph, reflectors: ReflectorGraph) -> None:
        p = params.reflector
        self._p = p
        self._missing = params.relocalization.missed_share
        self._empty = min(p.unmapped_density * math.pi * p.min_separation**2, 0.5)
        self._graph = graph
        self._reflectors = reflectors
        self._missed: dict[int, Array] = {}  # from where, the last time that counted, by key
        self._misses: dict[int, _Misses] = {}

    def look(self, keys: Sequence[Keyframe], interval: Interval) -> tuple[int, ...]:
        """Weigh what was seen near the newest keyframe; keys of those that were given up."""
        key = keys[-1]
        key.looked = interval.looked
        alive = self._reflectors.alive()
        if not (alive and self._p.persistence_threshold and interval.looked):
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
            missed &= expected(pose, places, scan, key.origin, math.inf)
        # where most are not seen, it is the pose that is wrong, or the detector
        if seen.sum() < max(1, missed.sum()):
            return ()
        gone = []
        for k in np.flatnonzero(seen | missed).tolist():
            m = alive[k]
            if self._weigh(m, bool(seen[k]), pose, interval.last_look):
                gone.append(m)
            elif seen[k] and not m.life.is_new and m.life.hits < YOUNG:
                m.life.is_new = self._was_absent(m, keys[:-1])
        for m in gone:
            self._missed.pop(m.key, None)
            self._misses.pop(m.key, None)
        return self._reflectors.give_up(gone)

    def _seen(
        self, alive: Sequence[Landmark], places: Array, interval: Interval
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which of ``places`` (m, 2), keyframe's frame, were seen; and where something near was.

        What the map takes for another reflector is not near.
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

    def _weigh(self, m: Landmark, is_seen: bool, pose: Array, stamp: int) -> bool:
        """Bayes' rule for one look; whether the reflector is to be given up."""
        last, cell, life = self._missed.get(m.key), cell_of(pose), m.life
        if not is_seen:
            if last is not None and np.hypot(*(pose[:2] - last)) < APART:
                return False
            self._missed[m.key] = pose[:2].copy()
        hits, misses = m.views.get(cell, (0, 0))
        m.views[cell] = (hits + is_seen, misses + (not is_seen))
        life.hits += is_seen
        life.misses += not is_seen
        p, q = (0.5 * TWO + hits) / (TWO + hits + misses), self._empty
        most = math.log((1.0 - self._p.persistence_threshold) / self._p.persistence_threshold)
        if is_seen:
            self._misses.pop(m.key, None)
            life.odds = min(life.odds + math.log(p / q), most)
            return False
        row = self._misses.get(m.key)
        if row is None or not 0 <= stamp - row.since < WHILE:
            row = self._misses[m.key] = _Misses(stamp, life.odds)
        row.sum += math.log((1.0 - p) / (1.0 - q))
        life.odds = row.odds + math.log(HIDDEN + (1.0 - HIDDEN) * math.exp(row.sum))
        return life.odds < -most

    def _was_absent(self, m: Landmark, keys: Sequence[Keyframe]) -> bool:
        """Whether keyframes before its first sighting would have seen it, had it been there.

        They stood where it is seen from now.
        """
        place = self._graph.landmarks[m.index][None]
        unseen = 0
        for k in keys:
            pose = self._graph.poses[k.index]
            if not k.looked or k.scan_stamp >= m.life.first or cell_of(pose) not in m.views:
                continue
            if k.points is not None and k.origin is not None:
                scan = k.points.astype(np.float64)
                unseen += bool(expected(pose, place, scan, k.origin, math.inf)[0])
        return bool(self._missing**unseen < self._p.persistence_threshold)


def cell_of(pose: Array) -> Cell:
    """The cell of the floor that a pose (3,) of the map is in."""
    return math.floor(pose[0] / APART), math.floor(pose[1] / APART)
