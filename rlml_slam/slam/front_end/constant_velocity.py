# SPDX-License-Identifier: Apache-2.0
"""Where a robot without odometry goes: on as it went, less and less surely.

Each component of the body's velocity is an Ornstein-Uhlenbeck process, dv = -v dt / time + noise,
that of Singer (1970) one derivative lower: over a moment the velocity is constant, its change has
the variance 2 sigma^2 dt / time, and what is never seen again is within ``sigma`` of standing
still. So where scans leave a direction open, the speed along it fades instead of running away.
The velocity is part of the joint state, and whatever corrects the pose corrects it as well.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rlml_slam import se2
from rlml_slam.compiled import brief
from rlml_slam.estimation.correction import positive
from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array, wrapped
from rlml_slam.sensing.synchronization.sweep_period import SweepPeriod
from rlml_slam.slam.front_end.joint_state import BIAS, VELOCITY, JointState
from rlml_slam.slam.front_end.scan_update import relative
from rlml_slam.types import Motion

LEAST = 1e-8  # [m^2, rad^2] keeps the covariance of a pose that is the submap's own regular
OPEN = 1e-6  # [1/m^2, 1/rad^2] information of a direction in which nothing was measured
COVERED = 0.99  # share of the time that a gyro has to cover for its turn to be taken


class ConstantVelocity:
    """Predicts the pose of a robot without odometry, and says afterwards how it moved."""

    def __init__(self, params: MotionNoise) -> None:
        self._p = params
        self._clock = SweepPeriod()
        self._pose = np.zeros(3)
        self._cov = np.zeros((3, 3))  # of the pose in the submap, before
        self._way = np.zeros((3, 3))  # covariance of the motion that was predicted

    def predict(self, state: JointState, dt: float, motion: Motion) -> None:
        """Move the pose by its own velocity to a sweep whose stamp is ``dt`` [s] later.

        Of ``motion``, measured without odometry, the turn is used where a gyro measured all of it.
        """
        p = self._p
        self._pose, (_, self._cov) = state.pose, relative(state.x, state.P)
        (elapsed, error), sigma = self._clock.elapsed(dt), np.array(p.constant_velocity_sigma)
        jitter = math.hypot(p.constant_velocity_stamp_sigma, error)
        self._way = coast(state, elapsed, sigma, p.constant_velocity_time, jitter, motion)
        state.P[BIAS, BIAS] += p.imu_bias_walk**2 * dt

    def estimated(self, state: JointState, motion: Motion) -> Motion:
        """The motion since before :meth:`predict`, by all that was measured since.

        To the graph it is what odometry is else: it holds keyframes together where their scans
        leave a direction open.
        """
        seen, cov = relative(state.x, state.P)
        cov = way_cov(self._way, self._cov, cov, float(seen[2]))
        return replace(motion, delta=se2.between(self._pose, state.pose), cov=cov)


def coast(
    state: JointState, dt: float, sigma: Array, time: float, jitter: float, motion: Motion
) -> Array:
    """Move the pose by its velocity over ``dt`` [s]; the covariance (3, 3) of that way in base.

    ``sigma`` (3,) and ``time`` [s] as above; ``jitter`` [s] is the error of a stamp.
    """
    gain = float(motion.bias_gain[2])
    gyro = abs(gain) > COVERED * dt
    turn, variance = (float(motion.delta[2]), float(motion.cov[2, 2])) if gyro else (0.0, 0.0)
    measured = _Gyro(gyro, turn, variance, gain)
    way = _coast(state.x, state.P, dt, sigma, time, jitter, measured)
    state.x[2] = wrapped(state.x[2])
    return way


class _Gyro(NamedTuple):
    """A turn [rad] with its variance, if it was measured; ``gain`` is d turn / d bias."""

    measured: bool
    turn: float
    variance: float
    gain: float


@brief
def _coast(
    x: Array, P: Array, dt: float, sigma: Array, time: float, jitter: float, gyro: _Gyro
) -> Array:
    """Kernel of coast(), in place."""
    u = dt / time
    fade = math.exp(-u)
    span = time * (1.0 - fade)  # displacement per velocity
    # covariances of displacement and velocity at the end, per sigma^2
    both = time * (1.0 - fade) ** 2
    moved = max(time * time * (2.0 * u - 3.0 + 4.0 * fade - fade * fade), 0.0)
    speed = 1.0 - fade * fade
    d, q = np.empty(3), np.empty(3)
    for k in range(3):
        v = x[VELOCITY + k]
        d[k] = span * v
        q[k] = moved * sigma[k] ** 2 + jitter**2 * (v * v + P[VELOCITY + k, VELOCITY + k])
    seen = 3
    if gyro.measured:
        d[2], q[2], seen = gyro.turn + gyro.gain * x[BIAS], gyro.variance, 2
    # the midpoint model of eq. 7, with a sideways displacement
    c, s = math.cos(x[2] + 0.5 * d[2]), math.sin(x[2] + 0.5 * d[2])
    gx, gy = -s * d[0] - c * d[1], c * d[0] - s * d[1]
    M = np.array([[c, -s, 0.5 * gx], [s, c, 0.5 * gy], [0.0, 0.0, 1.0]])
    x[0] += gy
    x[1] -= gx
    x[2] += d[2]
    x[VELOCITY : VELOCITY + 3] *= fade
    way = np.diag(q)
    way[:seen, :seen] += span**2 * P[VELOCITY : VELOCITY + seen, VELOCITY : VELOCITY + seen]
    n = len(x)
    F = np.zeros((3, n))  # what is added to the pose, by the state
    F[0, 2], F[1, 2] = gx, gy
    F[:, VELOCITY : VELOCITY + seen] = span * M[:, :seen]
    if gyro.measured:
        F[:, BIAS] = gyro.gain * M[:, 2]
    P[:3] += np.dot(F, P)
    P[VELOCITY : VELOCITY + 3] *= fade
    P[:, :3] += np.dot(P, F.T.copy())
    P[:, VELOCITY : VELOCITY + 3] *= fade
    P[:3, :3] += np.dot(M * q, M.T.copy())
    for k in range(3):
        w = VELOCITY + k
        P[w, w] += speed * sigma[k] ** 2
        if k < seen:
            for m in range(3):
                P[m, w] += both * sigma[k] ** 2 * M[m, k]
                P[w, m] = P[m, w]
    return way


@brief
def way_cov(way: Array, before: Array, after: Array, heading: float) -> Array:
    """Covariance (3, 3) in base of the way between two poses, with all that was measured.

    ``way`` (3, 3) is that of the prediction, ``before`` and ``after`` (3, 3) those of the poses
    in a submap, in which the robot's heading is ``heading``. What was measured at the second pose,
    relative to the submap, measures the way with its own covariance plus that of the first pose.
    But the error of a speed lasts for many scans: the growth of the pose's covariance, which it
    adds up to, is added.
    """
    c, s = math.cos(heading), math.sin(heading)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    least = LEAST * np.eye(3)
    first = np.dot(np.dot(R, before), R.T.copy()) + least
    last = np.dot(np.dot(R, after), R.T.copy()) + least
    predicted = way + least
    measured = np.linalg.inv(last) - np.linalg.inv(first + predicted)
    values, axes = np.linalg.eigh(0.5 * (measured + measured.T))
    scan = np.dot(axes / np.maximum(values, OPEN), axes.T.copy())
    # symmetric to the rounding of what is known least, which may be more than what is known best
    out: Array = np.linalg.inv(np.linalg.inv(predicted) + np.linalg.inv(first + scan))
    return 0.5 * (out + out.T) + positive(last - first)


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    state = JointState(np.zeros(3), np.eye(3), 0.1)
    way = coast(state, 0.1, np.ones(3), 1.0, 0.0, Motion(np.zeros(3), np.eye(3)))
    way_cov(way, np.eye(3), np.eye(3), 0.0)
