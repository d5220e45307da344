# SPDX-License-Identifier: Apache-2.0
"""Sliding window over the reflectors of a saved map: only those in range are in the state.

The cost of an update grows with the square of the number of reflectors in the state. A reflector
that leaves the window returns with the position and covariance of the map.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.types import Reflectors

MARGIN = 10.0  # [m] beyond the range of detections, so that the window changes rarely


class MapWindow:
    """Keeps the reflectors within ``max_range`` [m] in a state; keys are rows of the map."""

    def __init__(self, reflectors: Reflectors, max_range: float) -> None:
        self._map = reflectors
        self._max_range = max_range
        self._centre = np.full(2, np.inf)

    def update(self, state: JointState, tracks: LandmarkTracks) -> None:
        """Exchange reflectors if the pose is far from the centre of the window."""
        at = state.pose[:2]
        sigma = float(np.sqrt(np.trace(state.pose_cov[:2, :2])))
        if np.hypot(*(at - self._centre)) + 3.0 * sigma <= MARGIN:
            return
        self._centre = at
        near = np.hypot(*(self._map.points - at).T) < self._max_range + MARGIN + 3.0 * sigma
        keep = near[tracks.keys]
        if not keep.all():
            state.remove_landmarks(keep)
            tracks.keep(keep)
        rows = np.setdiff1d(np.flatnonzero(near), tracks.keys)
        state.fix_landmarks(self._map.points[rows], self._map.cov[rows])
        tracks.survey(rows, self._map.ids[rows], self._map.diameters[rows])
