# SPDX-License-Identifier: Apache-2.0
"""One reflector of the graph: what is known of it besides its place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from rlml_slam.graph.model.factor_table import Column
from rlml_slam.types import ANONYMOUS

# Seen from keyframe ``pose`` at ``z`` (2,) there; ``factor`` of the graph, -1 without one.
SIGHTING = np.dtype(
    [
        ('pose', np.int64),
        ('factor', np.int64),
        ('z', np.float64, (2,)),
        ('information', np.float64, (2, 2)),
    ]
)
# ``first`` and ``last`` stamps [ns] of its sightings; ``odds``: log of the odds that it is there;
# how often it was due and seen (``hits``) or not (``misses``); ``is_new``: earlier keyframes
# would have seen it, had it been there.
LIFE = np.dtype(
    [
        ('first', np.int64), ('last', np.int64), ('odds', np.float64), ('hits', np.int64),
        ('misses', np.int64), ('is_new', np.bool_),
    ]
)  # fmt: skip


Cell: TypeAlias = tuple[int, int]
# The same as rows: the reflector, the cell, and the two counts.
VIEW = np.dtype([(name, np.int64) for name in ('key', 'x', 'y', 'hits', 'misses')])


@dataclass
class Life:
    """The columns of LIFE, of one reflector."""

    first: int = 0
    last: int = 0
    odds: float = 0.0
    hits: int = 0
    misses: int = 0
    is_new: bool = False

    def seen(self, first: int, last: int) -> None:
        """It was seen between two stamps [ns]."""
        self.first = self.first or first
        self.last = max(self.last, last)

    def with_other(self, other: Life) -> Life:
        """The life of two that turned out to be one: what either was seen of."""
        firsts = [x.first for x in (self, other) if x.first]
        return Life(
            min(firsts, default=0), max(self.last, other.last), max(self.odds, other.odds),
            self.hits + other.hits, self.misses + other.misses, self.is_new and other.is_new,
        )  # fmt: skip


@dataclass
class Landmark:
    """One reflector of the graph; ``beside`` are the keys of those seen with it at one time.

    ``surveyed`` is its row in the survey, -1 where it is not in it. ``views`` has, by the cell of
    the floor, how often it was seen from there and how often not when it should have been.
    """

    key: int
    index: int = -1
    id: int = ANONYMOUS
    diameter: float = float('nan')
    count: int = 0
    sightings: Column = field(default_factory=lambda: Column((), SIGHTING))
    beside: set[int] = field(default_factory=set)
    surveyed: int = -1
    life: Life = field(default_factory=Life)
    views: dict[Cell, tuple[int, int]] = field(default_factory=dict)
