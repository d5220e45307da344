# SPDX-License-Identifier: Apache-2.0
"""Reflector of the graph: its sightings, identity and detection history."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from rlml_slam.graph import Column
from rlml_slam.types import ANONYMOUS

# Seen from keyframe ``pose`` at ``z`` (2,) in its frame; ``factor`` of the graph, -1 without one.
SIGHTING = np.dtype(
    [
        ('pose', np.int64),
        ('factor', np.int64),
        ('z', np.float64, (2,)),
        ('information', np.float64, (2, 2)),
    ]
)
# ``first`` and ``last`` stamps [ns] of its sightings; ``odds``: log odds of being present; how
# often it was detected (``hits``) or not (``misses``) when it was visible; ``is_new``: earlier
# keyframes would have seen it, had it been present.
HISTORY = np.dtype(
    [
        ('first', np.int64), ('last', np.int64), ('odds', np.float64), ('hits', np.int64),
        ('misses', np.int64), ('is_new', np.bool_),
    ]
)  # fmt: skip


Cell: TypeAlias = tuple[int, int]
# Detection counts of reflector ``key`` from cell (x, y) of the floor.
VIEW = np.dtype([(name, np.int64) for name in ('key', 'x', 'y', 'hits', 'misses')])


@dataclass
class DetectionHistory:
    """The columns of HISTORY, of one reflector."""

    first: int = 0
    last: int = 0
    odds: float = 0.0
    hits: int = 0
    misses: int = 0
    is_new: bool = False

    def add_sighting(self, first: int, last: int) -> None:
        """Extend to a sighting between two stamps [ns]."""
        self.first = self.first or first
        self.last = max(self.last, last)

    def merged(self, other: DetectionHistory) -> DetectionHistory:
        """History of two reflectors that are one."""
        firsts = [x.first for x in (self, other) if x.first]
        return DetectionHistory(
            min(firsts, default=0), max(self.last, other.last), max(self.odds, other.odds),
            self.hits + other.hits, self.misses + other.misses, self.is_new and other.is_new,
        )  # fmt: skip


@dataclass
class Landmark:
    """Reflector; ``index`` in the graph, -1 for a candidate that is not in it yet.

    ``seen_together`` are the keys of those seen from one keyframe with it; ``surveyed`` is its row
    in the survey, -1 without one. ``views`` has the detections and misses by cell of the floor.
    """

    key: int
    index: int = -1
    id: int = ANONYMOUS
    diameter: float = float('nan')
    count: int = 0
    sightings: Column = field(default_factory=lambda: Column((), SIGHTING))
    seen_together: set[int] = field(default_factory=set)
    surveyed: int = -1
    history: DetectionHistory = field(default_factory=DetectionHistory)
    views: dict[Cell, tuple[int, int]] = field(default_factory=dict)

    def has_other_identity(self, other: Landmark) -> bool:
        """Whether two have different ids, or different rows of the survey."""
        named = ANONYMOUS not in (self.id, other.id) and self.id != other.id
        both = self.surveyed >= 0 and other.surveyed >= 0
        return named or (both and self.surveyed != other.surveyed)

    def is_distinct(self, other: Landmark) -> bool:
        """Whether two have different identities, or were seen from one keyframe."""
        return self.has_other_identity(other) or other.key in self.seen_together

    def absorb(self, other: Landmark) -> None:
        """Take over identity and history of a reflector that is the same."""
        self.history = self.history.merged(other.history)
        for cell, (hits, misses) in other.views.items():
            own = self.views.get(cell, (0, 0))
            self.views[cell] = own[0] + hits, own[1] + misses
        self.seen_together |= other.seen_together
        self.count += other.count
        self.id = other.id if self.id == ANONYMOUS else self.id
        self.diameter = other.diameter if math.isnan(self.diameter) else self.diameter


def in_order_of_rank(a: Landmark, b: Landmark) -> tuple[Landmark, Landmark]:
    """Two reflectors, first the one to keep: in the graph before candidates, surveyed first."""
    better = (b.index >= 0, b.surveyed >= 0) > (a.index >= 0, a.surveyed >= 0)
    return (b, a) if better else (a, b)
