# SPDX-License-Identifier: Apache-2.0
"""Prediction of the joint state: odometry and IMU (e_o of eq. 2), or constant velocity.

Scale errors of the wheels. The joint state has the scale errors of speed and turn. Their effect
is proportional to the true motion. The measured motion must not replace it in the derivatives:
its noise would bias the estimate towards zero by noise^2 / motion^2 (errors in variables). The
motion estimated just before has about the same size and independent noise, so it serves as the
instrument of instrumental variables (Reiersøl 1941). A motion below the noise floor carries no
information about the scale. With a lidar, stretches of some seconds measure it instead (eq. 65):
where odometry is late, that instrument is biased.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.correction import positive
from rlml_slam.estimation.odometry_noise import OdometryNoise
from rlml_slam.estimation.scale_error import ScaleError
from rlml_slam.params import MotionNoise, Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import sweep_time
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.constant_velocity import ConstantVelocity
from rlml_slam.slam.front_end.joint_state import (
    BIAS,
    DRIFT,
    GATE,
    PIVOT,
    SPEED,
    STANDING,
    TURN,
    JointState,
    begin_sweep,
    end_sweep,
    expect_pivot,
    narrow_scale_errors,
    pivot_gain,
    predict_unseen,
)
from rlml_slam.slam.front_end.motion_hypotheses import FRESH, Fit, MotionHypotheses
from rlml_slam.slam.front_end.scan_update import relative
from rlml_slam.types import Motion, Observation

# [ns] shortest time over which a velocity is computed. Scans that arrive in a burst are too close:
# a pose error of 2 mm would be 0.4 m/s over 5 ms, and is .04 m/s over this time.
MIN_INTERVAL = 50_000_000
SCALES = slice(SPEED, TURN + 1)
WHOLE = 0.9  # share of a sweep from which on the next stamp counts as its end, for its jitter


class MotionTerm:
    """Moves the joint state from one observation to the next; has the newest velocity.

    ``stamp`` [ns] is that of the newest observation, None before the first, ``interval`` [s] the
    time since the one before. ``has_odometry``: one had odometry. ``is_constant_velocity``: the
    last prediction had none. ``velocity`` (3,) [m/s, m/s, rad/s] is that of the base.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params.motion
        self._constant_velocity = ConstantVelocity(params.motion)
        self._hypotheses = MotionHypotheses(params)
        self._odometry_noise = OdometryNoise(params.motion)
        self._scale_errors = {SPEED: ScaleError(), TURN: ScaleError()}
        # before the corrections: pose, scale errors and their covariance
        self._held = np.zeros(3), np.zeros(2), np.zeros((2, 2))
        self._known = np.zeros((3, 3))  # covariance in the submap, after the corrections
        self._predicted: tuple[Array, Array] | None = None  # pose in the submap, covariance
        self._odometry = STANDING  # the newest motion that it measured
        self.has_lidar = False
        self.stamp: int | None = None
        self.interval = 0.0
        self.has_odometry = self.is_constant_velocity = False
        self.forget_velocity()

    def forget_velocity(self) -> None:
        """Start again with velocity 0: the pose was moved."""
        self.velocity = np.zeros(3)
        self._is_velocity_known = False
        self._hypotheses.forget()
        self._begin_stretch()
        self._since: tuple[int, Array] | None = None  # stamp and pose of the last velocity
        # of the newest observation's sweep: its time [s], and the covariance of its motion
        self._sweep: tuple[float, Array] | None = None

    def likeliest(self, observation: Observation, fit: Fit) -> Observation:
        """The observation with the motion since the last one by which it has the best fit."""
        velocity = self.velocity if self._is_velocity_known else None
        if self.stamp is not None:
            dt = (observation.stamp - self.stamp) * 1e-9
            observation = self._odometry_noise.scaled(observation, dt)
        self._odometry = observation.motion.delta
        return self._hypotheses.likeliest(observation, velocity, fit)

    def predict(self, state: JointState, observation: Observation) -> None:
        """Move the pose to the stamp of the observation (eq. 5 to 9)."""
        last, self.stamp = self.stamp, observation.stamp
        if observation.points is not None:
            narrow_scale_errors(state, self._p.scale_error_sigma)
            if state.wheels2[-1] < self._p.pivot_sigma**2:
                expect_pivot(state, self._p.pivot_sigma)
            self.has_lidar = True
        self.has_odometry |= observation.odom_pose is not None
        self.is_constant_velocity = not self.has_odometry and last is not None
        self.interval = dt = 0.0 if last is None else (observation.stamp - last) * 1e-9
        p, motion = self._p, observation.motion
        if self.is_constant_velocity:
            self._constant_velocity.predict(state, dt, motion)
            return
        walk, kept = p.imu_bias_walk**2 * dt, math.exp(-dt / p.scale_error_time)
        before, cov = state.pose, self._sweep_within(motion, dt)
        if self.has_lidar and not np.array_equal(self._known, relative(state.x, state.P)[1]):
            self._begin_stretch()  # in another submap, or moved: the pose is known otherwise
        if cov is not None:
            motion = replace(motion, cov=positive(motion.cov - cov))
        if motion.known and dt > FRESH and not self.has_lidar:
            predict_unseen(state, motion, walk, kept)
        else:
            expected = expected_motion(self.velocity, dt, p) if motion.known else STANDING
            state.predict(motion, walk, kept, expected)
        if cov is not None:
            end_sweep(state.x, state.P, float(before[2]))
        self._begin_sweep(state, observation)
        self._predicted = relative(state.x, state.P)
        self._held = before, state.x[SCALES].copy(), state.P[SCALES, SCALES].copy()

    def _sweep_within(self, motion: Motion, dt: float) -> Array | None:
        """Covariance (3, 3) of the newest sweep where all of it is within this motion.

        Else its error is left out: what other sources say does not have it, and of a part of a
        sweep only a part, which is not known.
        """
        if self._sweep is None or not self._is_odometry(motion):
            return None
        lasts, cov = self._sweep
        return cov if dt > WHOLE * lasts else None

    def _begin_sweep(self, state: JointState, observation: Observation) -> None:
        """The sweep of this scan, if it was de-skewed by odometry that covers it."""
        lasts = 0.0 if observation.scan is None else sweep_time(observation.scan)
        self._sweep, cov = None, np.zeros((3, 3))
        known = observation.sweep_cov if self._is_odometry(observation.motion) else None
        if lasts > 0.0 and observation.sweep is not None and known is not None:
            cov = self._odometry_noise.cov_of(observation.sweep[-1], lasts, known)
            self._sweep = lasts, cov
        if self.has_odometry:
            begin_sweep(state, cov)

    def _is_odometry(self, motion: Motion) -> bool:
        """Whether a motion is the one that odometry measured, known to its end."""
        return motion.known and motion.delta is self._odometry

    @property
    def sweep(self) -> Sweep:
        """How an error of odometry in the newest sweep moves the match of its scan."""
        return Sweep() if self._sweep is None else Sweep(half=np.full(3, 0.5))

    def corrected(self, state: JointState, observation: Observation) -> Observation:
        """The observation with its motion as estimated now; measures the velocity."""
        self._measure_velocity(observation.stamp, state.pose)
        self._hypotheses.learn(observation, state.pose)
        if self.is_constant_velocity:
            motion = self._constant_velocity.estimated(state, observation.motion)
        else:
            assert self._predicted is not None
            now = relative(state.x, state.P)
            self._odometry_noise.learn(observation.motion, self._predicted, now)
            if self.has_lidar:
                self._learn_scale_errors(state, observation.motion, now)
                self._known = now[1]
            motion = state.corrected(observation.motion)
            observation = self._placed(state, observation)
        return replace(observation, motion=motion)

    def _begin_stretch(self) -> None:
        for error in self._scale_errors.values():
            error.forget()

    def _learn_scale_errors(
        self, state: JointState, motion: Motion, now: tuple[Array, Array]
    ) -> None:
        """Take back what the corrections say of them; at the end of a stretch, measure them.

        ``now`` is the pose (3,) in the submap, and its covariance (3, 3).
        """
        before, state.x[SCALES], state.P[SCALES, SCALES] = self._held
        if not self._is_odometry(motion) or self.interval > FRESH:
            self._begin_stretch()
            return
        moved = (
            motion.delta + state.x[BIAS] * motion.bias_gain + state.x[DRIFT] * motion.drift_gain
        )
        turned = state.x[PIVOT] * pivot_gain(moved[2])
        went, cov = se2.between(before, state.pose), se2.rotate_cov(now[1], -now[0][2])
        if motion.bias_gain[2] != 0.0:  # a gyro turned it: of the wheels, nothing is known
            self._scale_errors[TURN].forget()
        for row, axis, gain in ((SPEED, 0, moved[0]), (TURN, 2, motion.turn_gain[2])):
            rest = went[axis] - turned[axis] - moved[axis]
            rest = se2.wrapped(rest) if row == TURN else rest
            # that as estimated: the noise of odometry would bias the error (errors in variables)
            gain = (gain + rest) / (1.0 + state.x[row]) if gain else 0.0
            found = self._scale_errors[row].add(
                rest, (gain, motion.drift_gain[axis]), motion.cov[axis, axis], self.interval,
                cov[axis, axis],
            )  # fmt: skip
            if found is not None:
                measure_scale_error(state, row, *found)

    def _placed(self, state: JointState, observation: Observation) -> Observation:
        """The observation with its end points where its sweep is by the state as it is now."""
        half = self.sweep.half * state.velocity
        if observation.points is None or not half.any():
            return observation
        return replace(observation, points=se2.transform(se2.exp(half), observation.points))

    def _measure_velocity(self, stamp: int, pose: Array) -> None:
        if self._since is None:
            self._since = (stamp, pose)
        elif stamp - self._since[0] >= MIN_INTERVAL:
            dt = (stamp - self._since[0]) * 1e-9
            self._is_velocity_known = True
            self.velocity = se2.log(se2.between(self._since[1], pose)) / dt
            self._since = (stamp, pose)

    def stamp_error_cov(self, heading: float, sigma: float) -> Array:
        """Covariance (3, 3), local axes, of the motion during the error ``sigma`` [s] of a stamp.

        It is added to what is published only: the errors of two successive stamps are nearly the
        same, so that the map and the next pose do not have it.
        """
        if sigma == 0.0:
            return np.zeros((3, 3))
        moved = se2.rotation3(heading) @ self.velocity * sigma
        return np.outer(moved, moved)


def measure_scale_error(state: JointState, row: int, rest: float, H: Array, R: float) -> None:
    """Update the scale error in ``row`` by a stretch (eq. 65); nothing else moves.

    ``H`` (2,) is by the scale error and the drift. A pose that moved would have to turn with its
    anchor (:meth:`JointState.turn_with_anchor`).
    """
    columns = np.array([row, DRIFT])
    PH = H @ state.P[columns]
    v, S = rest - H[0] * state.x[row], PH[columns] @ H + R
    if v * v < GATE * S:  # else the wheels slip
        K = PH[row] / S
        state.x[row] += K * v
        state.P[row] -= K * PH
        state.P[:, row] = state.P[row]


def expected_motion(velocity: Array, dt: float, noise: MotionNoise) -> Array:
    """Distance and turn (2,) [m, rad] in ``dt`` [s] at a velocity (3,), less the noise floors.

    Zeros if the velocity is too old, or faster than the robot can be because the pose was
    corrected. The measured motion must not bound it, or its noise would enter again.
    """
    v, w = float(velocity[0]), float(velocity[2])
    if dt > FRESH or abs(v) > noise.max_speed or abs(w) > noise.max_turn_rate:
        return np.zeros(2)
    return np.array(
        [
            dt * math.copysign(max(abs(v) - noise.speed_noise_floor, 0.0), v),
            dt * math.copysign(max(abs(w) - noise.turn_noise_floor, 0.0), w),
        ]
    )
