# SPDX-License-Identifier: Apache-2.0
"""The bias of the gyro beside the window, which has no place for it in its steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rlml_slam.params import MotionNoise
from rlml_slam.types import Motion

GATE = 16.0  # squared sigmas beyond which wheels that disagree with the gyro are taken to slip


class GyroBias:
    """A scalar Kalman filter of the bias, a random walk measured by wheels against gyro."""

    def __init__(self, noise: MotionNoise) -> None:
        self._walk2 = noise.imu_bias_walk**2
        self._time = 0.0  # [s] since the start
        self.bias, self.variance = 0.0, noise.imu_bias_sigma**2

    def correct(self, motion: Motion, dt: float) -> Motion:
        """The motion of the last ``dt`` seconds less the bias; as it is without a gyro.

        The bias errs in the same direction for a time tau: its age, or P / q of the random walk
        once that is less. An error that lasts adds (2 tau / dt + 1) P per step to the variance of
        the sum, which is what the covariance of the step is widened by.
        """
        self._time += dt
        self.variance += self._walk2 * dt
        if math.isfinite(motion.bias_var):
            self._measure(motion.bias, motion.bias_var)
        if not np.any(motion.bias_gain):
            return motion
        tau = self._time
        if self._walk2 > 0.0:
            tau = min(tau, self.variance / self._walk2)
        spread = self.variance * (2.0 * tau / dt + 1.0)
        gain = motion.bias_gain
        return replace(
            motion,
            delta=motion.delta + gain * self.bias,
            cov=motion.cov + spread * np.outer(gain, gain),
        )

    def _measure(self, bias: float, variance: float) -> None:
        S = self.variance + variance
        error = bias - self.bias
        if error * error < GATE * S:
            self.bias += self.variance / S * error
            self.variance *= variance / S
