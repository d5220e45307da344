# SPDX-License-Identifier: Apache-2.0
"""Factors of the sightings of reflectors: added, moved to other keyframes, thinned."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from rlml_slam.graph import OnlineSolver, RelativePoses, Renumbering, prune_sightings
from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.sighting_reduction import Records, fused, moved


class SightingFactors:
    """Factors e^R of eq. 12; ``changed`` if any was added since the last solve."""

    def __init__(self, solver: OnlineSolver) -> None:
        self._solver = solver
        self._graph = solver.graph
        # keyframes with sightings, and the number of these
        self.num_added = np.zeros(2, dtype=np.int64)
        self.changed = False

    def add(self, landmark: Landmark) -> None:
        """Add factors for the sightings of a landmark of the graph that have none."""
        if landmark.index >= 0:
            rows = landmark.sightings.view
            new = np.flatnonzero(rows['factor'] < 0)
            if len(new):
                s = rows[new]
                nodes = np.stack([s['pose'], np.full(len(s), landmark.index)], -1)
                rows['factor'][new] = self._graph.add_sightings(nodes, s['z'], s['information'])
                self.changed = True

    def disable(self, sightings: Records) -> None:
        """Disable the factors of sightings (k,)."""
        factors = sightings['factor']
        self._graph.sightings.enabled[factors[factors >= 0]] = False
        sightings['factor'] = -1

    def move(
        self, landmarks: Iterable[Landmark], ties: Mapping[int, tuple[int, RelativePoses]]
    ) -> None:
        """Move sightings to other keyframes: pose to (other pose, tie from it).

        Sightings of one reflector from the same keyframe are fused.
        """
        poses = np.array(list(ties), dtype=np.int64)
        onto = np.array([other for other, _ in ties.values()], dtype=np.int64)
        T = np.array([tie.T for _, tie in ties.values()])
        cov = np.array([tie.cov for _, tie in ties.values()])
        of = np.full(len(self._graph.poses), -1)
        of[poses] = np.arange(len(poses))
        for landmark in landmarks:
            rows = landmark.sightings.view
            at = of[rows['pose']]
            is_moved = at >= 0
            if not is_moved.any():
                continue
            s, at = rows[is_moved], at[is_moved]
            self.disable(s)
            z, cov_z = moved(RelativePoses(T[at], cov[at]), s)
            s['pose'], s['z'], s['information'] = onto[at], z, np.linalg.inv(cov_z)
            is_fused = np.isin(rows['pose'], s['pose'])
            others = rows[is_fused]
            self.disable(others)
            landmark.sightings.keep(~is_moved & ~is_fused)
            landmark.sightings.append(fused(np.concatenate([others, s])))
            self.add(landmark)

    def thin(self, landmarks: Iterable[Landmark], pose: int) -> None:
        """Remove the least informative sightings of a keyframe that took over others.

        As many stay as a keyframe adds in the mean. With the most that any added, nearly all
        would take over more than they added, and tie ever more places to one another.
        """
        keys, sightings = self.num_added.tolist()
        removed = prune_sightings(self._solver, pose, -(-sightings // max(keys, 1)))
        if len(removed):
            for landmark in landmarks:
                rows = landmark.sightings.view
                left = ~np.isin(rows['factor'], removed)
                if not left.all():
                    landmark.sightings.keep(left)

    @staticmethod
    def renumber(landmarks: Iterable[Landmark], new: Renumbering) -> None:
        """Follow the removal of poses, landmarks and factors from the graph."""
        for landmark in landmarks:
            if landmark.index >= 0:
                landmark.index = int(new.landmarks[landmark.index])
            rows = landmark.sightings.view
            rows['pose'] = new.poses[rows['pose']]
            linked = rows['factor'] >= 0
            rows['factor'][linked] = new.sightings[rows['factor'][linked]]
