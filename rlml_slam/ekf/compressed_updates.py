# SPDX-License-Identifier: Apache-2.0
"""Effect of updates in a local region on the landmarks outside (Guivant, Nebot 2001).

With the covariance P_ba0 and B = P_ba0 of when the region was chosen ([P_ba0, J P_ba0] for an
invariant filter), the landmarks b outside follow from three small matrices:

    x_b <- x_b + B theta,   P_ba = B Phi^T,   P_bb <- P_bb + B Psi B^T
"""

from __future__ import annotations

import copy

import numpy as np

from rlml_slam.estimation.smoother import ROBOT
from rlml_slam.se2 import Array

PENDING = 128  # updates whose share in Psi is summed up at once


class CompressedUpdates:
    """``phi`` (n, m), ``psi`` (m, m) and ``theta`` (m,) of a region with a state of n values."""

    def __init__(self, n: int, invariant: bool) -> None:
        m = 2 * n if invariant else n
        self.phi = np.eye(n, m)
        self.theta = np.zeros(m)
        self._psi = np.zeros((m, m))
        self._pending: list[tuple[Array, Array]] = []

    @property
    def psi(self) -> Array:
        """The sum of all updates so far."""
        if self._pending:
            rows, weighted = (np.concatenate(part) for part in zip(*self._pending, strict=True))
            self._psi += rows.T @ weighted
            self._pending.clear()
        return self._psi

    def copy(self) -> CompressedUpdates:
        """Independent copy."""
        out = copy.copy(self)
        out.phi, out.theta, out._psi = self.phi.copy(), self.theta.copy(), self._psi.copy()
        out._pending = self._pending.copy()
        return out

    def predict(self, A: Array) -> None:
        """Motion of the robot with the Jacobian ``A``."""
        self.phi[:ROBOT] = A @ self.phi[:ROBOT]

    def append(self, rows: Array) -> None:
        """Append the rows (2, m) of a landmark that is added to the region."""
        self.phi = np.concatenate([self.phi, rows])

    def update(self, HPhi: Array, S_inv: Array, K: Array) -> None:
        """Kalman update with gain ``K`` and ``HPhi`` = H Phi."""
        self.phi -= K @ HPhi
        self._add(HPhi, -S_inv)

    def turn(self, turn: Turn, g: Array, c: Array, u: Array) -> None:
        """Turn of the error of an invariant filter, where B = [P_ba0, J P_ba0]."""
        moved = turn.moved(g)
        h, heading = _swap(moved), self.phi[2].copy()
        self.theta += moved
        self._add(np.stack([h, heading]), np.array([[c[2], 1.0], [1.0, 0.0]]))
        self.phi += np.stack([c, u], -1) @ np.stack([h, heading + c[2] * h])

    def _add(self, rows: Array, weight: Array) -> None:
        """Psi <- Psi + rows^T weight rows, PENDING rows at a time."""
        self._pending.append((rows, weight @ rows))
        if len(self._pending) >= PENDING:
            _ = self.psi


class Turn:
    """V = sin t/t + (1 - cos t)/t J of the exponential map, for a correction of the heading t."""

    def __init__(self, t: float) -> None:
        self._along = float(np.sinc(t / np.pi))
        self._across = float(np.sinc(0.5 * t / np.pi) * np.sin(0.5 * t))

    def step(self, dx: Array) -> tuple[Array, Array]:
        """``dx`` with V applied to position and landmarks, and J of that (0 elsewhere)."""
        step, u = dx.copy(), np.zeros(len(dx))
        for k in (slice(0, 2), slice(ROBOT, len(dx))):
            step[k] = self._along * dx[k] + self._across * quarter_turn(dx[k])
            u[k] = quarter_turn(step[k])
        return step, u

    def moved(self, coefficients: Array) -> Array:
        """V applied to B times the coefficients."""
        return self._along * coefficients + self._across * _swap(coefficients)


def quarter_turn(rows: Array) -> Array:
    """J (rows in pairs of x and y): each point (x, y) becomes (-y, x)."""
    out = np.empty_like(rows)
    out[0::2], out[1::2] = -rows[1::2], rows[0::2]
    return out


def _swap(coefficients: Array) -> Array:
    """J applied to B = [P_ba0, J P_ba0]: J B c = B [-c_2, c_1]."""
    first, second = np.split(coefficients, 2)
    return np.concatenate([-second, first])
