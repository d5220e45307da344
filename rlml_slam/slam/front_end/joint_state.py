# SPDX-License-Identifier: Apache-2.0
"""The newest pose and velocity, two submaps' anchors, the reflectors: one mean, one covariance.

Eq. 5 and 11 of the notes hold the reflectors and the submap fixed, which makes the covariance
shrink without end while the same few errors of the map are measured again and again. Here they
stay correlated with the pose: a submap's anchor is a copy of the pose at which it was begun
(stochastic cloning), so the scan term measures the pose relative to that copy, and a reflector's
first sighting ties it to the pose of that moment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.compiled import brief, kernel
from rlml_slam.se2 import Array, wrapped
from rlml_slam.types import Motion

BIAS = 3
SPEED, TURN, DRIFT, PIVOT = 4, 5, 6, 7
VELOCITY = 8
ANCHORS = (11, 14)
LANDMARKS = 17
WHEELS = slice(SPEED, PIVOT + 1)
SYSTEMATIC = slice(BIAS, PIVOT + 1)
STANDING = np.zeros(2)
GATE = 16.0  # squared sigmas of a bias beyond which the wheels slip
MOVING = slice(VELOCITY, VELOCITY + 3)
REGULAR = 1e-12  # [m², rad²] smallest eigenvalue of the covariance of a pose that is not given


class JointState:
    """Mean ``x`` (17 + 2m,) and covariance ``P`` of all that is estimated together.

    In this order: the pose, the gyro's bias, the shares by which speed and turn exceed those that
    the wheels measure, the turn per distance [rad/m] that they do not measure, how far the base is
    ahead of the point about which it turns (eq. 67), its velocity, or with odometry the error of
    that in the newest sweep (:func:`begin_sweep`), two anchors, the reflectors; and ``extra``
    rows, zero but while reflectors are left out, which depend on the rows ``tied``.
    """

    def __init__(
        self,
        pose: Array,
        cov: Array,
        bias_sigma: float,
        speeds: Sequence[float] = (0.0, 0.0, 0.0),
        wheels: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Sigmas: ``speeds`` (3,) [m/s, m/s, rad/s] of an unknown velocity, ``wheels`` (4,)."""
        self.x = np.zeros(LANDMARKS)
        self.P = np.zeros((LANDMARKS, LANDMARKS))
        self.x[:3] = pose
        self.P[:3, :3] = cov
        self.P[BIAS, BIAS] = bias_sigma**2
        self._unknown = np.diag(np.array(speeds) ** 2)
        self.P[MOVING, MOVING] = self._unknown
        self.wheels2 = np.array(wheels) ** 2
        self.P[WHEELS, WHEELS] = np.diag(self.wheels2)
        self.extra = 0
        self.tied = np.zeros(0, dtype=np.int64)

    @property
    def num_landmarks(self) -> int:
        """Number m of reflectors in the state."""
        return (self._end - LANDMARKS) // 2

    @property
    def _end(self) -> int:
        """One past the row of the last reflector."""
        return len(self.x) - self.extra

    @property
    def pose(self) -> Array:
        """Pose (3,) in the local frame."""
        return self.x[:3].copy()

    @property
    def velocity(self) -> Array:
        """Velocity (3,) of the base: forward, left, turn."""
        return self.x[MOVING].copy()

    @property
    def pose_cov(self) -> Array:
        """Covariance (3, 3) of the pose."""
        return self.P[:3, :3].copy()

    def landmarks(self) -> Array:
        """Positions (m, 2) in the local frame."""
        return self.x[LANDMARKS : self._end].reshape(-1, 2)

    def landmark_covs(self) -> Array:
        """Marginal covariances (m, 2, 2)."""
        m = self.num_landmarks
        k = np.arange(m)
        rows = slice(LANDMARKS, self._end)
        P: Array = self.P[rows, rows].reshape(m, 2, m, 2)[k, :, k, :]
        return P

    def pose_and_landmarks_cov(self) -> Array:
        """Joint covariance (3 + 2m, 3 + 2m) without the anchors."""
        rows = slice(LANDMARKS, self._end)
        P = np.empty((self._end - LANDMARKS + 3,) * 2)
        P[:3, :3], P[:3, 3:] = self.P[:3, :3], self.P[:3, rows]
        P[3:, :3], P[3:, 3:] = self.P[rows, :3], self.P[rows, rows]
        return P

    def predict(
        self, motion: Motion, walk: float, kept: float = 1.0, went: Array = STANDING
    ) -> None:
        """Move the pose by a relative motion with its covariance (eq. 5), as wheels and gyro err.

        Meanwhile the gyro's bias gained the variance ``walk``, and of what the wheels err by, a
        share of ``kept`` is left; the rest is new (an Ornstein-Uhlenbeck process). ``went`` (2,)
        [m, rad] is how far the robot came and turned by what was known before, which takes the
        place of odometry in the derivatives by these errors.
        """
        if math.isfinite(motion.bias_var):
            measure_bias(
                self.x, self.P, motion.bias, motion.bias_var, motion.bias_turn, motion.bias_way
            )
        gains = motion.bias_gain, motion.turn_gain, motion.drift_gain
        predict(
            self.x, self.P, Step(motion.delta, motion.cov, *gains, went), walk, kept, self.wheels2
        )

    def corrected(self, m: Motion) -> Motion:
        """A motion as it is by what is known now of how wheels and gyro err."""
        bias, speed, turn, drift, ahead = self.x[SYSTEMATIC].tolist()
        delta = m.delta + bias * m.bias_gain + turn * m.turn_gain + drift * m.drift_gain
        delta[:2] *= 1.0 + speed
        if m.turn_gain.any() or m.bias_gain.any():  # wheels or a gyro measured the turn
            delta += ahead * pivot_gain(delta[2])
        delta[2] = se2.wrapped(delta[2])
        return Motion(delta, m.cov, m.known)

    def place(self, pose: Array, cov: Array) -> None:
        """Put the pose (3,) elsewhere, with an error of covariance (3, 3) of its own."""
        self.x[:3] = pose
        self.x[MOVING] = 0.0
        for rows in (slice(3), MOVING):
            self.P[rows, :] = self.P[:, rows] = 0.0
        self.P[:3, :3] = cov
        self.P[MOVING, MOVING] = self._unknown

    def take_systematic_errors(self, other: JointState) -> None:
        """Take gyro bias and scale errors, with their covariance and prior, of another state."""
        self.x[SYSTEMATIC], self.wheels2 = other.x[SYSTEMATIC], other.wheels2.copy()
        self.P[SYSTEMATIC, SYSTEMATIC] = other.P[SYSTEMATIC, SYSTEMATIC]

    def widen(self, cov: Array) -> None:
        """Add independent uncertainty (3, 3) to the pose."""
        self.P[:3, :3] += cov

    def clone_pose(self, slot: int, turn: float, cov: Array) -> None:
        """Make anchor ``slot`` the pose turned on the spot, with all its correlations.

        ``cov`` (3, 3) is added: the part of a submap's error that is the same for all scans that
        are matched against it, and so does not average out over them.
        """
        a = ANCHORS[slot]
        self.x[a : a + 3] = se2.compose(self.x[:3], (0.0, 0.0, turn))
        self.P[a : a + 3, :] = self.P[:3, :]
        self.P[:, a : a + 3] = self.P[:, :3]
        self.P[a : a + 3, a : a + 3] += cov

    def move_anchor(self, source: int, target: int) -> None:
        """Let slot ``target`` take over the anchor in slot ``source``."""
        s, t = ANCHORS[source], ANCHORS[target]
        self.x[t : t + 3] = self.x[s : s + 3]
        self.P[t : t + 3, :] = self.P[s : s + 3, :]
        self.P[:, t : t + 3] = self.P[:, s : s + 3]

    def anchor(self, slot: int) -> Array:
        """Pose (3,) of an anchor."""
        a = ANCHORS[slot]
        return self.x[a : a + 3].copy()

    def replace(self, points: Array, cov: Array, anchor_cov: Array) -> None:
        """New reflectors (m, 2) and the joint covariance (3 + 2m, 3 + 2m) of the pose and them.

        All else keeps its mean; an anchor keeps its place relative to the pose, known but for
        ``anchor_cov`` (3, 3).
        """
        n = LANDMARKS + 2 * len(points)
        x, P = np.zeros(n), np.zeros((n, n))
        x[:LANDMARKS] = self.x[:LANDMARKS]
        x[LANDMARKS:] = points.ravel()
        rows = np.r_[0:3, LANDMARKS:n]
        P[np.ix_(rows, rows)] = cov
        for same in (slice(BIAS, BIAS + 1), WHEELS, MOVING):
            P[same, same] = self.P[same, same]
        if np.linalg.eigvalsh(self.P[:3, :3])[0] > REGULAR:  # what it shares with the pose's error
            part = np.linalg.solve(self.P[:3, :3], self.P[:3, MOVING]).T
            P[MOVING, rows] = part @ cov[:3]
            P[rows, MOVING] = P[MOVING, rows].T
            P[MOVING, MOVING] += part @ (cov[:3, :3] - self.P[:3, :3]) @ part.T
        for a in ANCHORS:
            J, _ = se2.compose_jacobians(x[:3], se2.between(x[:3], x[a : a + 3]))
            P[a : a + 3, :] = J @ P[:3, :]
            P[:, a : a + 3] = P[:, :3] @ J.T
            P[a : a + 3, a : a + 3] = J @ P[:3, :3] @ J.T + anchor_cov
        self.x, self.P = x, P

    def add_landmark(self, z: Array, R: Array) -> int:
        """Append the reflector seen at z (2,) with covariance R (2, 2) in base; its index."""
        n, end = len(self.x), self._end
        rot = se2.rotation(self.x[2])
        G = np.empty((2, 3))
        G[:, :2] = np.eye(2)
        G[0, 2] = -rot[1, 0] * z[0] - rot[0, 0] * z[1]
        G[1, 2] = rot[0, 0] * z[0] - rot[1, 0] * z[1]
        x = np.empty(n + 2)
        x[:n] = self.x
        x[n:] = self.x[:2] + rot @ z
        P = np.empty((n + 2, n + 2))
        P[:n, :n] = self.P
        P[n:, :n] = G @ self.P[:3, :]
        P[:n, n:] = P[n:, :n].T
        P[n:, n:] = G @ self.P[:3, :3] @ G.T + rot @ R @ rot.T
        self.x, self.P = x, P
        if self.extra:
            self._take(np.r_[:end, n : n + 2, end:n])
        return (end - LANDMARKS) // 2

    def fix_landmarks(self, points: Array, cov: Array) -> None:
        """Append reflectors (k, 2) of a given map with covariances (k, 2, 2), all independent."""
        n, k = len(self.x), len(points)
        P = np.zeros((n + 2 * k, n + 2 * k))
        P[:n, :n] = self.P
        at = n + 2 * np.arange(k)[:, None] + np.arange(2)
        P[at[:, :, None], at[:, None, :]] = cov
        self.x, self.P = np.concatenate([self.x, points.ravel()]), P

    def remove_landmarks(self, keep: NDArray[np.bool_]) -> None:
        """Marginalise out the reflectors where ``keep`` (m,) is false."""
        landmarks = np.arange(LANDMARKS, self._end)
        kept = np.repeat(keep, 2)
        needed = landmarks[~kept & np.isin(landmarks, self.tied)]
        others = np.arange(self._end, len(self.x))
        self._take(np.concatenate([np.arange(LANDMARKS), landmarks[kept], others, needed]))
        self.extra = len(others) + len(needed)

    def leave_out(self, away: NDArray[np.bool_]) -> None:
        """Take out the reflectors where ``away`` (m,) is true, keeping what they depend on."""
        near = LANDMARKS + np.flatnonzero(np.repeat(~away, 2))
        end = LANDMARKS + len(near)
        self._take(np.r_[0:LANDMARKS, near, 0:LANDMARKS])
        self.extra = LANDMARKS
        self.tied = np.r_[end : end + LANDMARKS, LANDMARKS:end]

    def put_back(self, points: Array, cross: Array, cov: Array) -> None:
        """Append reflectors (2k,) with covariances (n, 2k) with the state and (2k, 2k) of them."""
        end, n = self._end, self._end + len(points)
        x, P = np.empty(n), np.empty((n, n))
        x[:end], x[end:] = self.x[:end], points
        P[:end, :end], P[end:, end:] = self.P[:end, :end], cov
        P[:end, end:] = cross[:end]
        P[end:, :end] = P[:end, end:].T
        self.x, self.P, self.extra, self.tied = x, P, 0, self.tied[:0]

    def _take(self, rows: NDArray[np.int64]) -> None:
        """Only these rows, in this order."""
        where = np.full(len(self.x), -1)
        where[rows] = np.arange(len(rows))
        self.x, self.tied = self.x[rows], where[self.tied]
        self.P = np.ascontiguousarray(self.P[np.ix_(rows, rows)])

    def apply(self, columns: NDArray[np.int64], H: Array, R: Array, v: Array) -> None:
        """Kalman update of everything: v = H dx[columns] + noise of covariance R."""
        update(self.x, self.P, columns, H, R, v)

    def turn_with_anchor(self, before: Array) -> None:
        """Correlate positions with the heading of the first anchor, after a match moved them.

        ``before`` is the state (n,) until then. A match is in the axes of the anchor: an error of
        its heading moves a position by where that is now, relative to the anchor, not by where it
        was. So it is in the right-invariant filter (Barrau, Bonnabel 2015); otherwise a large
        correction seems to measure an uncertain heading.
        """
        turn_with_anchor(self.P, self.x - before, self._end)


class Step(NamedTuple):
    """What a kernel needs of a Motion, and ``went`` (2,), see :meth:`JointState.predict`."""

    delta: Array
    cov: Array
    bias_gain: Array
    turn_gain: Array
    drift_gain: Array
    went: Array


@brief
def predict(x: Array, P: Array, step: Step, walk: float, kept: float, wheels2: Array) -> None:
    """Eq. 5 and its covariance in place; see :meth:`JointState.predict`."""
    delta, cov, bias_gain, turn_gain, drift_gain, went = step
    c, s = math.cos(x[2]), math.sin(x[2])
    moved = delta + bias_gain * x[BIAS] + turn_gain * x[TURN] + drift_gain * x[DRIFT]
    faster = 1.0 + x[SPEED]
    D = np.zeros((3, 6))  # by the heading, bias, shares of speed and turn, drift, pivot
    gx, gy = faster * (c * moved[0] - s * moved[1]), faster * (s * moved[0] + c * moved[1])
    # about the point where it turns, and by an error of the turn; what nobody measured is a motion
    # of the base itself
    ahead = x[PIVOT] if turn_gain.any() or bias_gain.any() else 0.0
    px, py = -ahead * math.sin(x[2] + moved[2]), ahead * math.cos(x[2] + moved[2])
    ax, ay = py - ahead * c, -px - ahead * s
    D[0, 0], D[1, 0] = -gy - ay, gx + ax
    D[0, 1] = faster * (c * bias_gain[0] - s * bias_gain[1]) + px * bias_gain[2]
    D[1, 1] = faster * (s * bias_gain[0] + c * bias_gain[1]) + py * bias_gain[2]
    D[2, 1] = bias_gain[2]
    # on an arc, a share of the way is along its chord, and one of the turn turns that by half
    middle = x[2] + 0.5 * moved[2]
    D[0, 2], D[1, 2] = math.cos(middle) * went[0], math.sin(middle) * went[0]
    if turn_gain.any() or bias_gain.any():
        chord = 2.0 * math.sin(0.5 * went[1])
        D[0, 5], D[1, 5] = -math.sin(middle) * chord, math.cos(middle) * chord
    if turn_gain.any():
        D[0, 3], D[1, 3], D[2, 3] = (px - 0.5 * gy) * went[1], (py + 0.5 * gx) * went[1], went[1]
    if drift_gain.any():
        D[0, 4], D[1, 4], D[2, 4] = (px - 0.5 * gy) * went[0], (py + 0.5 * gx) * went[0], went[0]
    x[0] += gx + ax
    x[1] += gy + ay
    turn = x[2] + moved[2]
    x[2] = wrapped(turn)
    for k in range(len(x)):
        heading, bias, speed, share, drift = P[2, k], P[3, k], P[4, k], P[5, k], P[6, k]
        pivot = P[7, k]
        for r in range(3):
            P[r, k] += D[r, 0] * heading + D[r, 1] * bias + D[r, 2] * speed
            P[r, k] += D[r, 3] * share + D[r, 4] * drift + D[r, 5] * pivot
    for k in range(len(x)):
        heading, bias, speed, share, drift = P[k, 2], P[k, 3], P[k, 4], P[k, 5], P[k, 6]
        pivot = P[k, 7]
        for r in range(3):
            P[k, r] += D[r, 0] * heading + D[r, 1] * bias + D[r, 2] * speed
            P[k, r] += D[r, 3] * share + D[r, 4] * drift + D[r, 5] * pivot
    G = np.array([[c, -s, px], [s, c, py], [0.0, 0.0, 1.0]])
    P[:3, :3] += np.dot(np.dot(G, cov), G.T.copy())
    P[BIAS, BIAS] += walk
    if kept < 1.0:
        for k in range(4):
            e = SPEED + k
            x[e] *= kept
            P[e] *= kept
            P[:, e] *= kept
            P[e, e] += (1.0 - kept * kept) * wheels2[k]


def pivot_gain(turn: float) -> Array:
    """Derivative (3,) of a motion with a turn [rad] by how far the base is ahead (eq. 67)."""
    return np.array([math.cos(turn) - 1.0, math.sin(turn), 0.0])


def narrow_scale_errors(state: JointState, sigmas: Sequence[float]) -> None:
    """Replace the prior of the scale errors by one of ``sigmas`` (2,), where that is narrower."""
    # the ratio of two such Gaussians is a Gaussian of mean 0, which is fused; by how much they
    # varied until now is not taken back
    for k, new in enumerate(np.square(sigmas).tolist()):
        old, row = float(state.wheels2[k]), SPEED + k
        if new < old:
            R = np.array([[new * old / (old - new)]])
            state.apply(np.array([row]), np.eye(1), R, -state.x[row : row + 1])
            state.wheels2[k] = new


def expect_pivot(state: JointState, sigma: float) -> None:
    """Let where the robot turns be unknown by at least ``sigma`` [m] (eq. 67)."""
    if (more := sigma**2 - state.wheels2[-1]) > 0.0:
        state.P[PIVOT, PIVOT] += more
        state.wheels2[-1] += more


def predict_unseen(state: JointState, motion: Motion, walk: float, kept: float) -> None:
    """:meth:`JointState.predict` over a long way on which nothing was seen (eq. 64).

    The odometry says how far the robot went: its noise is small beside the way. All of the way has
    the errors of the wheels of its end, so they vary first.
    """
    state.x[WHEELS] *= kept
    state.P[WHEELS, :] *= kept
    state.P[:, WHEELS] *= kept
    state.P[WHEELS, WHEELS] += np.diag((1.0 - kept**2) * state.wheels2)
    speed = np.array([*motion.delta[:2], 0.0])
    J = np.stack([speed, motion.turn_gain, motion.drift_gain], axis=-1)
    J = se2.rotation3(state.x[2]) @ J
    state.predict(motion, walk)
    rows = slice(SPEED, DRIFT + 1)  # where the robot turns is not modelled without a lidar
    state.P[:3, :] += J @ state.P[rows, :]
    state.P[:, :3] += state.P[:, rows] @ J.T


def begin_sweep(state: JointState, cov: Array) -> None:
    """A sweep begins at the pose of the state; odometry errs by (3, 3) in it (eq. 59).

    The end points were de-skewed with that odometry, so they constrain the pose plus half of its
    error; and the next motion has all of it.
    """
    state.x[MOVING] = 0.0
    state.P[MOVING, :] = state.P[:, MOVING] = 0.0
    state.P[MOVING, MOVING] = cov


@brief
def end_sweep(x: Array, P: Array, heading: float) -> None:
    """Move the pose by the error of the sweep that began at a ``heading``, in place (eq. 59)."""
    c, s = math.cos(heading), math.sin(heading)
    v = VELOCITY
    x[0] += c * x[v] - s * x[v + 1]
    x[1] += s * x[v] + c * x[v + 1]
    x[2] = wrapped(x[2] + x[v + 2])
    for k in range(len(x)):
        P[0, k] += c * P[v, k] - s * P[v + 1, k]
        P[1, k] += s * P[v, k] + c * P[v + 1, k]
        P[2, k] += P[v + 2, k]
    for k in range(len(x)):
        P[k, 0] += c * P[k, v] - s * P[k, v + 1]
        P[k, 1] += s * P[k, v] + c * P[k, v + 1]
        P[k, 2] += P[k, v + 2]


@brief
def measure_bias(
    x: Array, P: Array, bias: float, variance: float, turn: float, speed: float
) -> None:
    """Scalar update with what IMU and wheels say of the gyro's bias, gated against slip.

    Wheels that turned by ``turn`` [rad/s] and went at ``speed`` [m/s] say it but for the share
    and for the drift that they err by.
    """
    PH = P[:, BIAS] + turn * P[:, TURN] + speed * P[:, DRIFT]
    S = PH[BIAS] + turn * PH[TURN] + speed * PH[DRIFT] + variance
    error = bias - (x[BIAS] + turn * x[TURN] + speed * x[DRIFT])
    if not error * error < GATE * S:  # nor where it is NaN
        return
    for r in range(len(x)):
        gain = PH[r] / S
        x[r] += gain * error
        for c in range(len(x)):
            P[r, c] -= gain * PH[c]
    x[2] = wrapped(x[2])


@kernel
def update(x: Array, P: Array, columns: NDArray[np.int64], H: Array, R: Array, v: Array) -> None:
    """Kalman update in place; see :meth:`JointState.apply`."""
    n = len(x)
    PH = np.dot(P[:, columns], H.T.copy())
    S = np.dot(H, PH[columns]) + R
    K = np.linalg.solve(S, PH.T.copy()).T.copy()
    x += np.dot(K, v)
    x[2] = wrapped(x[2])
    # Joseph form costs n^3; P - K S K^T, made symmetric, keeps it positive here because R > 0
    less = np.dot(K, PH.T.copy())
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i] - less[i, j] - less[j, i])


@brief
def turn_with_anchor(P: Array, shift: Array, end: int) -> None:
    """Kernel of :meth:`JointState.turn_with_anchor`, in place, with reflectors up to row ``end``.

    ``shift`` (n,) is what the update has changed the state by.
    """
    anchor = ANCHORS[0]
    heading = anchor + 2
    for row in range(end):
        is_reflector = row >= LANDMARKS and (row - LANDMARKS) % 2 == 0
        if not (is_reflector or row == 0 or row == ANCHORS[1]):
            continue
        dx, dy = shift[row] - shift[anchor], shift[row + 1] - shift[anchor + 1]
        for k in range(len(P)):
            P[row, k] -= dy * P[heading, k]
            P[row + 1, k] += dx * P[heading, k]
        for k in range(len(P)):
            P[k, row] -= dy * P[k, heading]
            P[k, row + 1] += dx * P[k, heading]


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    state = JointState(np.zeros(3), np.eye(3), 0.1)
    zero = np.zeros(3)
    step = Step(zero, np.eye(3), zero, zero, zero, STANDING)
    predict(state.x, state.P, step, 0.0, 1.0, np.zeros(4))
    measure_bias(state.x, state.P, 0.0, 1.0, 0.0, 0.0)
    state.apply(np.arange(3), np.eye(3), np.eye(3), np.zeros(3))
    state.turn_with_anchor(state.x)
    end_sweep(state.x, state.P, 0.0)
