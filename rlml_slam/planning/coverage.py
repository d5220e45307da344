# SPDX-License-Identifier: Apache-2.0
"""What a choice of mounts lacks: accuracy at each place, and uniqueness for a lost robot.

The loss of a place is 0 where it reaches the goal; elsewhere it is between 1/2 and 1 by how far it
is from it. So a place that can be finished comes first, and one that cannot still counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.matching.reflectors.constellation import locate
from rlml_slam.params import Parameters
from rlml_slam.planning.bound import detection_cov
from rlml_slam.planning.driving import predicted, schur
from rlml_slam.planning.plan import Goal
from rlml_slam.planning.samples import is_elsewhere
from rlml_slam.se2 import Array
from rlml_slam.types import Verdict

OPEN = 1.0  # [m] sigma of what nothing measures
WEAK = np.array([OPEN**-2, 0.0, 0.0, OPEN**-2, 0.0, 4.0])  # information that bounds it
CHUNK = 20_000  # rows at a time, for memory
LEAD = 2  # matches by which the true pose must lead a rival to be unique
DEEPEST = 4  # lacking matches at which the loss is 1
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Rivals:
    """Poses (k, 3) a place is mistaken for, and how many more matches (k,) decide against each.

    Without a rival, one row of NaN: any reflector in view helps.
    """

    poses: Array
    lacking: Ints


UNIQUE = Rivals(np.zeros((0, 3)), np.zeros(0, dtype=np.int64))


@dataclass(frozen=True)
class Coverage:
    """Places (n, 2) and what each sees (n, m) of reflectors ``points`` (m, 2) with ``cov``.

    The first ``num_present`` stand already, the others are mounts. ``information`` (n, m, 6) of
    each, ``scan`` (n, 6); ``q`` as in :func:`~rlml_slam.planning.driving.predicted`. ``lost`` are
    the places at which the pose has to be unique; ``is_accurate``: whether the goal counts.
    """

    places: Array
    seen: Mask
    points: Array
    cov: Array
    num_present: int
    information: Array
    scan: Array
    q: float
    goal: Goal
    is_accurate: bool
    lost: Ints
    params: Parameters

    def shortfall(self, information: Array, scan: Array) -> Array:
        """How far (r,) sigmas are from the goal, 0 where reached to 1 where open, by logarithm."""
        a, b, c = schur(information + predicted(information, self.q) + scan + WEAK)
        mean, half = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
        least = self.goal.sigma**-2 + WEAK[0]
        short = [np.log(np.maximum(least / np.maximum(v, 1e-30), 1.0))
                 for v in (mean - half, mean + half)]  # fmt: skip
        scale = 2.0 * math.log(least * OPEN**2)
        return np.asarray(np.minimum((short[0] + short[1]) / scale, 1.0))

    def costs(self, place: Ints, members: Ints) -> Array:
        """Shortfall (r,) where ``place`` (r,) sees ``members`` (r, k), -1 for none.

        The mean of those with none, one and more hidden up to the goal's number, as the first
        reflectors of a place bring nothing while all of them are hidden.
        """
        out = np.zeros(len(place))
        for first in range(0, len(place), CHUNK):
            rows = slice(first, first + CHUNK)
            each = self.information_of(place[rows], members[rows])
            for hidden in range(self.goal.hidden + 1):
                worst = self._worst(each, self.scan[place[rows]], hidden)
                out[rows] += worst / (self.goal.hidden + 1)
        return out

    def information_of(self, place: Ints, members: Ints) -> Array:
        """Information (r, k, 6) of each of the ``members`` (r, k) at ``place`` (r,)."""
        return np.where((members >= 0)[..., None], self.information[place[:, None], members], 0.0)

    def _worst(self, each: Array, scan: Array, hidden: int) -> Array:
        """Shortfall (r,) with that many of the reflectors' information (r, k, 6) hidden."""
        total, k = each.sum(axis=1), each.shape[1]
        worst = np.zeros(len(each))
        for some in combinations(range(k), min(hidden, k)):
            left = total - each[:, some].sum(axis=1)
            np.maximum(worst, self.shortfall(left, scan), out=worst)
        return worst

    def members(self, chosen: Mask, place: Ints) -> Ints:
        """Which of the chosen (m,) each ``place`` (r,) sees: (r, k), -1 for none."""
        used = np.flatnonzero(chosen)
        mask = self.seen[np.ix_(place, used)]
        k = int(mask.sum(axis=1).max(initial=0))
        order = np.argsort(~mask, axis=1, kind='stable')[:, :k]
        return np.where(np.take_along_axis(mask, order, 1), used[order], -1)

    def rivals(self, place: int, chosen: Mask) -> Rivals:
        """What relocalization at a place would mistake it for, by all that is chosen."""
        p = self.params
        row = self.seen[place] & chosen
        k = int(row.sum())
        z = self.points[row] - self.places[place]
        cov = detection_cov(z, p.reflector)
        found = locate(z, cov, self.points[chosen], self.cov[chosen], p.relocalization)
        if found.verdict is Verdict.UNIQUE:
            return UNIQUE
        others = [c for c in found.candidates if is_elsewhere(c.pose, self.places[place])]
        # matches of the true pose are k
        lacking = [max(c.num_matches - k + LEAD, 1) for c in others]
        if not others:
            return Rivals(np.full((1, 3), np.nan), np.array([max(DEEPEST - k, 1)]))
        return Rivals(np.array([c.pose for c in others]), np.array(lacking))

    def decides(self, place: int, mounts: Ints, rivals: Rivals, chosen: Mask) -> Mask:
        """Whether each mount (c,) seen from a place meets nothing chosen at each rival: (k, c)."""
        z = self.points[mounts] - self.places[place]
        largest = np.linalg.eigvalsh(detection_cov(z, self.params.reflector))[:, -1]
        reach = 4.0 * np.sqrt(largest + self.params.relocalization.sigma_floor**2)
        out = np.zeros((len(rivals.poses), len(mounts)), dtype=np.bool_)
        known = self.points[chosen]
        for k, pose in enumerate(rivals.poses):
            if not np.isfinite(pose[0]) or not len(known):
                out[k] = True
                continue
            there = se2.transform(pose, z)
            gap = np.hypot(*(there[:, None] - known).transpose(2, 0, 1)).min(axis=1)
            out[k] = gap > reach
        seen: Mask = self.seen[place, mounts]
        return out & seen


def step(cost: Array) -> Array:
    """The loss of a cost in [0, 1]."""
    return np.where(cost > 0.0, 0.5 + 0.5 * cost, 0.0)


def _depth(lacking: Ints) -> Array:
    """The loss of places that lack so many matches."""
    return step(np.minimum(lacking / DEEPEST, 1.0))


@dataclass(frozen=True)
class Choice:
    """Chosen reflectors (m,) of a coverage, and what they lack.

    ``cost`` (n,) and ``after`` (n, c), the cost with one mount more; ``rivals`` (t,) of the places
    ``lost``.
    """

    of: Coverage
    chosen: Mask
    cost: Array
    after: Array
    rivals: tuple[Rivals, ...]

    @property
    def added(self) -> list[int]:
        """Indices of the chosen mounts."""
        return [int(k) for k in np.flatnonzero(self.chosen) if k >= self.of.num_present]

    @property
    def loss(self) -> float:
        """Mean loss of accuracy, if it counts, and of uniqueness."""
        lost = [_depth(r.lacking.max(initial=0)) for r in self.rivals]
        accuracy = float(step(self.cost).mean()) if self.of.is_accurate else 0.0
        return accuracy + (float(np.mean(lost)) if lost else 0.0)

    @property
    def is_complete(self) -> bool:
        """Whether nothing lacks."""
        return self.loss == 0.0

    def gains(self) -> Array:
        """By how much each mount (c,) would lower the loss; those chosen by nothing."""
        of, first = self.of, self.of.num_present
        out = np.zeros(self.after.shape[1])
        if of.is_accurate:
            out += (step(self.cost)[:, None] - step(self.after)).mean(axis=0)
        mounts = np.arange(first, len(of.points))
        for place, r in zip(of.lost, self.rivals, strict=True):
            if len(r.lacking):
                left = (r.lacking[:, None] - of.decides(place, mounts, r, self.chosen)).max(axis=0)
                out += (_depth(r.lacking.max()) - _depth(left)) / len(of.lost)
        out[self.chosen[first:]] = 0.0
        return out

    def changed(self, *mounts: int) -> Choice:
        """The same with these mounts added where they were not chosen, else removed."""
        chosen = self.chosen.copy()
        chosen[list(mounts)] = ~chosen[list(mounts)]
        rows = np.asarray(self.of.seen[:, list(mounts)].any(axis=1), dtype=np.bool_)
        return _evaluated(self.of, chosen, self, rows)


def start(of: Coverage) -> Choice:
    """No mount chosen."""
    chosen = np.arange(len(of.points)) < of.num_present
    n, c = len(of.places), len(of.points) - of.num_present
    empty = Choice(of, chosen, np.zeros(n), np.zeros((n, c)), (UNIQUE,) * len(of.lost))
    return _evaluated(of, chosen, empty, np.ones(n, dtype=np.bool_))


def _evaluated(of: Coverage, chosen: Mask, before: Choice, rows: Mask) -> Choice:
    """A choice that differs from one ``before`` in what places ``rows`` (n,) see."""
    cost, after = before.cost.copy(), before.after.copy()
    first = of.num_present
    if of.is_accurate:
        place = np.flatnonzero(rows)
        members = of.members(chosen, place)
        cost[place] = of.costs(place, members)
        after[place] = cost[place, None]
        short = np.flatnonzero(cost[place] > 0.0)
        at, mount = np.nonzero(of.seen[place[short], first:] & ~chosen[first:])
        more = np.concatenate([members[short[at]], first + mount[:, None]], axis=1)
        after[place[short[at]], mount] = of.costs(place[short[at]], more)
    rivals = tuple(of.rivals(int(k), chosen) if rows[k] or len(r.lacking) else r
                   for k, r in zip(of.lost, before.rivals, strict=True))  # fmt: skip
    return replace(before, chosen=chosen, cost=cost, after=after, rivals=rivals)
