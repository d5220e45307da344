# SPDX-License-Identifier: Apache-2.0
"""EKF over the robot and the landmarks near it: predict, update, augment.

State (x, y, theta, b, s, t, x_1, y_1, ...): that of the note, with the bias b of the gyro and the
scale errors s and t of the speed and turn rate of the wheels. Only the robot and
the landmarks of a local region are updated. The effect on the others is accumulated and applied
when the region changes, which gives the same state exactly (compressed_updates.py).

The EKF of the note gains information about the heading in the map from landmarks alone, which is
not observable: a rotation about the origin changes no measurement, but Jacobians at different
linearization points no longer show this, and the covariance becomes too small. An ``invariant``
filter (right-invariant EKF: Barrau, Bonnabel 2015) moves position and landmarks with the error of
the heading, and is consistent there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.ekf.compressed_updates import CompressedUpdates, Turn, quarter_turn
from rlml_slam.estimation.landmark_models import Model
from rlml_slam.estimation.smoother import BIAS, ROBOT, SPEED, TURN
from rlml_slam.se2 import Array
from rlml_slam.types import Motion

WHEELS = slice(SPEED, TURN + 1)
JOINED = 1e-3  # [m] standard deviation of the difference of two landmarks that are one


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
        """``wheels`` (2,): standard deviations of s and t; with zeros, they are not estimated."""
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
        self._outside: CompressedUpdates | None = None

    def predict(self, motion: Motion, walk: float = 0.0, kept: float = 1.0) -> bool:
        """Move the robot: P_rr <- A P_rr A^T + Q, P_ri <- A P_ri (eq. 15, 16), in O(n).

        Q = W C W^T is the motion's covariance rotated into the map. The gyro's bias gains the
        variance ``walk``; the scale errors are a Gauss-Markov process with factor ``kept``.
        Returns whether the measurement of the bias by IMU and wheels was used.
        """
        was_used = np.isfinite(motion.bias_var) and self._measure_bias(motion)
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
        if self._outside is not None:
            self._outside.predict(A)
        return bool(was_used)

    def corrected(self, motion: Motion) -> tuple[Array, Array]:
        """Motion (3,) corrected for bias and scale errors; d motion / d (b, s, t) (3, 3)."""
        delta = motion.delta + motion.bias_gain * self.x[BIAS] + motion.turn_gain * self.x[TURN]
        way, faster = np.array([delta[0], delta[1], 0.0]), 1.0 + self.x[SPEED]
        scale = np.array([faster, faster, 1.0])
        gains = np.stack([scale * motion.bias_gain, way, scale * motion.turn_gain], axis=1)
        return scale * delta, gains

    def _measure_bias(self, motion: Motion) -> bool:
        """Measurement of the bias by IMU and wheels, gated against slip; whether it passed."""
        columns, H = np.array([BIAS, TURN]), np.array([[1.0, motion.bias_turn]])
        error = motion.bias - float(H[0] @ self.x[columns])
        variance = float(H[0] @ self.P[np.ix_(columns, columns)] @ H[0]) + motion.bias_var
        passed = error * error < 16.0 * variance
        if passed:
            self.apply(columns, H, np.array([[motion.bias_var]]), np.array([error]))
        return passed

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
        turn = Turn(dx[2]) if self.invariant else None
        u = c = np.zeros(0)
        if turn is not None:
            # The error is xi_theta = dtheta, xi_p = dp - J p dtheta, and the same for landmarks,
            # J = R(90 deg). exp moves a point m by V dm; xi keeping its covariance, dm gains
            # J (m_after - m_before) dtheta: P <- M P M^T with M = I + u e_theta^T
            c = self.P[2] + K[2] @ right + K @ right[:, 2]
            dx, u = turn.step(dx)
            left = np.concatenate([K, u[:, None]], axis=1)
            right = np.concatenate([right, (c + 0.5 * c[2] * u)[None]])
        if self._outside is not None:
            HPhi = H @ self._outside.phi[columns]
            self._outside.update(HPhi, S_inv, K)
            if turn is not None:
                self._outside.turn(turn, HPhi.T @ (S_inv @ nu), c, u)
            else:
                self._outside.theta += HPhi.T @ (S_inv @ nu)
        self.x += dx
        self.x[2] = se2.wrap(self.x[2])
        M = left @ right
        self.P += M + M.T

    def augment(self, z: Array, R: Array) -> int:
        """Add the landmark measured as z (2,) with R (2, 2); its number.

        P_NN = J_xr P_rr J_xr^T + J_z R J_z^T, P_Ni = J_xr P_ri for every i.
        """
        m, J_xr, J_z = self.model.place(self.x[:3], z[None])
        cov = J_xr[0] @ self.P[:3, :3] @ J_xr[0].T + J_z[0] @ R @ J_z[0].T
        return self._append(m[0], 0.5 * (cov + cov.T), J_xr[0])

    def fix(self, point: Array, cov: Array) -> int:
        """Add a landmark of a given map, independent of the rest; its number."""
        return self._append(point, cov)

    def _append(self, point: Array, cov: Array, J_xr: Array | None = None) -> int:
        """Append a landmark with its Jacobian (2, 3) by the pose, if it depends on it."""
        n = len(self.x)
        self.x, P = np.concatenate([self.x, point]), np.zeros((n + 2, n + 2))
        P[:n, :n], P[n:, n:] = self.P, cov
        if J_xr is not None:
            P[n:, :n] = J_xr @ self.P[:3]
            P[:n, n:] = P[n:, :n].T
        self.P = P
        if self._outside is not None:
            phi = self._outside.phi
            self._outside.append(np.zeros_like(phi[:2]) if J_xr is None else J_xr @ phi[:3])
        self.local = np.append(self.local, self.num_landmarks)
        self.num_landmarks += 1
        return self.num_landmarks - 1

    def join(self, a: int, b: int) -> None:
        """Merge landmarks a and b: the measurement 0 = m_a - m_b, almost without noise.

        b leaves the state, and the numbers of the landmarks after it decrease by one.
        """
        self.settle()
        columns = np.concatenate([_columns(np.array([a])), _columns(np.array([b]))])
        H = np.concatenate([np.eye(2), -np.eye(2)], axis=1)
        self.apply(columns, H, JOINED**2 * np.eye(2), -H @ self.x[columns])
        keep = np.delete(np.arange(len(self.x)), columns[2:])
        self.x, self.P = self.x[keep], self.P[np.ix_(keep, keep)]
        self.num_landmarks -= 1
        self.local = np.arange(self.num_landmarks)

    def settle(self) -> None:
        """Apply the updates to the landmarks outside the region; afterwards all are local."""
        outside = self._outside
        if outside is None:
            return
        a, b = _rows(self.local), _columns(self._others)
        a0 = _rows(self.local[self.local < len(self._x[ROBOT:]) // 2])
        n, before = ROBOT + 2 * self.num_landmarks, len(self._x)
        B = self._P[np.ix_(b, a0)]
        if self.invariant:
            B = np.concatenate([B, quarter_turn(B)], axis=1)
        x, P = np.empty(n), self._P
        if n > before:
            P = np.zeros((n, n))
            P[:before, :before] = self._P
        x[a], x[b] = self.x, self._x[b] + B @ outside.theta
        # P_bb <- P_bb + B Psi B^T, symmetric to the last bit
        D = 0.5 * (B @ outside.psi @ B.T)
        P[np.ix_(b, b)] += D + D.T
        P[np.ix_(b, a)] = P_ba = B @ outside.phi.T
        P[np.ix_(a, b)] = P_ba.T
        P[np.ix_(a, a)] = self.P
        self.x, self.P, self._outside = x, P, None
        self.local = np.arange(self.num_landmarks)
        self._others = np.zeros(0, dtype=np.int64)

    def choose(self, keep: NDArray[np.bool_]) -> None:
        """Update only the landmarks where ``keep`` (m,) is true, from now on."""
        self.settle()
        if keep.all():
            return
        self.local, self._others = np.flatnonzero(keep), np.flatnonzero(~keep)
        self._x, self._P = self.x, self.P
        a = _rows(self.local)
        self.x, self.P = self._x[a], self._P[np.ix_(a, a)]
        self._outside = CompressedUpdates(len(a), self.invariant)

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
        return self.P[ROBOT:, ROBOT:].reshape(m, 2, m, 2)[k, :, k, :]

    def landmarks(self) -> Array:
        """All landmarks (m, 2); those outside the region as of when it was chosen."""
        out = np.empty((self.num_landmarks, 2))
        out[self.local] = self.points
        out[self._others] = self._x[_columns(self._others)].reshape(-1, 2)
        return out

    def difference_cov(self, a: int, b: int) -> Array:
        """Covariance (2, 2) of the difference of two local landmarks."""
        i, j = (slice(ROBOT + 2 * k, ROBOT + 2 * k + 2) for k in (a, b))
        return self.P[i, i] + self.P[j, j] - self.P[i, j] - self.P[j, i]

    def pose_and_points_cov(self) -> Array:
        """Joint covariance (3 + 2a, 3 + 2a) of pose and local landmarks."""
        keep = np.r_[0:3, ROBOT : len(self.x)]
        out: Array = self.P[np.ix_(keep, keep)]
        return out


def innovation_covs(filter_: Filter, H_r: Array, H_m: Array) -> Array:
    """H P H^T (a, 2, 2) of every local landmark, for its Jacobians (a, 2, 3), (a, 2, 2)."""
    m = len(filter_.local)
    P_rm = filter_.P[:3, ROBOT:].reshape(3, m, 2).transpose(1, 0, 2)
    cross = H_r @ P_rm @ H_m.transpose(0, 2, 1)
    return (
        H_r @ filter_.P[:3, :3] @ H_r.transpose(0, 2, 1)
        + cross
        + cross.transpose(0, 2, 1)
        + H_m @ filter_.point_covs() @ H_m.transpose(0, 2, 1)
    )


def _columns(landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of landmarks in the state."""
    first = ROBOT + 2 * landmarks
    return np.stack([first, first + 1], -1).ravel()


def _rows(landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the robot and of landmarks in the state."""
    return np.concatenate([np.arange(ROBOT), _columns(landmarks)])
