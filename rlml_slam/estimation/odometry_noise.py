# SPDX-License-Identifier: Apache-2.0
"""The noise of this robot's odometry, estimated from what its scans and reflectors correct.

The noise of the parameters has to hold for every robot. Where the wheels are better, as much would
be added to the pose while nothing is seen that matches, and search windows would be far too large.

In each step, the correction of the pose has the variance P- - P+. So the innovation v and its
variance S = R + P- follow, and S is the variance without the newest motion, plus a Q, where Q is
that of the parameters and a the share that is estimated: a = (v^2 - (S - a Q)) / Q, as a weighted
mean over the steps (eq. 56; innovation-based adaptive estimation, Mehra 1972). It is at most 1.
Where scans are de-skewed by odometry, S has parts of two sweeps; the share that explains v^2 is
the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.params import MotionNoise
from rlml_slam.se2 import Array
from rlml_slam.types import Motion, Observation

AXES = np.array([0, 2])  # along the base, and its turn
LONGEST = 1.0  # [s] of a motion: one across a gap is as uncertain as the parameters say
PRIOR = 100.0  # steps that count as if the parameters were right
MEMORY = 1000.0  # steps after which one counts e times less
LEAST = 0.05  # smallest share of the variance
OUTLIER = 1000.0  # [S] larger v^2 count as this: wheels that slip once are doubted for long
SEEN = 0.2  # share by which a step has to lower the variance, to say something of the motion


class OdometryNoise:
    """Shares (2, 2) of the variances of AXES, for motions that are slow and that are fast.

    Slow is a motion in which the floor of its noise is larger than the part per speed.
    """

    def __init__(self, noise: MotionNoise) -> None:
        self._floors = np.array([noise.speed_noise_floor, noise.turn_noise_floor])
        self._slopes = np.array([noise.speed_noise, noise.turn_noise])
        self._sums = np.zeros((2, 2, 2))  # of a Q / S^2 and of Q^2 / S^2
        self._applied: tuple[Array, NDArray[np.int64], Array] | None = None

    @property
    def shares(self) -> Array:
        """Estimates (2, 2), by axis and by slow or fast."""
        up, down = self._sums
        return np.clip((PRIOR + up) / (PRIOR + down), LEAST, 1.0)

    def scaled(self, observation: Observation, dt: float) -> Observation:
        """The observation with the noise of this robot's odometry in the last ``dt`` [s].

        One that stands, but for what its wheels jitter, says nothing of how it drives.
        """
        motion, self._applied = observation.motion, None
        fast = self._fast(motion.delta, dt)
        if not motion.known or fast is None:
            return observation
        self._applied = motion.delta, fast, motion.cov[AXES, AXES]
        return replace(observation, motion=replace(motion, cov=self._scaled(motion.cov, fast)))

    def cov_of(self, delta: Array, dt: float, cov: Array) -> Array:
        """The covariance (3, 3) of a motion (3,) of ``dt`` [s], with this noise."""
        fast = self._fast(delta, dt)
        return cov if fast is None else self._scaled(cov, fast)

    def _fast(self, delta: Array, dt: float) -> NDArray[np.int64] | None:
        """Whether each of AXES is fast, None for a robot that stands or a time that is odd."""
        moved = np.abs(delta[AXES])
        if not 0.0 < dt <= LONGEST or (moved < self._floors * dt).all():
            return None
        fast: NDArray[np.int64] = (self._slopes * moved > self._floors * dt).astype(np.int64)
        return fast

    def _scaled(self, cov: Array, fast: NDArray[np.int64]) -> Array:
        scale = np.ones(3)
        scale[AXES] = np.sqrt(self.shares[[0, 1], fast])
        return cov * np.outer(scale, scale)

    def learn(
        self, motion: Motion, before: tuple[Array, Array], after: tuple[Array, Array]
    ) -> None:
        """Take a step; one with another ``motion`` than that scaled last says nothing.

        ``before`` and ``after`` its updates: pose (3,) in the submap, and covariance (3, 3).
        """
        if self._applied is None or motion.delta is not self._applied[0]:
            return
        (_, fast, Q), (pose, P), (corrected, P_new) = self._applied, before, after
        error = se2.between(pose, corrected)
        P, P_new = (se2.rotate_cov(p, -pose[2]) for p in (P, P_new))
        for axis, k in enumerate(AXES.tolist()):
            gain = 1.0 - P_new[k, k] / max(P[k, k], 1e-18)
            if gain < SEEN or Q[axis] <= 0.0:
                continue
            S = P[k, k] / gain
            v2 = min((error[k] / gain) ** 2, OUTLIER * S)
            rest = S - motion.cov[k, k]
            sums = self._sums[:, axis, fast[axis]]
            sums *= 1.0 - 1.0 / MEMORY
            sums += np.array([v2 - rest, Q[axis]]) * Q[axis] / S**2
