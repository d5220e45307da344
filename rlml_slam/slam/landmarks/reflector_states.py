# SPDX-License-Identifier: Apache-2.0
"""States of the reflectors (present, new, moved, missing, ghost), as a table."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rlml_slam.params import Reflector
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.types import ANONYMOUS

PRESENT, NEW, MOVED, MISSING, GHOST = 'present', 'new', 'moved', 'missing', 'ghost'
COLUMNS = (
    'state', 'key', 'id', 'x_m', 'y_m', 'sightings', 'first_s', 'last_s', 'probability',
    'from_key', 'from_x_m', 'from_y_m', 'by_m',
)  # fmt: skip
MAX_MOVE = 3.0  # [m] up to which a missing and a new reflector are one that was moved
# [s] by which their detection times may overlap, for these are rounded to keyframes; and the least
# time that the missing one was present, so that its surroundings were mapped
OVERLAP, MAPPED_TIME = 10.0, 60.0
GHOST_DISTANCE = 0.5  # [m] ghosts closer together are one


@dataclass
class ReflectorState:
    """State of a reflector at ``place`` (2,) of the map, detected between two stamps [ns].

    ``probability`` of being present now; ``origin`` is the previous state of a moved one.
    """

    state: str
    key: int
    id: int
    place: Array
    sightings: int
    first: int
    last: int
    probability: float
    origin: ReflectorState | None = None

    @property
    def distance(self) -> float:
        """Distance by which it was moved [m], else NaN."""
        return math.nan if self.origin is None else _gap(self, self.origin)


def reflector_states(reflectors: ReflectorGraph, params: Reflector) -> list[ReflectorState]:
    """States of all reflectors, those of the map first.

    One that was removed is missing, or moved where a new one is near or has its id. One that was
    seen in one pass alone, or too seldom to be mapped, is a ghost.
    """
    present = [_present(m, reflectors.place(m)) for m in reflectors.alive()]
    present.sort(key=lambda s: s.key)
    removed = _removed(reflectors, params)
    missing = [
        s for s in removed
        if s.state == MISSING and all(_gap(s, t) > params.min_separation for t in present)
    ]  # fmt: skip
    pairs = [
        (_gap(n, s), n, s) for n in present for s in missing if _came_after(n, s) and _same(n, s)
    ]
    for _, new, old in sorted(pairs, key=lambda p: p[0]):
        if new.origin is None and old in missing:
            new.state, new.origin = MOVED, old
            missing.remove(old)
    return present + missing + _grouped([s for s in removed if s.state == GHOST])


def _present(m: Landmark, place: Array) -> ReflectorState:
    probability = 1.0 / (1.0 + math.exp(-m.history.odds))
    state = NEW if m.history.is_new else PRESENT
    return ReflectorState(
        state, m.key, m.id, place, m.count, m.history.first, m.history.last, probability
    )


def _removed(reflectors: ReflectorGraph, params: Reflector) -> list[ReflectorState]:
    """Reflectors that were removed from the map, the newest first."""
    out = []
    for key, id_, place, count, first, last, mapped in reflectors.removed.rows[::-1].tolist():
        passing = (last - first) * 1e-9 < params.candidate_timeout
        state = MISSING if mapped and not passing else GHOST
        out.append(ReflectorState(state, key, id_, np.array(place), count, first, last, 0.0))
    return out


def _came_after(new: ReflectorState, old: ReflectorState) -> bool:
    """Whether one appeared after the other, whose surroundings were mapped."""
    came_then = (old.last - new.first) * 1e-9 < OVERLAP
    return new.state == NEW or (came_then and (old.last - old.first) * 1e-9 > MAPPED_TIME)


def _same(new: ReflectorState, old: ReflectorState) -> bool:
    if ANONYMOUS not in (new.id, old.id):
        return new.id == old.id
    return _gap(new, old) < MAX_MOVE


def _grouped(ghosts: Iterable[ReflectorState]) -> list[ReflectorState]:
    """Ghosts, those at one place as one."""
    out: list[ReflectorState] = []
    for g in ghosts:
        known = next((o for o in out if _gap(o, g) < GHOST_DISTANCE), None)
        if known is None:
            out.append(g)
            continue
        known.sightings += g.sightings
        known.first, known.last = min(known.first, g.first), max(known.last, g.last)
    return out


def _gap(a: ReflectorState, b: ReflectorState) -> float:
    return float(np.hypot(*(a.place - b.place)))


def state_table(states: Iterable[ReflectorState]) -> str:
    """Table of comma-separated values, one row per reflector."""
    rows = [','.join(COLUMNS)]
    for s in states:
        o = s.origin
        moved = '' if o is None else f'{o.key},{o.place[0]:.4f},{o.place[1]:.4f},{s.distance:.4f}'
        rows.append(
            f'{s.state},{s.key},{s.id},{s.place[0]:.4f},{s.place[1]:.4f},{s.sightings},'
            f'{s.first * 1e-9:.3f},{s.last * 1e-9:.3f},{s.probability:.4f},{moved or ",,,"}'
        )
    return '\n'.join(rows) + '\n'


def describe(s: ReflectorState) -> str:
    """A new, moved, missing or ghost reflector in one line of text."""
    name = f'reflector {s.key}' + ('' if s.id == ANONYMOUS else f' (id {s.id})')
    at = f'at {s.place[0]:.2f}, {s.place[1]:.2f}'
    if s.origin is not None:
        x, y = s.origin.place
        return f'moved: {name} {at}, by {s.distance:.2f} m from {x:.2f}, {y:.2f}'
    return f'{s.state}: {name} {at}, seen {s.sightings} times'
