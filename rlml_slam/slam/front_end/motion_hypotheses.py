# SPDX-License-Identifier: Apache-2.0
"""Several predictions where the sources of motion disagree.

Odometry may stall: it repeats its pose while the robot drives, and then catches up in one step.
Scans have shown the motion meanwhile, so the step must not be added to it. Wheels are integrated
on the robot: the odometry since the last frame at which it was trusted is one measurement,
whatever came in between. And a gyro may be wrong for a moment. So there are up to four hypotheses:
odometry since the last frame, odometry since it was trusted, that the robot goes on as it went,
and that it turned as the wheels did. Scan and reflectors choose (:meth:`ScanTerm.fit`).

In a bare corridor they cannot: several motions fit, at different places. Then the motion is a
guess, from which no velocity follows, and the odometry is as open as it was before.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
PENALTY = 0.1  # share of a fit that a motion loses which no robot has
SINCE = 0.1  # penalty of the odometry since it was trusted, and
DOUBT = 0.2  # of a motion that is not the odometry's
GUESSED = 0.3  # after a guess, of any but the odometry since it was trusted
OPEN = 0.03  # motions whose fits differ by less are both possible


# how well scan and reflectors of an observation fit, 0 to 1, and at which pose (3,)
Found = tuple[float, Array] | None
Fit = Callable[[Observation], Found]


@dataclass(frozen=True)
class Hypothesis:
    """An observation with one of the motions, and scan de-skewed by it.

    ``penalty`` is 0 to 1, for accelerations that no robot has.
    """

    observation: Observation
    penalty: float


class MotionHypotheses:
    """Keeps the last frame at which odometry was trusted, with its pose and raw odometry (3,)."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self.forget()

    def forget(self) -> None:
        """The pose was moved: what comes is not compared with what was before."""
        self._trusted: tuple[int, Array, Array] | None = None
        self._last: tuple[int, Array] | None = None  # stamp and pose of the last frame
        self._last_odometry: Array | None = None  # raw (3,) at that frame
        self._agreed = 0  # frames in a row, since it is open, at which odometry agreed
        self._velocity: tuple[int, Array] | None = None  # the last one known, and its stamp
        self._is_guessed = False  # the newest motion: neither odometry nor scan says it
        self._rests = False  # the robot, by its velocity before the newest motion

    def likeliest(self, observation: Observation, velocity: Array | None, fit: Fit) -> Observation:
        """The observation with the motion that fits best; ``velocity`` (3,) as in :meth:`of`.

        While several fit about as well, the covariance of the motion is that of their mixture.
        Where nothing was seen, it is the first one, the odometry's.
        """
        if self._trusted is None or observation.stamp - self._trusted[0] > LONGEST * 1e9:
            self._is_guessed = False
        hypotheses = self.of(observation, velocity)
        if len(hypotheses) == 1:  # which decides nothing: a guess stays one
            return hypotheses[0].observation
        found = [fit(h.observation) for h in hypotheses]
        if found[0] is None:
            return hypotheses[0].observation
        scores = np.array([0.0 if f is None else f[0] for f in found])
        likely = scores - PENALTY * np.array([h.penalty for h in hypotheses])
        best = int(np.argmax(likely))
        motions = [h.observation.motion.delta for h in hypotheses]
        alike = scores > scores[best] - OPEN
        before = self._is_guessed
        known = observation.motion.known
        may_stall = before or (known and not observation.motion.delta.any())
        is_free = _is_free(motions, found, alike, before)
        self._is_guessed = may_stall and is_free
        if is_free and alike[0] and known and self._rests:  # as a stall may have made of it
            best = 0
        chosen = hypotheses[best].observation
        if self._is_guessed and (before or chosen.motion.known):
            return chosen  # the same doubt again, or one that ends when the odometry catches up
        cov = chosen.motion.cov.copy()
        for k in np.flatnonzero(likely > likely[best] - OPEN):
            away = se2.between(motions[best], motions[k])
            cov += np.outer(away, away)
        return replace(chosen, motion=replace(chosen.motion, cov=cov))

    def of(self, observation: Observation, velocity: Array | None) -> list[Hypothesis]:
        """What may have happened since the last frame, the odometry's motion first.

        It is the only one where nothing speaks against it. ``velocity`` (3,) is that until then,
        None if it is unknown.
        """
        single = [Hypothesis(observation, 0.0)]
        if self._last is None or self._trusted is None:
            return single
        dt = (observation.stamp - self._last[0]) * 1e-9
        if dt <= 0.0:
            return single
        velocity = self._known(observation.stamp, velocity)
        motions = list[tuple[Motion, float]]()
        for motion, penalty in self._motions(observation, velocity, dt):
            if all(_differ(motion.delta, other.delta) for other, _ in motions):
                motions.append((motion, penalty))
        if len(motions) == 1:
            return single
        return [Hypothesis(self._moved(observation, m, dt), penalty) for m, penalty in motions]

    def _motions(
        self, observation: Observation, velocity: Array | None, dt: float
    ) -> list[tuple[Motion, float]]:
        """Motions of ``dt`` [s] with their penalties, those that are the same among them."""
        plain, since = observation.motion, self._since_trusted(observation, velocity)
        sudden = _penalty(plain.delta, velocity, dt)
        if since is not None and not _differ(since[0].delta, plain.delta):
            # so it moved since it was trusted, not in one step
            sudden, since = min(sudden, since[1]), None
        # of a burst of stamps, the times say nothing of the speed
        is_odd = sudden > 0.5 and dt >= SHORTEST
        if not plain.delta.any():
            is_odd = _goes_on(velocity, dt)
        self._rests = velocity is not None and not _goes_on(velocity, dt)
        out = [(plain, sudden)]
        if since is not None:
            a, b = (GUESSED, 0.0) if self._is_guessed else (0.0, SINCE)
            out = [(plain, sudden + a), (since[0], since[1] + b)]
        if velocity is not None and (since is not None or not plain.known or is_odd):
            out.append((_onward(velocity, dt), GUESSED if self._is_guessed else DOUBT))
        wheels = self._by_wheels(observation, dt)
        if wheels is not None:
            out.append((wheels, DOUBT + _penalty(wheels.delta, velocity, dt)))
        return out

    def _known(self, stamp: int, velocity: Array | None) -> Array | None:
        """The velocity; after a guess the last one that was none, while it lasts."""
        assert self._last is not None
        if not self._is_guessed:
            self._velocity = None if velocity is None else (self._last[0], velocity)
        if self._velocity is None or stamp - self._velocity[0] > FRESH * 1e9:
            return None
        return self._velocity[1]

    def _moved(self, observation: Observation, motion: Motion, dt: float) -> Observation:
        """The observation with another motion, and its scan de-skewed by that."""
        if motion is observation.motion:
            return observation
        max_range = self._p.submap.max_laser_range
        observation = replace(observation, motion=motion)
        return deskewed(observation, se2.log(motion.delta) / dt, max_range)[0]

    def _since_trusted(
        self, observation: Observation, velocity: Array | None
    ) -> tuple[Motion, float] | None:
        """The motion since the last frame by the odometry since it was trusted, if it is open.

        With its penalty, of the whole way since.
        """
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
        cov = motion_of(way, dt, self._p.motion).cov + np.diag(SAME**2)
        return Motion(delta, cov), _penalty(way, velocity, dt)

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
            stands = not observation.motion.delta.any()
            is_open = stamp != last[0] or (stands and moved) or self._is_guessed
            agrees = is_open and self._agrees(observation, way, dt, there, last[1])
            self._agreed = self._agreed + 1 if agrees else 0
            if is_open and dt < LONGEST and self._agreed < CONFIRM:
                return
        self._trusted = (observation.stamp, pose, np.asarray(odometry))
        self._agreed, self._is_guessed = 0, False

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


def _onward(velocity: Array, dt: float) -> Motion:
    """The motion in ``dt`` [s] of a robot that goes on at a velocity (3,)."""
    sigma = ACCELERATION * max(dt, SHORTEST) * dt
    cov = np.diag(sigma**2 + (0.5 * SAME) ** 2)
    return Motion(se2.exp(velocity * dt), cov, known=False)


def _is_free(
    motions: list[Array], found: list[Found], alike: NDArray[np.bool_], before: bool
) -> bool:
    """Whether motions (3,) that fit alike lead to poses more than a quarter as far apart.

    As it was ``before`` where they are too close to each other for this.
    """
    says = False
    for a, b in itertools.combinations(np.flatnonzero(alike).tolist(), 2):
        one, other = found[a], found[b]
        if one is None or other is None:
            return True
        apart = np.abs(se2.between(motions[a], motions[b]))
        if (np.abs(se2.between(one[1], other[1])) > 0.25 * (SAME + apart)).any():
            return True
        says = says or bool((apart > MOVED).any())
    return before and not says and bool(alike.sum() > 1)


def _goes_on(velocity: Array | None, dt: float) -> bool:
    """Whether a robot is not where it was, if it goes on as it went."""
    return velocity is not None and bool((np.abs(se2.exp(velocity * dt)) > SAME).any())


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
