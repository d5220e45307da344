# SPDX-License-Identifier: Apache-2.0
"""The pinned experiment: three features that move and deform, twenty poses, eight rows.

State of one step, (n,) with n = 3 + 2 M: (x, y, theta, f_1x, f_1y, ... f_Mx, f_My), metres and
radians in the frame of the first pose, which is exactly 0. The heading is counted, not wrapped,
by the truth and by every estimator alike. S runs are arrays with a leading S.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from rlml_slam.deformable.model import Indices, Sensor
from rlml_slam.se2 import Array

STEPS = 20
FEATURES = 3
TRAVEL = 2.0  # m per step
TURN = np.pi / 10.0  # rad per step on the circle
START_FEATURES = np.array([[0.5, 0.5], [0.9, 0.8], [0.3, 0.4]])

PATHS = ('straight', 'circle')
SENSINGS = ('fixed', 'changing')
CONTROLS = ('predetermined', 'active')


SENSORS = {
    'fixed': Sensor(0.1, 2.0, 0.05, 0.05),
    'changing': Sensor(0.1, 2.0, 0.001, 0.09),
}


class Row(NamedTuple):
    """One row of the table."""

    path: str
    sensing: str
    control: str

    @property
    def name(self) -> str:
        """The name as the note writes it, e.g. ``circle fixed active``."""
        return f'{self.path} {self.sensing} {self.control}'


ROWS = tuple(Row(p, s, c) for c, s, p in product(CONTROLS, SENSINGS, PATHS))


@dataclass(frozen=True)
class Nominal:
    """The plan of one path.

    ``control`` (N-1, 3) = (v_x, v_y, omega) per step, in the robot's frame; ``translation``
    (N-1+H, 2) t_i of the features, H steps longer than the run so that a plan can look past it.
    """

    control: Array
    translation: Array


@dataclass(frozen=True)
class Draws:
    """Standard normal numbers of S runs; every row uses the same ones, so rows are paired."""

    odometry: Array  # (S, N-1, 3): x, y, theta
    drift: Array  # (S, N-1, M, 2)
    feature: Array  # (S, N, M, 2)
    edge: Array  # (S, N, E, 2)


@dataclass(frozen=True)
class Measurements:
    """All that an estimator is given of S runs; nothing here is known to the truth alone.

    ``control`` (S, N-1, 3) as in Nominal; ``drift`` (S, N-1, M, 2) the smooth measurement, which
    is the nominal translation; ``feature`` (S, N, M, 2) in the robot's frame with ``sigma``
    (S, N, M), both NaN where a feature was not seen; ``edge`` (S, N, E, 2) for edges(M), NaN
    where it was not measured.
    """

    control: Array
    drift: Array
    feature: Array
    sigma: Array
    edge: Array

    def __post_init__(self) -> None:
        """Lay the arrays out densely: one memory layout is one compilation of each kernel."""
        for name in ('control', 'drift', 'feature', 'sigma', 'edge'):
            dense = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, dense)


def edges(num_features: int) -> Indices:
    """Pairs (j1, j2), j1 < j2, of the construction measurements, (E, 2): (1,2), (1,3), (2,3)."""
    return np.stack(np.triu_indices(num_features, 1), -1).astype(np.int64)


def nominal(path: str, lookahead: int = 6) -> Nominal:
    """The plan of ``path``, 'straight' or 'circle'."""
    turn = TURN if path == 'circle' else 0.0
    v = TRAVEL * np.array([np.cos(turn / 2.0), np.sin(turn / 2.0)])
    control = np.tile(np.append(v, turn), (STEPS - 1, 1))
    phi = (np.arange(STEPS - 1 + lookahead) + 0.5) * turn  # (i - 1/2) pi/10 with i from 1
    return Nominal(control, TRAVEL * np.stack([np.cos(phi), np.sin(phi)], -1))


def draw(seeds: range) -> Draws:
    """Each run's noise from its own seed alone, always in this order."""
    E = len(edges(FEATURES))
    shapes = ((STEPS - 1, 3), (STEPS - 1, FEATURES, 2), (STEPS, FEATURES, 2), (STEPS, E, 2))
    runs = []
    for seed in seeds:
        generator = np.random.default_rng(seed)
        runs.append([generator.standard_normal(shape) for shape in shapes])
    return Draws(*(np.stack(parts) for parts in zip(*runs, strict=True)))
