# SPDX-License-Identifier: Apache-2.0
"""The record of a loop closure: what was tried, why it was accepted, and what became of it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from rlml_slam.se2 import Array

NOTES = 50  # changes of the weight of a closure that are remembered


class State(Enum):
    """What a closure counts: what it is worth, nothing for now, nothing for good."""

    ACTIVE = 0
    DISABLED = 1
    REVOKED = 2


class Note(NamedTuple):
    """When the newest keyframe was ``keyframe``: squared Mahalanobis norm and robust weight."""

    keyframe: int
    residual: float
    weight: float


@dataclass
class Fate:
    """What becomes of a closure: state with reason, residual now, and its weight over time."""

    state: State = State.ACTIVE
    reason: str = ''
    residual: float = math.nan
    weight: float = math.nan  # the last one noted
    notes: deque[Note] = field(default_factory=lambda: deque(maxlen=NOTES))

    def note(self, keyframe: int, residual: float, weight: float) -> None:
        """Remember a weight."""
        self.notes.append(Note(keyframe, residual, weight))
        self.weight = weight

    def turn(self, state: State, reason: str) -> None:
        """Go over to another state."""
        self.state, self.reason = state, reason


@dataclass(frozen=True)
class Closure:
    """A loop closure that was tried: poses ``i`` (submap's anchor) and ``j``, and the verdict.

    ``edge`` is its index in ``graph.edges``, -1 where it was rejected; ``why`` says it in words.
    ``score`` is the mean hit probability, ``second`` that of the second-best place per the best
    one's (NaN where there is none), ``overlap`` the share of end points on walls. Those that were
    accepted are numbered from 0; ``fate`` is what has become of it since.
    """

    i: int
    j: int
    delta: Array
    score: float
    edge: int
    why: str
    overlap: float = math.nan
    second: float = math.nan
    number: int = -1
    fate: Fate = field(default_factory=Fate, compare=False)

    @property
    def accepted(self) -> bool:
        """Whether it entered the graph."""
        return self.edge >= 0
