# SPDX-License-Identifier: Apache-2.0
"""The filter: predict, update, augment, over the landmarks near the robot; the others later.

State (x, y, theta, b, s, t, x_1, y_1, ...): the note's, with the bias b of the gyro, which stays
where it is without an IMU, and the shares s and t by which the robot is faster and turns more than
its wheels tell: radius and track of wheels, and what they slip on a floor, err for long. Only the
robot and the landmarks of a local region are worked on. What an update means for the landmarks
beyond it is collected in three small matrices and applied when the region changes (compressed
filter: Guivant, Nebot 2001), which gives the same state exactly.

The note's filter believes that it knows its heading in the map from landmarks alone, which it
cannot: turning everything about the origin changes no measurement, but once the estimate has moved
between two linearisations, the Jacobians no longer say so, and the covariance becomes too small.
An ``invariant`` filter (right-invariant EKF: Barrau, Bonnabel 2015) moves position and landmarks
along with the heading by which the error is turned, and is consistent there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.estimation.landmark_models import Model
from rlml_slam.estimation.smoother import BIAS, ROBOT, SPEED, TURN
from rlml_slam.se2 import Array
from rlml_slam.types import Motion

WHEELS = slice(SPEED, TURN + 1)
JOINED = 1e-3  # [m] what the places of one landmark may differ by
PENDING = 128  # updates whose share in Psi is summed up at once


class Filter:
    """Mean ``x`` (6 + 2a,) and covariance ``P`` of robot and local landmarks ``local`` (a,).

    Landmarks are numbered 0, 1, ... in the order they were added; those not in ``local`` are as
    of the last :meth:`settle`. In a filter whose region is never chosen all landmarks are local.
    """

    def __init__(
        self,
        pose: Array,
        cov: Array,
        bias_sigma: float,
        model: Model,
        invariant: bool = False,
        wheels: Sequence[float] = (0.0, 0.0),
    ) -> None:
        """``wheels`` (2,): 1 sigma of the shares; with zeros, the filter without them."""
        self.model = model
        self.invariant = invariant
        self.x = np.zeros(ROBOT)
        self.x[:3] = pose
        self.P = np.zeros((ROBOT, ROBOT))
        self.P[:3, :3] = cov
        self.P[BIAS, BIAS] = bias_sigma**2
        self._wheels2 = np.diag(np.square(wheels))
        self.P[WHEELS, WHEELS] = self._wheels2
        self.local = np.zeros(0, dtype=np.int64)
        self.num_landmarks = 0
        self._others = np.zeros(0, dtype=np.int64)
        self._x = self.x.copy()
        self._P = self.P.copy()
        self._phi: Array | None = None
        self._psi = np.zeros((0, 0))
        self._theta = np.zeros(0)
        self._pending: list[tuple[Array, Array]] = []

    # --- step 1 ----------------------------------------------------------------------------

    def predict(self, motion: Motion, walk: float = 0.0, kept: float = 1.0) -> bool:
        """Move the robot: P_rr <- A P_rr A^T + Q, P_ri <- A P_ri (eq. 15, 16), in O(n).

        Q = W C W^T is the motion's covariance turned into the map. Meanwhile the gyro's bias
        gained the variance ``walk``, and of what the wheels err by a share of ``kept`` is left,
        the rest is new (Gauss-Markov process). The answer is whether what IMU and wheels say of
        the bias was used.
        """
        took = np.isfinite(motion.bias_var) and self._measure_bias(motion)
        delta, gains = self.corrected(motion)
        J_a, J_b = se2.compose_jacobians(self.x[:3], delta)
        self.x[:3] = se2.compose(self.x[:3], delta)
        self.x[WHEELS] *= kept
        A = np.eye(ROBOT)
        A[:3, :3] = J_a
        A[:3, BIAS:ROBOT] = J_b @ gains
        A[WHEELS, WHEELS] *= kept
        P = self.P
        P[:ROBOT, ROBOT:] = A @ P[:ROBOT, ROBOT:]
        P[ROBOT:, :ROBOT] = P[:ROBOT, ROBOT:].T
        rr = A @ P[:ROBOT, :ROBOT] @ A.T
        rr[:3, :3] += J_b @ motion.cov @ J_b.T
        rr[BIAS, BIAS] += walk
        rr[WHEELS, WHEELS] += (1.0 - kept**2) * self._wheels2
        P[:ROBOT, :ROBOT] = 0.5 * (rr + rr.T)
        if self._phi is not None:
            self._phi[:ROBOT] = A @ self._phi[:ROBOT]
        return bool(took)

    def corrected(self, motion: Motion) -> tuple[Array, Array]:
        """The motion (3,) by what is known of gyro and wheels; d motion / d (b, s, t) (3, 3)."""
        delta = motion.delta + motion.bias_gain * self.x[BIAS] + motion.turn_gain * self.x[TURN]
        way, faster = np.array([delta[0], delta[1], 0.0]), 1.0 + self.x[SPEED]
        scale = np.array([faster, faster, 1.0])
        gains = np.stack([scale * motion.bias_gain, way, scale * motion.turn_gain], axis=1)
        return scale * delta, gains

    def _measure_bias(self, motion: Motion) -> bool:
        """What IMU and wheels together say of the bias, gated against slip; whether it passed."""
        columns, H = np.array([BIAS, TURN]), np.array([[1.0, motion.bias_turn]])
        error = motion.bias - float(H[0] @ self.x[columns])
        variance = float(H[0] @ self.P[np.ix_(columns, columns)] @ H[0]) + motion.bias_var
        passed = error * error < 16.0 * variance
        if passed:
            self.apply(columns, H, np.array([[motion.bias_var]]), np.array([error]))
        return passed

    # --- step 2 ----------------------------------------------------------------------------

    def update(self, slot: int, z: Array, R: Array) -> None:
        """Use one re-observed landmark, the ``slot``-th of ``local``: z (2,) with R (2, 2)."""
        a = ROBOT + 2 * slot
        h, H_r, H_m = self.model.observe(self.x[:3], self.x[None, a : a + 2])
        columns = np.array([0, 1, 2, a, a + 1])
        nu = self.model.innovation(z, h[0])
        self.apply(columns, np.concatenate([H_r[0], H_m[0]], axis=1), R, nu)

    def apply(self, columns: NDArray[np.int64], H: Array, R: Array, nu: Array) -> None:
        """Kalman update X <- X + K nu for nu = H dx[columns] + noise of covariance R, in O(n^2).

        Joseph form (I - KH) P (I - KH)^T + K R K^T, multiplied out with W = H P:
        P - K W - W^T K^T + K S K^T, written so that P stays symmetric to the last bit.
        """
        W = H @ self.P[columns]
        S = W[:, columns] @ H.T + R
        S = 0.5 * (S + S.T)
        S_inv = np.asarray(np.linalg.inv(S), dtype=np.float64)
        K = W.T @ S_inv
        dx = K @ nu
        left, right = K, 0.5 * S @ K.T - W  # P <- P + left right + (left right)^T
        turn = _Turn(dx[2]) if self.invariant else None
        u = c = np.zeros(0)
        if turn is not None:
            # The error is xi_theta = dtheta, xi_p = dp - J p dtheta, and the same for landmarks,
            # J = R(90 deg). exp moves a point m by V dm; xi keeping its covariance, dm gains
            # J (m_after - m_before) dtheta: P <- M P M^T with M = I + u e_theta^T
            c = self.P[2] + K[2] @ right + K @ right[:, 2]
            dx, u = turn.step(dx)
            left = np.concatenate([K, u[:, None]], axis=1)
            right = np.concatenate([right, (c + 0.5 * c[2] * u)[None]])
        if self._phi is not None:
            HPhi = H @ self._phi[columns]
            self._pass_on(HPhi, S_inv, nu, K)
            if turn is not None:
                self._pass_on_turn(turn, HPhi.T @ (S_inv @ nu), c, u)
            else:
                self._theta += HPhi.T @ (S_inv @ nu)
        self.x += dx
        self.x[2] = se2.wrap(self.x[2])
        M = left @ right
        self.P += M + M.T

    def _pass_on(self, HPhi: Array, S_inv: Array, nu: Array, K: Array) -> None:
        """What an update is to the landmarks beyond: P_bb, P_ba, in terms of P_ba0."""
        assert self._phi is not None
        self._phi -= K @ HPhi
        self._collect(HPhi, -S_inv)

    def _pass_on_turn(self, turn: _Turn, g: Array, c: Array, u: Array) -> None:
        """The turn of the error for the landmarks beyond, where B = [P_ba0, J P_ba0]."""
        assert self._phi is not None
        moved = turn.moved(g)
        h, heading = _swap(moved), self._phi[2].copy()
        self._theta += moved
        self._collect(np.stack([h, heading]), np.array([[c[2], 1.0], [1.0, 0.0]]))
        self._phi += np.stack([c, u], -1) @ np.stack([h, heading + c[2] * h])

    def _collect(self, rows: Array, weight: Array) -> None:
        """Psi <- Psi + rows^T weight rows, some hundred rows at a time."""
        self._pending.append((rows, weight @ rows))
        if len(self._pending) >= PENDING:
            self._sum_up()

    def _sum_up(self) -> None:
        if self._pending:
            rows, weighted = (np.concatenate(part) for part in zip(*self._pending, strict=True))
            self._psi += rows.T @ weighted
            self._pending.clear()

    # --- step 3 ----------------------------------------------------------------------------

    def augment(self, z: Array, R: Array) -> int:
        """Add the landmark measured as z (2,) with R (2, 2); its number.

        P_NN = J_xr P_rr J_xr^T + J_z R J_z^T, P_Ni = J_xr P_ri for every i.
        """
        m, J_xr, J_z = self.model.place(self.x[:3], z[None])
        n = len(self.x)
        self.x = np.concatenate([self.x, m[0]])
        P = np.empty((n + 2, n + 2))
        P[:n, :n] = self.P
        P[n:, :n] = J_xr[0] @ self.P[:3]
        P[:n, n:] = P[n:, :n].T
        new = J_xr[0] @ self.P[:3, :3] @ J_xr[0].T + J_z[0] @ R @ J_z[0].T
        P[n:, n:] = 0.5 * (new + new.T)
        self.P = P
        if self._phi is not None:
            self._phi = np.concatenate([self._phi, J_xr[0] @ self._phi[:3]])
        return self._append()

    def fix(self, point: Array, cov: Array) -> int:
        """Add a landmark of a given map, independent of the rest; its number."""
        n = len(self.x)
        P = np.zeros((n + 2, n + 2))
        P[:n, :n], P[n:, n:] = self.P, cov
        self.x, self.P = np.concatenate([self.x, point]), P
        if self._phi is not None:
            self._phi = np.concatenate([self._phi, np.zeros((2, self._phi.shape[1]))])
        return self._append()

    def join(self, a: int, b: int) -> None:
        """Landmarks a and b are one: 0 = m_a - m_b, a measurement without noise to speak of.

        b leaves the state, and the landmarks after it move up by one number.
        """
        self.settle()
        columns = np.concatenate([self._columns(np.array([a])), self._columns(np.array([b]))])
        H = np.concatenate([np.eye(2), -np.eye(2)], axis=1)
        self.apply(columns, H, JOINED**2 * np.eye(2), -H @ self.x[columns])
        keep = np.delete(np.arange(len(self.x)), columns[2:])
        self.x, self.P = self.x[keep], self.P[np.ix_(keep, keep)]
        self.num_landmarks -= 1
        self.local = np.arange(self.num_landmarks)

    def _append(self) -> int:
        self.local = np.append(self.local, self.num_landmarks)
        self.num_landmarks += 1
        return self.num_landmarks - 1

    # --- the local region ------------------------------------------------------------------

    def settle(self) -> None:
        """Bring the landmarks beyond the region up to date; afterwards all are local."""
        if not len(self._others):
            return
        assert self._phi is not None
        a, b = self._rows(self.local), self._columns(self._others)
        a0 = self._rows(self.local[self.local < len(self._x[ROBOT:]) // 2])
        n, before = ROBOT + 2 * self.num_landmarks, len(self._x)
        B = self._P[np.ix_(b, a0)]
        if self.invariant:
            B = np.concatenate([B, _quarter_turn(B)], axis=1)
        x, P = np.empty(n), self._P
        if n > before:
            P = np.zeros((n, n))
            P[:before, :before] = self._P
        x[a], x[b] = self.x, self._x[b] + B @ self._theta
        # P_bb <- P_bb + B Psi B^T, symmetric to the last bit
        self._sum_up()
        D = 0.5 * (B @ self._psi @ B.T)
        P[np.ix_(b, b)] += D + D.T
        P[np.ix_(b, a)] = P_ba = B @ self._phi.T
        P[np.ix_(a, b)] = P_ba.T
        P[np.ix_(a, a)] = self.P
        self.x, self.P, self._phi = x, P, None
        self.local = np.arange(self.num_landmarks)
        self._others = np.zeros(0, dtype=np.int64)

    def choose(self, keep: NDArray[np.bool_]) -> None:
        """Work on the landmarks where ``keep`` (m,) is true alone, from now on."""
        self.settle()
        if keep.all():
            return
        self.local, self._others = np.flatnonzero(keep), np.flatnonzero(~keep)
        self._x, self._P = self.x, self.P
        a = self._rows(self.local)
        self.x, self.P = self._x[a], self._P[np.ix_(a, a)]
        width = 2 * len(a) if self.invariant else len(a)
        self._phi = np.eye(len(a), width)
        self._psi = np.zeros((width, width))
        self._theta = np.zeros(width)

    @staticmethod
    def _columns(landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
        first = ROBOT + 2 * landmarks
        return np.stack([first, first + 1], -1).ravel()

    def _rows(self, landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.concatenate([np.arange(ROBOT), self._columns(landmarks)])

    # --- what it knows -----------------------------------------------------------------------

    @property
    def pose(self) -> Array:
        """Pose (3,)."""
        return self.x[:3].copy()

    @property
    def pose_cov(self) -> Array:
        """Covariance (3, 3) of the pose."""
        return self.P[:3, :3].copy()

    @property
    def points(self) -> Array:
        """Local landmarks (a, 2)."""
        return self.x[ROBOT:].reshape(-1, 2)

    def point_covs(self) -> Array:
        """Marginal covariances (a, 2, 2) of the local landmarks."""
        m = len(self.local)
        k = np.arange(m)
        out: Array = self.P[ROBOT:, ROBOT:].reshape(m, 2, m, 2)[k, :, k, :]
        return out

    def landmarks(self) -> Array:
        """All landmarks (m, 2); those beyond the region as of when it was chosen."""
        out = np.empty((self.num_landmarks, 2))
        out[self.local] = self.points
        out[self._others] = self._x[self._columns(self._others)].reshape(-1, 2)
        return out

    def difference_cov(self, a: int, b: int) -> Array:
        """Covariance (2, 2) of the difference of two local landmarks."""
        i, j = (slice(ROBOT + 2 * k, ROBOT + 2 * k + 2) for k in (a, b))
        out: Array = self.P[i, i] + self.P[j, j] - self.P[i, j] - self.P[j, i]
        return out

    def pose_and_points_cov(self) -> Array:
        """Joint covariance (3 + 2a, 3 + 2a) of pose and local landmarks."""
        keep = np.r_[0:3, ROBOT : len(self.x)]
        out: Array = self.P[np.ix_(keep, keep)]
        return out

    def innovation_covs(self, H_r: Array, H_m: Array) -> Array:
        """H P H^T (a, 2, 2) of every local landmark, for its Jacobians (a, 2, 3), (a, 2, 2)."""
        m = len(self.local)
        P_rm = self.P[:3, ROBOT:].reshape(3, m, 2).transpose(1, 0, 2)
        cross = H_r @ P_rm @ H_m.transpose(0, 2, 1)
        out: Array = (
            H_r @ self.P[:3, :3] @ H_r.transpose(0, 2, 1)
            + cross
            + cross.transpose(0, 2, 1)
            + H_m @ self.point_covs() @ H_m.transpose(0, 2, 1)
        )
        return out


class _Turn:
    """V = sin t/t + (1 - cos t)/t J of the exponential map, for a correction of the heading t."""

    def __init__(self, t: float) -> None:
        self._along = float(np.sinc(t / np.pi))
        self._across = float(np.sinc(0.5 * t / np.pi) * np.sin(0.5 * t))

    def step(self, dx: Array) -> tuple[Array, Array]:
        """``dx`` with V applied to position and landmarks, and J of that (0 elsewhere)."""
        step, u = dx.copy(), np.zeros(len(dx))
        for k in (slice(0, 2), slice(ROBOT, len(dx))):
            step[k] = self._along * dx[k] + self._across * _quarter_turn(dx[k])
            u[k] = _quarter_turn(step[k])
        return step, u

    def moved(self, coefficients: Array) -> Array:
        """V applied to B times the coefficients."""
        out: Array = self._along * coefficients + self._across * _swap(coefficients)
        return out


def _quarter_turn(rows: Array) -> Array:
    """J (rows in pairs of x and y): each point (x, y) becomes (-y, x)."""
    out = np.empty_like(rows)
    out[0::2], out[1::2] = -rows[1::2], rows[0::2]
    return out


def _swap(coefficients: Array) -> Array:
    """What J does to B = [P, J P]: J B c = B [-c_2, c_1]."""
    first, second = np.split(coefficients, 2)
    return np.concatenate([-second, first])
