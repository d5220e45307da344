# SPDX-License-Identifier: Apache-2.0
"""Schedule of the sparsification, one step at a time beside the other work on keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rlml_slam.slam.back_end.path_covariance import PathCovariance
from rlml_slam.slam.back_end.sparsification import Sparsifier
from rlml_slam.slam.back_end.trajectory import FrameTrajectory
from rlml_slam.slam.keyframes import Keyframe

Keyframes = list[Keyframe]


class GraphMaintenance:
    """Bounds the sightings after a solve, then the keyframes, then the edges.

    A step takes as long as a solve or the search of a closure: each waits for a keyframe without
    either, at most until the next solve.
    """

    def __init__(
        self, sparsifier: Sparsifier, trajectory: FrameTrajectory, covariance: PathCovariance
    ) -> None:
        self._sparsifier = sparsifier
        self._trajectory = trajectory
        self._covariance = covariance
        self._steps: deque[Callable[[Keyframes], None]] = deque()

    def after_solve(self, keys: Keyframes) -> None:
        """Bound the sightings, finish the last round and begin the next one."""
        self._sparsifier.thin()
        while self._steps:
            self._steps.popleft()(keys)
        self._steps.extend((self._sparsify, self._prune))

    def run_step(self, keys: Keyframes) -> None:
        """The next step, if there is one."""
        if self._steps:
            self._steps.popleft()(keys)

    def _sparsify(self, keys: Keyframes) -> None:
        if self._sparsifier.sparsify(keys, self._trajectory):
            self._covariance.keep(keys)

    def _prune(self, keys: Keyframes) -> None:
        self._sparsifier.prune(len(keys))
