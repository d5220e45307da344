# SPDX-License-Identifier: Apache-2.0
"""The error that pose and submaps have in common, which nothing measures until the graph does.

It is that of a gap after which new submaps begin, of a way by which the robot was carried, and of
a heading that drifts with the submaps (eq. 71). A filter that is linearized at an unknown heading
finds one in the noise of what is seen from there (Julier, Uhlmann 2001: A counter example to the
theory of simultaneous localization and map building), and turns what is mapped next. So it is kept
beside the joint state.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.estimation.correction import carried
from rlml_slam.se2 import Array


class CommonError:
    """Covariance (3, 3), local axes, of where the newest stretch begins; zero at first."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """The joint state has all of the covariance."""
        self._begin, self._cov = np.zeros(2), np.zeros((3, 3))

    def add(self, pose: Array, cov: Array) -> None:
        """A stretch begins at a local pose (3,), which is uncertain by ``cov`` (3, 3) more."""
        self._cov = carried(self._cov, pose[:2] - self._begin) + cov
        self._begin = pose[:2]

    def belief(self, pose: Array, cov: Array) -> tuple[Array, Array]:
        """A local pose (3,), and its covariance (3, 3) with that of the common error."""
        if self._cov.any():
            cov = cov + carried(self._cov, pose[:2] - self._begin)
        return pose, cov
