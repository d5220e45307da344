# SPDX-License-Identifier: Apache-2.0
"""Record of a loop closure: the match, why it was accepted or rejected, and its state since."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from rlml_slam.se2 import Array

HISTORY_LENGTH = 50  # changes of weight that are kept per closure


class State(Enum):
    """Active; disabled until it agrees with the others again; revoked by the user for good."""

    ACTIVE = 0
    DISABLED = 1
    REVOKED = 2


class WeightChange(NamedTuple):
    """Squared Mahalanobis norm and robust weight when ``keyframe`` was the newest keyframe."""

    keyframe: int
    residual: float
    weight: float


@dataclass
class ClosureStatus:
    """Current state with its reason, current residual, and history of the weight."""

    state: State = State.ACTIVE
    reason: str = ''
    residual: float = math.nan
    weight: float = math.nan  # the last one recorded
    history: deque[WeightChange] = field(default_factory=lambda: deque(maxlen=HISTORY_LENGTH))

    def record(self, keyframe: int, residual: float, weight: float) -> None:
        """Append a weight to the history."""
        self.history.append(WeightChange(keyframe, residual, weight))
        self.weight = weight

    def set_state(self, state: State, reason: str) -> None:
        """Change the state."""
        self.state, self.reason = state, reason


@dataclass(frozen=True)
class Closure:
    """Loop closure candidate between poses ``i`` (submap's anchor) and ``j``, with its result.

    ``edge`` is its index in ``graph.edges``, -1 where it was rejected; ``why`` gives the reason.
    ``score`` is the mean hit probability, ``second`` the score of the second-best pose divided by
    the best one's (NaN where there is none), ``overlap`` the share of end points on walls.
    Accepted closures are numbered from 0; ``status`` is shared by all copies of a record.
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
    status: ClosureStatus = field(default_factory=ClosureStatus, compare=False)

    @property
    def accepted(self) -> bool:
        """Whether it was added to the graph."""
        return self.edge >= 0
