# SPDX-License-Identifier: Apache-2.0
"""A scale error of the odometry, of its speed or turn, from stretches instead of single steps.

In a single step, odometry that is some milliseconds early or late looks like a scale error: where
a robot begins to turn, the turn of the step before is smaller, and where it ends to turn, larger,
so no motion that is known before is an instrument without bias. Over some seconds, such an error
of time is that of the two ends alone. So what a scan corrects leaves the scale error as it is (a
consider state: Schmidt 1966), and each stretch measures it (eq. 65).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rlml_slam.se2 import Array

LEAST = 3.0  # [s] of a stretch; it also lasts until the poses at its ends are surer than odometry


class ScaleError:
    """Sums the steps of a stretch: what they say of the scale error."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin a new stretch."""
        self._sums = np.zeros(5)
        self._start: float | None = None

    def add(
        self, rest: float, gains: Sequence[float], noise: float, dt: float, variance: float
    ) -> tuple[float, Array, float] | None:
        """Take a step of ``dt`` [s]; at the end of a stretch (rest, gains, variance) of all of it.

        ``rest`` [m or rad] is the motion that odometry does not explain but by its scale error,
        ``gains`` (2,) its derivatives by that and by the drift, ``noise`` the variance of
        odometry; ``variance`` is that of the pose in the submap after the step.
        """
        if self._start is None:
            self._start = variance
            return None
        self._sums += rest, *gains, noise, dt
        rest, *gains, noise, lasted = self._sums.tolist()
        ends = self._start + variance
        if lasted < LEAST or noise < ends:
            return None
        self._sums, self._start = np.zeros(5), variance
        return rest, np.array(gains), noise + ends
