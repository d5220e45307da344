# SPDX-License-Identifier: Apache-2.0
"""The fewest mounts that reach a goal: covering by integer programming, with cuts as needed.

A place that lacks something with the mounts S that it sees lacks it with any part of them, so at
least one that it sees outside of S is needed: a cut (logic-based Benders, Hooker 2000). S is
made as large as possible before, which makes the cut strong. Every choice that reaches the goal
fulfils all cuts, hence the fewest mounts that fulfil them are a lower bound, and once they reach
the goal, the answer.
"""

from __future__ import annotations

import time
from itertools import combinations

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from rlml_slam.matching.reflectors.pair_votes import MIN_MATCHES
from rlml_slam.planning.coverage import Choice, Coverage, Ints, Mask
from rlml_slam.se2 import Array

TIME = 20.0  # [s] of the processor after which the best choice known is the answer
CUTS = 40  # places that one round adds cuts of
EXTENDED = 8  # lost places a round whose cut is made as strong as possible
PAIRED = 60  # mounts that a place sees, up to which all pairs are tried


def fewest(empty: Choice, known: Choice) -> tuple[Choice, int]:
    """The fewest mounts, no more than those ``known`` to be complete; how few were excluded."""
    of, began = empty.of, time.process_time()
    cuts = _Cuts(len(of.points) - of.num_present)
    if of.is_accurate:
        _add_least(cuts, empty)
    least = 0
    now = empty
    while time.process_time() - began < TIME:
        _add_cuts(cuts, now)
        x, least = cuts.solved(TIME - (time.process_time() - began), least)
        if x is None or least >= len(known.added):
            break
        mounts = of.num_present + np.flatnonzero(x)
        different = sorted(set(now.added) ^ {int(k) for k in mounts})
        if not different:  # no cut excludes it: uniqueness that more reflectors took away
            break
        now = now.changed(*different)
        if now.is_complete:
            return now, least
    return known, least


class _Cuts:
    """Rows of A x >= b over binary x (c,)."""

    def __init__(self, num: int) -> None:
        self.num = num
        self.rows: dict[bytes, tuple[Mask, int]] = {}

    def add(self, mounts: Mask, number: int = 1) -> None:
        """At least ``number`` of the mounts (c,)."""
        key = np.packbits(mounts).tobytes()
        if mounts.any() and number > self.rows.get(key, (mounts, 0))[1]:
            self.rows[key] = mounts.copy(), min(number, int(mounts.sum()))

    def solved(self, seconds: float, least: int) -> tuple[Mask | None, int]:
        """Fewest mounts that fulfil all, None if there was no time; a bound of their number."""
        A = np.array([row for row, _ in self.rows.values()], dtype=np.float64)
        b = np.array([number for _, number in self.rows.values()], dtype=np.float64)
        found = milp(
            np.ones(self.num), integrality=np.ones(self.num), bounds=Bounds(0.0, 1.0),
            constraints=LinearConstraint(A.reshape(-1, self.num), b, np.inf),
            options={'time_limit': max(seconds, 1.0)},
        )  # fmt: skip
        if found.status != 0:
            bound = getattr(found, 'mip_dual_bound', None)
            return None, max(least, int(np.ceil((bound or 0.0) - 1e-6)))
        return found.x > 0.5, max(least, round(found.fun))


def _add_least(cuts: _Cuts, empty: Choice) -> None:
    """What each place needs at least: one mount, two if no single one does, three if no pair."""
    of, first = empty.of, empty.of.num_present
    for place in np.flatnonzero(empty.cost > 0.0):
        visible = first + np.flatnonzero(of.seen[place, first:])
        if not len(visible):
            continue
        number = 1
        if not (empty.after[place, visible - first] == 0.0).any():
            number = 2
            if 2 <= len(visible) <= PAIRED:
                pairs = np.array(list(combinations(visible, 2)), dtype=np.int64)
                base = of.members(empty.chosen, np.array([place]))
                rows = np.concatenate([np.tile(base, (len(pairs), 1)), pairs], axis=1)
                if not (of.costs(np.full(len(pairs), place), rows) == 0.0).any():
                    number = 3
        cuts.add(of.seen[place, first:], number)


def _add_cuts(cuts: _Cuts, now: Choice) -> None:
    """Cuts of the places that lack most."""
    of, first = now.of, now.of.num_present
    if of.is_accurate:
        short = np.argsort(-now.cost, kind='stable')[:CUTS]
        for place in short[now.cost[short] > 0.0]:
            cuts.add(of.seen[place, first:] & ~_largest_short(of, int(place), now.chosen)[first:])
    mounts = np.arange(first, len(of.points))
    extended = 0
    for place, rivals in zip(of.lost.tolist(), now.rivals, strict=True):
        decides = of.decides(place, mounts, rivals, now.chosen) & ~now.chosen[first:]
        seen = int((of.seen[place] & now.chosen).sum())
        for row, pose, lacking in zip(decides, rivals.poses, rivals.lacking.tolist(), strict=True):
            cuts.add(row, lacking if np.isfinite(pose[0]) else max(MIN_MATCHES - seen, 1))
        if len(rivals.lacking) and extended < EXTENDED:
            extended += 1
            cuts.add((of.seen[place] & ~_largest_mistaken(of, place, now.chosen))[first:])


def _largest_mistaken(of: Coverage, place: int, chosen: Mask) -> Mask:
    """The chosen (m,) and as many mounts more as the place can see and still be mistaken."""
    chosen = chosen.copy()
    for k in np.flatnonzero(of.seen[place] & ~chosen):
        chosen[k] = True
        chosen[k] = bool(len(of.rivals(place, chosen).lacking))
    return chosen


def _largest_short(of: Coverage, place: int, chosen: Mask) -> Mask:
    """The chosen (m,) and as many mounts more as the place can see and still be short of it."""
    chosen = chosen.copy()
    here = np.array([place])
    more: Ints = np.flatnonzero(of.seen[place] & ~chosen)
    base = of.members(chosen, here)
    while len(more):
        rows = np.concatenate([np.tile(base, (len(more), 1)), more[:, None]], axis=1)
        cost: Array = of.costs(np.tile(here, len(more)), rows)
        k = int(np.argmax(cost))
        if cost[k] <= 0.0:
            break
        chosen[more[k]] = True
        base, more = rows[[k]], np.delete(more[cost > 0.0], np.sum(cost[:k] > 0.0))
    return chosen
