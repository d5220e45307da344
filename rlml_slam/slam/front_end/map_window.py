# SPDX-License-Identifier: Apache-2.0
"""The part of a given reflector map that is in reach: a plant has more than one scan can see.

The cost of an update grows with the square of the reflectors in the state. Those far away are left
out of it, and come back as the map has them.
"""

from __future__ import annotations

import numpy as np

from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.types import Reflectors

MARGIN = 10.0  # [m] beyond reach, so that the part changes seldom


class MapWindow:
    """Keeps the reflectors within ``reach`` [m] in a state; keys are rows of the map."""

    def __init__(self, reflectors: Reflectors, reach: float) -> None:
        self._map = reflectors
        self._reach = reach
        self._middle = np.full(2, np.inf)

    def follow(self, state: JointState, tracks: LandmarkTracks) -> None:
        """Exchange reflectors where the pose left the middle of the part that is in the state."""
        at = state.pose[:2]
        sigma = float(np.sqrt(np.trace(state.pose_cov[:2, :2])))
        if np.hypot(*(at - self._middle)) + 3.0 * sigma <= MARGIN:
            return
        self._middle = at
        near = np.hypot(*(self._map.points - at).T) < self._reach + MARGIN + 3.0 * sigma
        keep = near[tracks.keys]
        if not keep.all():
            state.remove_landmarks(keep)
            tracks.keep(keep)
        rows = np.setdiff1d(np.flatnonzero(near), tracks.keys)
        state.fix_landmarks(self._map.points[rows], self._map.cov[rows])
        tracks.survey(rows, self._map.ids[rows], self._map.diameters[rows])
