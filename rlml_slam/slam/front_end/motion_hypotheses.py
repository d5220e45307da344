# SPDX-License-Identifier: Apache-2.0
"""Several predictions where the sources of motion disagree.

Odometry may stall: it repeats its pose while the robot drives, and then catches up in one step.
Scans have shown the motion meanwhile, so the step must not be added to it. Wheels are integrated
on the robot: the odometry since the last frame at which it was trusted is one measurement,
whatever came in between. And a gyro may be wrong for a moment. So there are up to four hypotheses:
odometry since the last frame, odometry since it was trusted, that the robot goes on as it went,
and that it turned as the wheels did. Scan and reflectors choose (:meth:`ScanTerm.likeliest`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rlml_slam import se2
from rlml_slam.motion import is_possible, motion_of
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.velocity_deskew import deskewed
from rlml_slam.types import Motion, Observation

FRESH = 1.0  # [s] for which a velocity is assumed to last: a robot takes about as long to stop
# [m/s^2, m/s^2, rad/s^2] 1 sigma of what a robot's velocity changes by
ACCELERATION = np.array([1.0, 0.3, 3.0])
SUDDEN = 3.0  # [sigma] a robot does not start as suddenly as that; it may stop so
SHORTEST = 0.1  # [s] over which a velocity is known well enough to say so
MOVED = np.array([0.05, 0.05, 0.05])  # [m, m, rad] by scans, while the odometry stands still
SAME = np.array([0.02, 0.02, 0.01])  # [m, m, rad] hypotheses that are closer are one
# frames in a row: a scan within the step of odometry that catches up gets a part of it, which may
# agree by chance
CONFIRM = 2
TURN = 0.1  # [rad] by which gyro and wheels disagree: errors of both in a step are smaller
LONGEST = 5.0  # [s] of a stall; after that, odometry is what it is


@dataclass(frozen=True)
class Hypothesis:
    """An observation with one of the motions, and scan de-skewed by it.

    ``penalty`` is 0 to 1, for accelerations that no robot has.
    """

    observation: Observation
    penalty: float


class MotionHypotheses:
    """The last frame at which odometry was trusted: its stamp [ns], pose and raw odometry (3,)."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self.forget()

    def forget(self) -> None:
        """The pose was moved: what comes is not compared with what was before."""
        self._trusted: tuple[int, Array, Array] | None = None
        self._last: tuple[int, Array] | None = None  # stamp and pose of the last frame
        self._last_odometry: Array | None = None  # raw (3,) at that frame
        self._agreed = 0  # frames in a row, since it is open, at which odometry agreed

    def of(self, observation: Observation, velocity: Array | None) -> list[Hypothesis]:
        """What may have happened since the last frame, the odometry's motion first.

        It is the only one where nothing speaks against it. ``velocity`` (3,) is that until then,
        None if it is unknown.
        """
        plain, single = observation.motion, [Hypothesis(observation, 0.0)]
        if self._last is None or self._trusted is None:
            return single
        dt = (observation.stamp - self._last[0]) * 1e-9
        if dt <= 0.0:
            return single
        since, onward = self._since_trusted(observation), None
        velocity = velocity if dt <= FRESH else None
        if velocity is not None and (since or not plain.known or _is_odd(plain, velocity, dt)):
            sigma = ACCELERATION * max(dt, SHORTEST) * dt
            cov = np.diag(sigma**2 + (0.5 * SAME) ** 2)
            onward = Motion(se2.exp(velocity * dt), cov, known=False)
        motions = [plain]
        for other in (since, onward, self._by_wheels(observation, dt)):
            if other is not None and all(_differ(other.delta, m.delta) for m in motions):
                motions.append(other)
        if len(motions) == 1:
            return single
        return [
            Hypothesis(self._moved(observation, m, dt), _penalty(m.delta, velocity, dt))
            for m in motions
        ]

    def _moved(self, observation: Observation, motion: Motion, dt: float) -> Observation:
        """The observation with another motion, and its scan de-skewed by that."""
        if motion is observation.motion:
            return observation
        max_range = self._p.submap.max_laser_range
        observation = replace(observation, motion=motion)
        return deskewed(observation, se2.log(motion.delta) / dt, max_range)[0]

    def _since_trusted(self, observation: Observation) -> Motion | None:
        """The motion since the last frame by the odometry since it was trusted, if it is open."""
        assert self._trusted is not None
        assert self._last is not None
        stamp, pose, odometry = self._trusted
        if stamp == self._last[0] or observation.odom_pose is None:
            return None
        dt = (observation.stamp - stamp) * 1e-9
        way = se2.between(odometry, observation.odom_pose)
        if not is_possible(way, dt, self._p.motion):
            return None
        delta = se2.between(self._last[1], se2.compose(pose, way))
        # what the scans have shown since then is not without error either
        return Motion(delta, motion_of(way, dt, self._p.motion).cov + np.diag(SAME**2))

    def _by_wheels(self, observation: Observation, dt: float) -> Motion | None:
        """The motion since the last frame by the wheels alone, where a gyro says otherwise."""
        plain, odometry = observation.motion, observation.odom_pose
        if self._last_odometry is None or odometry is None or not plain.known:
            return None
        way = se2.between(self._last_odometry, odometry)
        agree = abs(se2.wrapped(way[2] - plain.delta[2])) < TURN
        if agree or not is_possible(way, dt, self._p.motion):
            return None
        return motion_of(way, dt, self._p.motion)

    def learn(self, observation: Observation, pose: Array) -> None:
        """Take the pose (3,) of the newest frame; trust the odometry where it agrees.

        One that stands exactly still while scans move is not trusted, and after that, or after it
        was missing, only when what it says is where the scans are.
        """
        last, self._last = self._last, (observation.stamp, pose)
        self._last_odometry = odometry = observation.odom_pose
        if odometry is None:
            return
        if last is not None and self._trusted is not None:
            stamp, there, then = self._trusted
            dt = (observation.stamp - stamp) * 1e-9
            way = se2.between(then, odometry)
            moved = bool((np.abs(se2.between(there, pose)) > MOVED).any())
            is_open = stamp != last[0] or (moved and not observation.motion.delta.any())
            agrees = is_open and self._agrees(observation, way, dt, there, last[1])
            self._agreed = self._agreed + 1 if agrees else 0
            if is_open and dt < LONGEST and self._agreed < CONFIRM:
                return
        self._trusted = (observation.stamp, pose, np.asarray(odometry))
        self._agreed = 0

    def _agrees(
        self, observation: Observation, way: Array, dt: float, there: Array, last: Array
    ) -> bool:
        """Whether odometry has moved, as the pose did since it was trusted or since the last."""
        if not way.any():
            return False
        assert self._last is not None
        whole, plain = motion_of(way, dt, self._p.motion), observation.motion
        return any(
            bool((np.abs(error) < MOVED + SUDDEN * np.sqrt(np.diag(motion.cov))).all())
            for motion, error in (
                (whole, se2.between(way, se2.between(there, self._last[1]))),
                (plain, se2.between(plain.delta, se2.between(last, self._last[1]))),
            )
            if motion.known
        )


def _is_odd(motion: Motion, velocity: Array, dt: float) -> bool:
    """Whether the odometry stands exactly still at a speed, or moves suddenly."""
    goes_on = np.abs(se2.exp(velocity * dt))
    if not motion.delta.any():
        return bool((goes_on > SAME).any())
    # of a burst of stamps, the times say nothing of the speed
    return dt >= SHORTEST and _penalty(motion.delta, velocity, dt) > 0.5


def _penalty(delta: Array, velocity: Array | None, dt: float) -> float:
    """Share to which a motion (3,) in ``dt`` [s] is too sudden: Geman and McClure's loss.

    Stamps err, by as much as an interval where a driver sends in bursts: twice as fast is not
    sudden, nor is a motion of less than MOVED.
    """
    if velocity is None:
        return 0.0
    sigma = ACCELERATION * max(dt, SHORTEST) * dt
    faster = np.maximum(np.abs(delta) - 2.0 * np.abs(velocity) * dt - MOVED, 0.0)
    u2 = float(np.max(faster / sigma)) ** 2
    return u2 / (u2 + SUDDEN**2)


def _differ(a: Array, b: Array) -> bool:
    return bool((np.abs(se2.between(a, b)) > SAME).any())
