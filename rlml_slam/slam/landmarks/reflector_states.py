# SPDX-License-Identifier: Apache-2.0
"""What has become of each reflector: there, new, moved, missing, or a ghost; as a table."""

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
FAR = 3.0  # [m] one that is missing and one that is new are one that was moved, if this near
# [s] that both may seem to be there, for looks count by the keyframe they were near; and that the
# missing one was there at least, longer than most who pass: then what is near was mapped
TOGETHER, SETTLED = 10.0, 60.0


@dataclass
class ReflectorState:
    """One reflector at ``place`` (2,) of the map, seen between two stamps [ns].

    ``probability`` is that of being there now; ``origin`` is where one that was moved was before.
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
        """How far it was moved [m], NaN where it was not."""
        return math.nan if self.origin is None else _gap(self, self.origin)


def reflector_states(reflectors: ReflectorGraph, params: Reflector) -> list[ReflectorState]:
    """All reflectors, those of the map first.

    One that left the map is missing, or moved where a new one stands near or tells its id; what
    came when an old one went is new there, whatever earlier keyframes tell. What was seen in one
    pass alone is a ghost, and so is what was seen too seldom to enter the map.
    """
    there = [_alive(m, reflectors.place(m)) for m in reflectors.alive()]
    there.sort(key=lambda s: s.key)
    left = _left(reflectors, params)
    lost = [
        s for s in left
        if s.state == MISSING and all(_gap(s, t) > params.min_separation for t in there)
    ]  # fmt: skip
    pairs = [(_gap(n, s), n, s) for n in there for s in lost if _came_after(n, s) and _same(n, s)]
    for _, new, old in sorted(pairs, key=lambda p: p[0]):
        if new.origin is None and old in lost:
            new.state, new.origin = MOVED, old
            lost.remove(old)
    return there + lost + _grouped([s for s in left if s.state == GHOST])


def _alive(m: Landmark, place: Array) -> ReflectorState:
    probability = 1.0 / (1.0 + math.exp(-m.life.odds))
    state = NEW if m.life.is_new else PRESENT
    return ReflectorState(
        state, m.key, m.id, place, m.count, m.life.first, m.life.last, probability
    )


def _left(reflectors: ReflectorGraph, params: Reflector) -> list[ReflectorState]:
    """Those that are no longer in the map, the newest first."""
    out = []
    for key, id_, place, count, first, last, mapped in reflectors.gone.rows[::-1].tolist():
        passing = (last - first) * 1e-9 < params.candidate_timeout
        state = MISSING if mapped and not passing else GHOST
        out.append(ReflectorState(state, key, id_, np.array(place), count, first, last, 0.0))
    return out


def _came_after(new: ReflectorState, old: ReflectorState) -> bool:
    """Whether one appeared where the other's surroundings were mapped."""
    came_then = (old.last - new.first) * 1e-9 < TOGETHER
    return new.state == NEW or (came_then and (old.last - old.first) * 1e-9 > SETTLED)


def _same(new: ReflectorState, old: ReflectorState) -> bool:
    if ANONYMOUS not in (new.id, old.id):
        return new.id == old.id
    return _gap(new, old) < FAR


def _grouped(ghosts: Iterable[ReflectorState]) -> list[ReflectorState]:
    """What was seen at one place again and again as one ghost."""
    out: list[ReflectorState] = []
    for g in ghosts:
        known = next((o for o in out if _gap(o, g) < 0.5), None)
        if known is None:
            out.append(g)
            continue
        known.sightings += g.sightings
        known.first, known.last = min(known.first, g.first), max(known.last, g.last)
    return out


def _gap(a: ReflectorState, b: ReflectorState) -> float:
    return float(np.hypot(*(a.place - b.place)))


def state_table(states: Iterable[ReflectorState]) -> str:
    """A row each, comma-separated."""
    rows = [','.join(COLUMNS)]
    for s in states:
        o = s.origin
        moved = '' if o is None else f'{o.key},{o.place[0]:.4f},{o.place[1]:.4f},{s.distance:.4f}'
        rows.append(
            f'{s.state},{s.key},{s.id},{s.place[0]:.4f},{s.place[1]:.4f},{s.sightings},'
            f'{s.first * 1e-9:.3f},{s.last * 1e-9:.3f},{s.probability:.4f},{moved or ",,,"}'
        )
    return '\n'.join(rows) + '\n'


def told(s: ReflectorState) -> str:
    """One that is not simply there, in a line for a person."""
    name = f'reflector {s.key}' + ('' if s.id == ANONYMOUS else f' (id {s.id})')
    at = f'at {s.place[0]:.2f}, {s.place[1]:.2f}'
    if s.origin is not None:
        x, y = s.origin.place
        return f'moved: {name} {at}, by {s.distance:.2f} m from {x:.2f}, {y:.2f}'
    return f'{s.state}: {name} {at}, seen {s.sightings} times'
