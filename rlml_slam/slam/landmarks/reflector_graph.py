# SPDX-License-Identifier: Apache-2.0
"""The graph's reflectors: born after enough sightings, merged where two turn out to be one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.graph import Renumbering
from rlml_slam.graph.reduction.edge_pruning import prune_sightings
from rlml_slam.graph.reduction.marginalization import Ties, limited
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.params import Reflector
from rlml_slam.se2 import Array, rotation, transform
from rlml_slam.slam.keyframes import AGREE, Interval
from rlml_slam.slam.landmarks.landmark import LIFE, SIGHTING, VIEW, Landmark, Life
from rlml_slam.slam.landmarks.removed_landmarks import RemovedLandmarks
from rlml_slam.types import ANONYMOUS, Belief, Reflectors

Records = NDArray[np.void]

MERGE_DISTANCE = 1.5  # [m] pairs farther apart are not looked at
# [m²] variance of what all sightings of a reflector from one side have in common: where on it the
# sensor sees its middle, and how far the submaps are off there
COMMON2 = np.array([1e-4, 1e-4])


class ReflectorGraph:
    """Sightings (e^R of eq. 12) and landmarks; keys are the front end's."""

    def __init__(self, params: Reflector, live: OnlineSolver) -> None:
        self._p = params
        self._live = live
        self._graph = live.graph
        self._landmarks: dict[int, Landmark] = {}
        self._alias: dict[int, int] = {}
        self.gone = RemovedLandmarks()
        self._given_up: set[int] = set()  # keys that the front end may still have
        self._came = np.zeros(2, dtype=np.int64)  # keyframes with sightings, and how many of these
        self.changed = False

    def resolve(self, key: int) -> int:
        """The key under which a merged reflector goes on."""
        while key in self._alias:
            key = self._alias[key]
        return key

    def add(self, pose: int, interval: Interval) -> None:
        """The reflectors seen near keyframe ``pose``."""
        together = {self.resolve(key) for key in interval.sightings}
        for key, s in ((k, s) for k, groups in interval.sightings.items() for s in groups):
            landmark = self._landmarks.setdefault(self.resolve(key), Landmark(self.resolve(key)))
            landmark.id = interval.ids.get(key, landmark.id)
            landmark.diameter = interval.diameters.get(key, landmark.diameter)
            self._given_up.discard(landmark.key)
            landmark.count += s.count
            landmark.life.seen(interval.first_look, interval.last_look)
            landmark.beside |= together
            # errors of a sensor are alike from one message to the next: many do not average out
            worth = 1.0 / (1.0 + self._p.correlated_share * (s.count - 1))
            row = np.zeros(1, dtype=SIGHTING)
            row['pose'], row['factor'] = pose, -1
            row['z'], row['information'] = s.z, worth * s.information
            landmark.sightings.append(row)
            if landmark.index < 0 and landmark.count >= self._p.min_sightings:
                point = transform(self._graph.poses[pose], s.z[None])[0]
                landmark.index = self._graph.add_landmark(point)
            self._link_all(landmark)
        num = sum(map(len, interval.sightings.values()))
        self._came += np.array([num > 0, num])

    def _link_all(self, landmark: Landmark) -> None:
        """Give a landmark of the graph the factors that it still lacks."""
        if landmark.index >= 0:
            rows = landmark.sightings.view
            new = np.flatnonzero(rows['factor'] < 0)
            if len(new):
                s = rows[new]
                nodes = np.stack([s['pose'], np.full(len(s), landmark.index)], -1)
                rows['factor'][new] = self._graph.add_sightings(nodes, s['z'], s['information'])
                self.changed = True

    def _unlink(self, sightings: Records) -> None:
        """Switch the factors of sightings (k,) off."""
        factors = sightings['factor']
        self._graph.sightings.enabled[factors[factors >= 0]] = False
        sightings['factor'] = -1

    @property
    def found(self) -> bool:
        """Whether there is any reflector in the graph."""
        return bool(self.alive())

    def alive(self) -> list[Landmark]:
        """The reflectors in the graph."""
        return [m for m in self._landmarks.values() if m.index >= 0]

    def place(self, m: Landmark) -> Array:
        """Where a reflector of the graph is (2,)."""
        point: Array = self._graph.landmarks[m.index].copy()
        return point

    def keys(self) -> frozenset[int]:
        """Of the reflectors in the graph."""
        return frozenset(m.key for m in self.alive())

    def forget_views(self) -> None:
        """The floor lies elsewhere in the map: nothing is known of who is seen from where."""
        for m in self._landmarks.values():
            m.views.clear()

    def key_of(self, index: int) -> int:
        """Of the reflector that is a landmark of the graph."""
        return next(m.key for m in self.alive() if m.index == index)

    def surveyed(self) -> dict[int, int]:
        """Rows of the survey by key, of the reflectors that are in it."""
        return {m.key: m.surveyed for m in self.alive() if m.surveyed >= 0}

    def survey(self, key: int, row: int, id_: int) -> int:
        """A reflector of the graph is one of the survey, or none (-1); its landmark there."""
        landmark = self._landmarks[key]
        landmark.surveyed = row
        landmark.id = id_ if landmark.id == ANONYMOUS else landmark.id
        return landmark.index

    def is_mapped(self, key: int) -> bool:
        """Whether the reflector has entered the graph."""
        landmark = self._landmarks.get(self.resolve(key))
        return landmark is not None and landmark.index >= 0

    def count(self, key: int) -> int:
        """How often a reflector was detected, in the graph or not yet."""
        landmark = self._landmarks.get(self.resolve(key))
        return 0 if landmark is None else landmark.count

    def merge(self, pending: Collection[int] = ()) -> bool:
        """Make one of each pair that is close, statistically equal and never seen together.

        Where the two places are uncertain, that could as well be two reflectors, and is left;
        those whose keys are ``pending`` are another's to decide.
        """
        alive = [m for m in self.alive() if m.key not in pending]
        if len(alive) < 2:
            return False
        points = self._graph.landmarks[[m.index for m in alive]]
        # of thousands, most are far from most
        pairs = cKDTree(points).query_pairs(MERGE_DISTANCE, output_type='ndarray')
        distinct = [self._distinct(alive[i], alive[j]) for i, j in pairs.tolist()]
        pairs = pairs[~np.array(distinct, dtype=np.bool_)]
        if not len(pairs):
            return False
        merged: set[int] = set()
        limit = gate(self._p.gate)
        gaps = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1)
        order = np.lexsort((pairs[:, 1], pairs[:, 0], gaps))
        close = np.unique(pairs)
        joint = self._live.joint([], [alive[k].index for k in close])
        for (i, j), gap in zip(pairs[order].tolist(), gaps[order].tolist(), strict=True):
            if i in merged or j in merged:
                continue
            cov = _difference_cov(joint, *np.searchsorted(close, (i, j))) + 1e-6 * np.eye(2)
            peak = 1.0 / (2.0 * math.pi * math.sqrt(np.linalg.det(cov)))
            if peak < self._p.match_probability * (peak + self._p.unmapped_density):
                continue
            d = points[i] - points[j]
            near = gap < self._p.min_separation
            if near or d @ np.linalg.solve(cov, d) < limit:
                self._absorb(*_first(alive[i], alive[j]))
                merged |= {i, j}
        return bool(merged)

    @staticmethod
    def _distinct(a: Landmark, b: Landmark) -> bool:
        """Whether the two were seen from one keyframe, or tell or were surveyed to be two."""
        return _named_apart(a, b) or b.key in a.beside

    def join(self, a: int, b: int) -> None:
        """The reflectors of two keys are one, if their ids do not say otherwise.

        The first goes on, or the one that the graph has.
        """
        first, second = (
            self._landmarks.setdefault(key, Landmark(key)) for key in map(self.resolve, (a, b))
        )
        if first is second or _named_apart(first, second):
            return
        self._absorb(*_first(first, second))

    def _absorb(self, keep: Landmark, gone: Landmark) -> None:
        self._unlink(gone.sightings.view)
        keep.sightings.append(gone.sightings.view)
        self._link_all(keep)
        keep.life = keep.life.with_other(gone.life)
        for cell, (hits, misses) in gone.views.items():
            own = keep.views.get(cell, (0, 0))
            keep.views[cell] = own[0] + hits, own[1] + misses
        keep.beside |= gone.beside
        for other in self._landmarks.values():
            if gone.key in other.beside:
                other.beside.add(keep.key)
        keep.count += gone.count
        keep.id = gone.id if keep.id == ANONYMOUS else keep.id
        keep.diameter = gone.diameter if math.isnan(keep.diameter) else keep.diameter
        self._alias[gone.key] = keep.key
        del self._landmarks[gone.key]

    def give_up(self, landmarks: Iterable[Landmark]) -> tuple[int, ...]:
        """Let go of reflectors that are no longer there; all keys that any of them had."""
        keys: list[int] = []
        for m in landmarks:
            self.gone.add(m, self._graph.landmarks[m.index])
            self._unlink(m.sightings.view)
            priors = self._graph.landmark_priors
            priors.enabled[priors.nodes[:, 0] == m.index] = False
            keys += [m.key, *(a for a in self._alias if self.resolve(a) == m.key)]
            del self._landmarks[m.key]
            self.changed = True
        self._given_up.update(keys)
        for other in self._landmarks.values():
            other.beside.difference_update(keys)
        return tuple(keys)

    def drop_candidates(self, before: int, pending: Collection[int] = ()) -> None:
        """Let go of what was not seen often enough and not since a stamp [ns]: ghosts."""
        for m in list(self._landmarks.values()):
            if m.index < 0 and m.life.last < before and m.key not in pending:
                rows = m.sightings.view
                if len(rows):
                    pose = self._graph.poses[rows['pose'][-1]]
                    self.gone.add(m, transform(pose, rows['z'][-1:])[0])
                del self._landmarks[m.key]
                for other in self._landmarks.values():
                    other.beside.discard(m.key)

    def move(self, ties: Mapping[int, tuple[int, Ties]]) -> None:
        """See from other keyframes what was seen from some: pose to (other pose, tie from it).

        What they saw of a reflector, the other one may have seen as well: then it is one sighting.
        """
        gone = np.array(list(ties), dtype=np.int64)
        onto = np.array([other for other, _ in ties.values()], dtype=np.int64)
        whole = Ties(
            np.array([tie.T for _, tie in ties.values()]),
            np.array([tie.cov for _, tie in ties.values()]),
        )
        of = np.full(len(self._graph.poses), -1)
        of[gone] = np.arange(len(gone))
        for landmark in self._landmarks.values():
            rows = landmark.sightings.view
            at = of[rows['pose']]
            moved = at >= 0
            if not moved.any():
                continue
            s, at = rows[moved], at[moved]
            self._unlink(s)
            z, cov = _seen_from(Ties(whole.T[at], whole.cov[at]), s)
            s['pose'], s['z'], s['information'] = onto[at], z, np.linalg.inv(cov)
            beside = np.isin(rows['pose'], s['pose'])
            others = rows[beside]
            self._unlink(others)
            landmark.sightings.keep(~moved & ~beside)
            landmark.sightings.append(_fused(np.concatenate([others, s])))
            self._link_all(landmark)

    def thin(self, pose: int) -> None:
        """Let go of sightings of a keyframe that took over others: as many as one comes with stay.

        That is the mean, whatever it came with itself: were it the most that any came with,
        nearly all would take over more than they came with, by and by, and tie ever more places
        to one another. Those that tell least go first.
        """
        keys, sightings = self._came.tolist()
        gone = prune_sightings(self._live, pose, -(-sightings // max(keys, 1)))
        if len(gone):
            for landmark in self._landmarks.values():
                rows = landmark.sightings.view
                left = ~np.isin(rows['factor'], gone)
                if not left.all():
                    landmark.sightings.keep(left)

    def keep_alive(self) -> NDArray[np.bool_]:
        """Which landmarks of the graph (m,) are a reflector's, not one's that another became."""
        kept = np.zeros(len(self._graph.landmarks), dtype=np.bool_)
        kept[[m.index for m in self.alive()]] = True
        return kept

    def renumber(self, new: Renumbering) -> None:
        """The graph has let go of poses, landmarks and factors."""
        for landmark in self._landmarks.values():
            if landmark.index >= 0:
                landmark.index = int(new.landmarks[landmark.index])
            rows = landmark.sightings.view
            rows['pose'] = new.poses[rows['pose']]
            linked = rows['factor'] >= 0
            rows['factor'][linked] = new.sightings[rows['factor'][linked]]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is known, to be saved; ``reflector_beside`` has pairs of keys."""
        marks = list(self._landmarks.values())
        beside = [(m.key, other) for m in marks for other in sorted(m.beside)]
        rows = [m.sightings.view for m in marks]
        return {
            'reflector_key': np.array([m.key for m in marks], dtype=np.int64),
            'reflector_node': np.array([m.index for m in marks], dtype=np.int64),
            'reflector_id': np.array([m.id for m in marks], dtype=np.int64),
            'reflector_diameter': np.array([m.diameter for m in marks], dtype=np.float64),
            'reflector_count': np.array([m.count for m in marks], dtype=np.int64),
            'reflector_life': np.array([_row(m.life) for m in marks], dtype=LIFE),
            'reflector_view': np.array(
                [(m.key, *cell, *counts) for m in marks for cell, counts in m.views.items()],
                dtype=VIEW,
            ),
            **self.gone.arrays(),
            'reflector_surveyed': np.array([m.surveyed for m in marks], dtype=np.int64),
            'reflector_sightings': np.array([len(r) for r in rows], dtype=np.int64),
            'reflector_came': self._came.copy(),
            'reflector_beside': np.array(beside, dtype=np.int64).reshape(-1, 2),
            'reflector_alias': np.array(list(self._alias.items()), dtype=np.int64).reshape(-1, 2),
            'sighting': np.concatenate([np.zeros(0, dtype=SIGHTING), *rows]),
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take over what was saved, with the graph that belongs to it."""
        a = arrays
        ends = np.cumsum(a['reflector_sightings'])
        surveyed = a.get('reflector_surveyed', np.full(len(a['reflector_key']), -1))
        lives = a.get('reflector_life', np.zeros(len(a['reflector_key']), dtype=LIFE))
        self.gone.restore(a)
        for k, key in enumerate(a['reflector_key'].tolist()):
            landmark = Landmark(
                key, int(a['reflector_node'][k]), int(a['reflector_id'][k]),
                float(a['reflector_diameter'][k]), int(a['reflector_count'][k]),
            )  # fmt: skip
            landmark.surveyed = int(surveyed[k])
            landmark.life = Life(*lives[k].item())
            landmark.sightings.append(
                a['sighting'][ends[k] - a['reflector_sightings'][k] : ends[k]]
            )
            self._landmarks[key] = landmark
        for key, other in a['reflector_beside'].tolist():
            self._landmarks[key].beside.add(other)
        for key, x, y, hits, misses in a.get('reflector_view', np.zeros(0, VIEW)).tolist():
            self._landmarks[key].views[x, y] = hits, misses
        self._alias = dict(a['reflector_alias'].tolist())
        # of a map without, as a merged one: those that are left
        left = len(np.unique(a['sighting']['pose'])), len(a['sighting'])
        self._came[:] = a.get('reflector_came', left)

    @property
    def next_key(self) -> int:
        """The first key that was never used."""
        return 1 + max([*self._landmarks, *self._alias, *self.gone.keys], default=-1)

    def belief(self, pose: int) -> Belief:
        """Pose ``pose`` and all reflectors with their joint covariance."""
        alive = sorted(self.alive(), key=lambda m: m.key)
        index = [m.index for m in alive]
        cov = self._live.joint([pose], index)
        return Belief(
            self._graph.poses[pose].copy(),
            np.array([m.key for m in alive], dtype=np.int64),
            self._graph.landmarks[index].reshape(-1, 2),
            cov,
            {key: self.resolve(key) for key in self._alias},
            tuple(self._given_up),
        )

    def reflectors(self) -> Reflectors:
        """The map's reflectors with marginal covariances, sorted by key."""
        alive = sorted(self.alive(), key=lambda m: m.key)
        index = [m.index for m in alive]
        cov = Marginals(self._graph).landmarks(index) if alive else np.zeros((0, 2, 2))
        return Reflectors(
            np.array([m.key for m in alive], dtype=np.int64),
            self._graph.landmarks[index].copy() if alive else np.zeros((0, 2)),
            cov,
            np.array([m.id for m in alive], dtype=np.int64),
            np.array([m.count for m in alive], dtype=np.int64),
            np.array([m.diameter for m in alive], dtype=np.float64),
        )


def _seen_from(ties: Ties, s: Records) -> tuple[Array, Array]:
    """Where sightings (k,) are, and covariances, seen from where ``ties`` (k,) begin."""
    z = transform(ties.T, s['z'][:, None])[:, 0]
    R = rotation(ties.T[:, 2])
    J = np.zeros((len(s), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = ties.T[:, 1] - z[:, 1], z[:, 0] - ties.T[:, 0]
    cov = R @ np.linalg.inv(s['information']) @ np.swapaxes(R, 1, 2)
    return z, cov + J @ ties.cov @ np.swapaxes(J, 1, 2)


def _fused(s: Records) -> Records:
    """Sightings (k,) of one reflector; those from one pose that agree with the first are one.

    Of the others from that pose, the newest stays.
    """
    _, first, at = np.unique(s['pose'], return_index=True, return_inverse=True)
    cov: Array = np.linalg.inv(s['information'])
    d = s['z'] - s['z'][first][at]
    spread = cov + cov[first][at]
    away = np.einsum('ki,ki->k', d, np.linalg.solve(spread, d[..., None])[..., 0])
    agree = away < AGREE
    out = s[first]
    W, b = np.zeros((len(first), 2, 2)), np.zeros((len(first), 2))
    np.add.at(W, at[agree], s['information'][agree])
    np.add.at(b, at[agree], (s['information'] @ s['z'][..., None])[agree, :, 0])
    C = np.asarray(np.linalg.inv(W), dtype=np.float64)
    out['z'] = (C @ b[..., None])[..., 0]
    out['information'] = np.linalg.inv(limited(C, COMMON2, cov[agree], at[agree]))
    others = s[~agree][::-1]
    _, newest = np.unique(others['pose'], return_index=True)
    return np.concatenate([out, others[newest]])


def _row(life: Life) -> tuple[float, ...]:
    return dataclasses.astuple(life)


def _named_apart(a: Landmark, b: Landmark) -> bool:
    """Whether the two tell different ids, or are different ones of the survey."""
    named = a.id != ANONYMOUS and b.id != ANONYMOUS and a.id != b.id
    return named or (a.surveyed >= 0 and b.surveyed >= 0 and a.surveyed != b.surveyed)


def _first(a: Landmark, b: Landmark) -> tuple[Landmark, Landmark]:
    """The one of two that goes on, which the graph or even the survey has, and the other."""
    better = (b.index >= 0, b.surveyed >= 0) > (a.index >= 0, a.surveyed >= 0)
    return (b, a) if better else (a, b)


def _difference_cov(joint: Array, a: int, b: int) -> Array:
    """Covariance (2, 2) of landmark a minus landmark b of those with a ``joint`` (2m, 2m) one."""
    rows = np.array([2 * a, 2 * a + 1, 2 * b, 2 * b + 1])
    D = np.hstack([np.eye(2), -np.eye(2)])
    cov: Array = D @ joint[np.ix_(rows, rows)] @ D.T
    return cov
