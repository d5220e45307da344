# SPDX-License-Identifier: Apache-2.0
"""Fixed-interval smoother of the EKF: the most probable path by all measurements, Gauss-Newton.

The residuals are those of the filter's own model: motions with their random-walk errors, and each
measurement of a landmark with the association that the filter chose. The first
Gauss-Newton step about the filter's path is the fixed-interval (Rauch-Tung-Striebel) smoother of
the linearised model; the others linearise about the smoothed path (iterated smoother: Bell 1994),
which removes the errors of the filter's early linearisations. The normal equations are sparse, so
memory grows with the steps and measurements alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.estimation.landmark_models import Model
from rlml_slam.se2 import Array
from rlml_slam.types import Motion

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import SuperLU

BIAS, SPEED, TURN, ROBOT = 3, 4, 5, 6  # after the pose: gyro bias, scale errors; size of the state
ITERATIONS = 20
CONVERGED = 1e-6  # [m], [rad] of the largest correction
MIN_SHARE = 1e-3  # of a step, at which the line search ends
BATCH = 32  # landmarks whose covariances are solved for together
MIN_SIGMA = 1e-6  # [m], [rad] added to every residual, so that covariances can be inverted


@dataclass(frozen=True)
class Sight:
    """The landmark ``key`` measured as z (2,) with R (2, 2)."""

    key: int
    z: Array
    R: Array


@dataclass(frozen=True)
class Step:
    """One step of the filter: its ``motion`` and the landmarks measured after it.

    ``walk`` and ``kept`` as :meth:`Filter.predict` takes them.
    """

    motion: Motion
    walk: float
    kept: float
    sights: tuple[Sight, ...] = ()


@dataclass(frozen=True)
class Start:
    """The robot (6,) before the first step, and its covariance (6, 6)."""

    x: Array
    P: Array


@dataclass(frozen=True)
class Smoothed:
    """States (n, 6) of the robot after each step, and the landmarks (m, 2) of the ``keys``.

    ``start`` (6,) is the state before the first step, ``covs`` (m, 2, 2) the landmarks' marginal
    covariances.
    """

    start: Array
    states: Array
    keys: NDArray[np.int64]
    points: Array
    covs: Array


class _Rows:
    """Whitened rows of J dx = -e, as they come."""

    def __init__(self) -> None:
        self._i: list[NDArray[np.int64]] = []
        self._j: list[NDArray[np.int64]] = []
        self._v: list[Array] = []
        self._e: list[Array] = []
        self._n = 0

    def add(self, cov: Array, e: Array, *blocks: tuple[NDArray[np.int64], Array]) -> None:
        """Errors e (k, r) of covariances (k, r, r), with (columns (k, c), J (k, r, c)) of each."""
        k, r = e.shape
        L = np.linalg.cholesky(cov + MIN_SIGMA**2 * np.eye(r))
        rows = self._n + np.arange(k * r).reshape(k, r)
        self._e.append(np.linalg.solve(L, e[..., None]).ravel())
        for columns, J in blocks:
            shape = (k, r, columns.shape[1])
            self._v.append(np.linalg.solve(L, J).ravel())
            self._i.append(np.broadcast_to(rows[:, :, None], shape).ravel())
            self._j.append(np.broadcast_to(columns[:, None, :], shape).ravel())
        self._n += k * r

    def errors(self) -> Array:
        """All errors."""
        return np.concatenate(self._e)

    def jacobian(self, width: int) -> csc_matrix:
        """J (rows, width)."""
        # takes a while to import, which other commands need not wait for
        from scipy.sparse import csc_matrix

        at = np.concatenate(self._i), np.concatenate(self._j)
        return csc_matrix((np.concatenate(self._v), at), shape=(self._n, width))

    def step(self, width: int) -> Array:
        """The dx (width,) of the least squares."""
        J = self.jacobian(width)
        return np.asarray(_factor(J).solve(-(J.T @ self.errors())))

    def covariances(self, width: int, first: int) -> Array:
        """Blocks (m, 2, 2) on the diagonal of (J^T J)^-1, of the last columns from ``first`` on.

        They are the joint information with all else eliminated, inverted (Schur complement).
        """
        normal = _factor(self.jacobian(width))
        out = np.empty(((width - first) // 2, 2, 2))
        for at in range(0, len(out), BATCH):
            columns = first + 2 * at + np.arange(2 * min(BATCH, len(out) - at))
            unit = np.zeros((width, len(columns)))
            unit[columns, np.arange(len(columns))] = 1.0
            block = normal.solve(unit)[columns]
            for k in range(len(columns) // 2):
                cov = block[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
                out[at + k] = 0.5 * (cov + cov.T)
        return out


def _factor(J: csc_matrix) -> SuperLU:
    """Factors of the normal equations J^T J."""
    # takes a while to import, which other commands need not wait for
    from scipy.sparse.linalg import splu

    return splu(
        (J.T @ J).tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
        options={'SymmetricMode': True},
    )  # fmt: skip


class _Problem:
    """The model's errors about a path ``x`` (n + 1, 6), the start first, and ``points`` (m, 2)."""

    def __init__(self, start: Start, steps: Sequence[Step], model: Model) -> None:
        self._start, self._model = start, model
        motions = [s.motion for s in steps]
        # of all measurements: row of their state, and of their landmark
        self._row = np.repeat(np.arange(1, len(steps) + 1), [len(s.sights) for s in steps])
        sights = [q for s in steps for q in s.sights]
        self.keys, self._slot = np.unique(
            np.array([q.key for q in sights], dtype=np.int64), return_inverse=True
        )
        self._z = np.array([q.z for q in sights]).reshape(-1, 2)
        self._R = np.array([q.R for q in sights]).reshape(-1, 2, 2)
        self._delta, self._bias_gain, self._turn_gain = (
            np.array([getattr(m, name) for m in motions])
            for name in ('delta', 'bias_gain', 'turn_gain')
        )
        self._cov = np.array([m.cov for m in motions])
        self._kept = np.array([s.kept for s in steps])
        self._walk = np.array([s.walk for s in steps])
        # measurements of the gyro bias by standstill and wheels, where there are any
        self._with_bias = np.flatnonzero([np.isfinite(m.bias_var) for m in motions])
        self._bias, self._bias_var, self._bias_turn = (
            np.array([getattr(motions[k], name) for k in self._with_bias])
            for name in ('bias', 'bias_var', 'bias_turn')
        )

    def rows(self, x: Array, points: Array) -> _Rows:
        """Errors and Jacobians there."""
        out = _Rows()
        n = len(x)
        at = ROBOT * np.arange(n)[:, None] + np.arange(ROBOT)
        # the start
        e = x[0] - self._start.x
        e[2] = se2.wrap(e[2])
        out.add(self._start.P[None], e[None], (at[:1], np.eye(ROBOT)[None]))
        self._motions(out, x, at)
        self._walks(out, x, at)
        self._measurements(out, x, points, at)
        return out

    def _motions(self, out: _Rows, x: Array, at: NDArray[np.int64]) -> None:
        """Residuals of the motions: odometry corrected by bias and scale errors."""
        before, after = x[:-1], x[1:]
        delta = (
            self._delta
            + self._bias_gain * before[:, BIAS, None]
            + self._turn_gain * before[:, TURN, None]
        )
        scale = np.ones((len(before), 3))
        scale[:, :2] += before[:, SPEED, None]
        way = np.concatenate([delta[:, :2], np.zeros((len(delta), 1))], axis=1)
        e = se2.between(before[:, :3], after[:, :3]) - scale * delta
        e[:, 2] = se2.wrap(e[:, 2])
        J_a, J_b = se2.between_jacobians(before[:, :3], after[:, :3])
        gains = np.stack([scale * self._bias_gain, way, scale * self._turn_gain], axis=-1)
        J = np.concatenate([J_a, -gains], axis=-1)
        out.add(self._cov, e, (at[:-1], J), (at[1:, :3], J_b))

    def _walks(self, out: _Rows, x: Array, at: NDArray[np.int64]) -> None:
        """Residuals of the random walks: gyro bias; scale errors as first-order Gauss-Markov."""
        before, after = x[:-1], x[1:]
        one = np.ones((len(before), 1, 1))
        out.add(
            self._walk[:, None, None], after[:, BIAS, None] - before[:, BIAS, None],
            (at[:-1, BIAS, None], -one), (at[1:, BIAS, None], one),
        )  # fmt: skip
        for k in range(SPEED, TURN + 1):
            new = (1.0 - self._kept**2) * self._start.P[k, k]
            e = after[:, k] - self._kept * before[:, k]
            out.add(
                new[:, None, None], e[:, None],
                (at[:-1, k, None], -self._kept[:, None, None]), (at[1:, k, None], one),
            )  # fmt: skip
        rows = self._with_bias
        if not len(rows):
            return
        H = np.stack([np.ones(len(rows)), self._bias_turn], axis=-1)[:, None]
        columns = at[rows][:, [BIAS, TURN]]
        e = (H[:, 0] * x[rows][:, [BIAS, TURN]]).sum(axis=1) - self._bias
        out.add(self._bias_var[:, None, None], e[:, None], (columns, H))

    def _measurements(self, out: _Rows, x: Array, points: Array, at: NDArray[np.int64]) -> None:
        """Residuals of the measured landmarks."""
        h, H_r, H_m = self._model.observe(x[self._row, :3], points[self._slot])
        columns = ROBOT * len(x) + 2 * self._slot[:, None] + np.arange(2)
        nu = self._model.innovation(self._z, h)
        out.add(self._R, -nu, (at[self._row, :3], H_r), (columns, H_m))

    def first_points(self, poses: Array) -> Array:
        """Start (m, 2) of each landmark by its last measurement, from the ``poses`` (n, 3)."""
        last = np.zeros(len(self.keys), dtype=np.int64)
        np.maximum.at(last, self._slot, np.arange(len(self._slot)))
        return self._model.place(poses[self._row[last] - 1], self._z[last])[0]


def smooth(
    start: Start, steps: Sequence[Step], model: Model, poses: Array, iterations: int = ITERATIONS
) -> Smoothed:
    """The path (n,) and the landmarks; ``poses`` (n, 3) are the filter's, to begin with."""
    problem = _Problem(start, steps, model)
    x = np.tile(start.x, (len(steps) + 1, 1))
    x[1:, :3] = poses
    points = problem.first_points(poses)
    rows = problem.rows(x, points)
    cost = float(rows.errors() @ rows.errors())
    for _ in range(iterations):
        dx = rows.step(x.size + points.size)
        share, best = 1.0, rows
        while True:
            moved = x + share * dx[: x.size].reshape(x.shape)
            moved[:, 2] = se2.wrap(moved[:, 2])
            placed = points + share * dx[x.size :].reshape(points.shape)
            rows = problem.rows(moved, placed)
            new = float(rows.errors() @ rows.errors())
            if new <= cost * (1.0 + 1e-9):
                break
            share *= 0.5
            if share < MIN_SHARE:  # no lower cost along the step, or it is not finite
                return _smoothed(problem, best, x, points)
        x, points, cost = moved, placed, new
        if np.abs(share * dx).max() < CONVERGED:
            break
    return _smoothed(problem, rows, x, points)


def _smoothed(problem: _Problem, rows: _Rows, x: Array, points: Array) -> Smoothed:
    """The result, with the landmarks' covariances by the ``rows`` there."""
    covs = rows.covariances(x.size + points.size, x.size)
    return Smoothed(x[0], x[1:], problem.keys, points, covs)
