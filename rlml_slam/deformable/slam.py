# SPDX-License-Identifier: Apache-2.0
"""The third system: observations of a robot beside a deforming carrier become frames."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from rlml_slam.deformable.bridge import bridge
from rlml_slam.deformable.gyro_bias import GyroBias
from rlml_slam.deformable.velocity import VelocityHistory
from rlml_slam.deformable.window import CarrierVelocity, DeformableWindow, WindowEstimate
from rlml_slam.errors import InputError, SolverError
from rlml_slam.params import DeformableParameters
from rlml_slam.se2 import Array, compose, compose_jacobians
from rlml_slam.types import Detections, Frame, Health, Level, Motion, Observation, Status


class DeformableSlam:
    """A sliding window with what surrounds it: motion, the carrier's velocity, health.

    ``estimate`` is the newest one, ``velocity`` what the carrier did before it. Poses are in the
    map frame; the frame's local pose is the same one.
    """

    def __init__(self, params: DeformableParameters) -> None:
        self._p = params
        self.restart()

    def restart(self) -> None:
        """Forget everything, the announced velocities included."""
        self._velocities = VelocityHistory(self._p.deformable.velocity_timeout)
        self.begin_at(np.array(self._p.node.map_start_pose))

    def begin_at(self, pose: Array, cov: Array | None = None) -> None:
        """Restart at ``pose`` (3,) with covariance ``cov`` (3, 3) and no features."""
        p = self._p
        self._window = DeformableWindow(p.deformable, p.reflector, pose, cov)
        self._bias = GyroBias(p.motion)
        self._stamp: int | None = None
        self._wheels: Array | None = None  # raw odometry of the last observation
        self._last_seen: int | None = None  # stamp with a detection of a known feature
        self.estimate: WindowEstimate | None = None
        self.velocity = CarrierVelocity(np.zeros(2))

    def announce(self, stamp: int, velocity: CarrierVelocity, in_base: bool = False) -> None:
        """The velocity from ``stamp`` on, in the map's axes or the robot's, which turn with it."""
        if in_base:
            velocity = replace(velocity, linear=np.zeros(2), base_linear=velocity.linear)
        self._velocities.add(stamp, velocity)

    def process(self, observation: Observation) -> Frame:
        """One observation with detections, or none, later than the one before."""
        started = time.perf_counter()
        stamp, trouble = observation.stamp, list[str]()
        motion = self._motion(observation)
        velocity = CarrierVelocity(np.zeros(2))
        if self._stamp is not None:
            velocity = self._velocities.mean(self._stamp, stamp)
        seen = observation.detections
        detections = _nothing(stamp) if seen is None else seen
        estimate = self._update(stamp, motion, detections, velocity, trouble)
        first, self._stamp = self._stamp is None, stamp
        self.estimate, self.velocity = estimate, velocity.in_map(float(estimate.pose[2]))
        health = self._health(estimate, first or motion.known, trouble)
        return Frame(
            stamp, observation, estimate.pose, estimate.cov, estimate.pose, estimate.cov,
            estimate.keys, estimate.statuses, health, chi2=estimate.chi2,
            iterations=estimate.iterations, wall_ms=1e3 * (time.perf_counter() - started),
        )  # fmt: skip

    def _update(
        self, stamp: int, motion: Motion, detections: Detections, velocity: CarrierVelocity,
        trouble: list[str],
    ) -> WindowEstimate:  # fmt: skip
        """The window's next step; without the detections where they make it impossible."""
        try:
            return self._window.update(stamp, motion, detections, velocity)
        except InputError as e:
            if len(detections) == 0:
                raise
            trouble.append(str(e))  # the robot has moved all the same
        except SolverError as e:
            if trouble and len(detections) == 0:
                raise
            trouble.append(f'{e}: restarted')
            self._begin_after(motion)
        return self._update(stamp, motion, _nothing(stamp), velocity, trouble)

    def _motion(self, observation: Observation) -> Motion:
        """Motion since the last observation without the gyro's bias, its covariance regular."""
        dt = 1.0 if self._stamp is None else (observation.stamp - self._stamp) * 1e-9
        motion = self._bias.correct(observation.motion, dt)
        if not motion.known:
            motion = bridge(motion, self._wheels, observation.odom_pose, dt, self._p.motion)
        self._wheels = observation.odom_pose
        floor = self._p.deformable.motion_floor**2 * dt * np.eye(3)
        return replace(motion, cov=motion.cov + floor)

    def _begin_after(self, motion: Motion) -> None:
        """Restart where the robot is by odometry."""
        if self.estimate is None:
            self.begin_at(np.array(self._p.node.map_start_pose))
            return
        J_a, J_b = compose_jacobians(self.estimate.pose, motion.delta)
        cov = J_a @ self.estimate.cov @ J_a.T + J_b @ motion.cov @ J_b.T
        self.begin_at(compose(self.estimate.pose, motion.delta), cov)

    def _health(self, estimate: WindowEstimate, moved: bool, reasons: list[str]) -> Health:
        p, known = self._p, len(estimate.features.keys)
        if not moved:
            reasons.append('odometry does not cover the motion')
        age, lead = self._velocities.age(estimate.stamp), self._velocities.lead(estimate.stamp)
        if age is None:
            reasons.append('no carrier_velocity yet: the carrier is taken to stand still')
        elif lead > p.deformable.velocity_timeout:
            reasons.append(f'carrier_velocity is stamped {lead:.1f} s ahead')
        elif age > p.deformable.velocity_timeout:
            reasons.append(f'carrier_velocity is {age:.1f} s old')
        if np.any(estimate.statuses == Status.USED) or self._last_seen is None:
            self._last_seen = estimate.stamp
        blind = (estimate.stamp - self._last_seen) * 1e-9
        if known == 0:
            reasons.append('no feature of the carrier is known')
        elif blind > p.deformable.candidate_timeout:
            reasons.append(f'saw 0 of {known} known features for {blind:.1f} s')
        if not moved and (known == 0 or blind > 0.0):
            return Health(Level.LOST, tuple(reasons))
        return Health(Level.DEGRADED if reasons else Level.OK, tuple(reasons))


def _nothing(stamp: int) -> Detections:
    """An observation without detections moves robot and carrier on."""
    none = np.zeros(0)
    return Detections(
        stamp, '', np.zeros((0, 2)), np.zeros((0, 2, 2)), none.astype(np.int64), none
    )
