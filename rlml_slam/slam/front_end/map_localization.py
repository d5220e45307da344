# SPDX-License-Identifier: Apache-2.0
"""Localization in a saved map: scan matches with its grid, and confirmation of the pose.

Between two confirmations, odometry and the front end's own submaps hold the pose, and they are
accurate for a while: the distance travelled without confirmation counts.
"""

from __future__ import annotations

import math
from dataclasses import replace

from rlml_slam.estimation.kidnapping_detection import FEW, LAPSE
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.grid_localization import GridLocalizer, GridMatch
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.relocalization.grid_submap import is_mapped
from rlml_slam.types import Detections, Observation, Reflectors


class MapLocalization:
    """The saved map, if there is one; ``grid_match`` is the newest match with its grid."""

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self.saved: SavedMap | None = None
        self.confirmation = MapConfirmation(params)
        self.grid_match = GridMatch(math.nan)
        self._grid: GridLocalizer | None = None
        self._seen = 0  # stamp of the newest scan

    def use_map(self, reflectors: Reflectors, grid: OccupancyGrid | None) -> None:
        """Localize in this map from now on; the pose needs confirmation."""
        self.saved = SavedMap(reflectors)
        self.use_grid(grid)
        self.confirmation.begin()

    def doubt(self, broken: bool) -> None:
        """Where the way is ``broken``, the next scan is matched, and the map has to confirm it."""
        if broken and self.saved is not None:
            self.use_map(self.saved.reflectors, self.saved.grid)
            self.confirmation.reason = 'scans fit none before: the map has to confirm the pose'

    def use_grid(self, grid: OccupancyGrid | None) -> None:
        """Replace the grid of the map, None for none."""
        assert self.saved is not None
        self.saved = replace(self.saved, grid=grid)
        self._grid, self.grid_match = None, GridMatch(math.nan)
        if grid is not None and is_mapped(grid):
            self._grid = GridLocalizer(grid, self._p)

    def num_comparable(self, detections: Detections | None) -> int | None:
        """Number of detections; None also for a saved map of walls alone, which has none."""
        if detections is None or (self.saved is not None and not len(self.saved.reflectors)):
            return None
        return len(detections)

    def update(self, state: JointState, observation: Observation, sweep: Sweep) -> None:
        """Match the scan with the grid and update the state, once per keyframe distance."""
        points, stamp = observation.points, observation.stamp
        if self._grid is None:
            return
        if points is None or len(points) < self._p.scan_match.min_points:
            if stamp - self._seen > LAPSE * 1e9:
                self.grid_match = GridMatch(math.nan)  # what it said is no longer about this place
            return
        self._seen = stamp
        if self._grid.is_due(state.pose):
            self.grid_match = self._grid.update(state, points, sweep)


class MapConfirmation:
    """Whether the saved map confirms the pose; ``reason`` is empty if it does.

    ``is_pending``: the start pose has not been confirmed yet. ``is_lost``: not for
    ``confirmation_time``, or scans have contradicted the map for that long.
    """

    def __init__(self, params: Parameters) -> None:
        self._limits = params.health
        self._min_score = params.loop_closure.min_score
        self._is_needed = self.is_pending = params.node.mode == 'localization'
        self.reason = 'no map has been loaded for localization' if self._is_needed else ''
        self.is_lost = False
        self._distance = 0.0  # [m] since the last confirmation
        self._since: int | None = None  # stamp of the newest frame with no evidence against it

    def begin(self) -> None:
        """A map was loaded, or the robot may be elsewhere in it."""
        self._is_needed = self.is_pending = True
        self.reason = 'start pose not confirmed: nothing has matched the saved map yet'

    def check(
        self,
        stamp: int,
        distance: float,
        detections: int,
        used: int,
        agrees: bool,
        grid_match: GridMatch,
    ) -> None:
        """Evaluate a frame that is ``distance`` [m] after the last one.

        ``used`` of its ``detections`` matched the map; ``agrees``: enough of them.
        """
        if not self._is_needed:
            return
        if self.is_pending:
            confirmed = self._confirms_start(detections, used, grid_match)
        else:  # two reflectors may match by chance, where the scan does not
            reflectors = agrees and (used > FEW or not grid_match.contradicts)
            confirmed = reflectors or grid_match.used
        if confirmed:
            self.reason, self.is_pending, self.is_lost = '', False, False
            self._distance, self._since = 0.0, None
            return
        if self._since is None or not (self.is_pending or grid_match.contradicts):
            self._since = stamp
        self._distance += distance
        if not self.is_pending and self._distance > self._limits.confirmation_distance:
            self.reason = f'no match with the saved map for {self._distance:.0f} m'
            if grid_match.contradicts:
                self.reason += ', and the scan contradicts it'
        lasts = stamp - self._since > self._limits.confirmation_time * 1e9
        self.is_lost = bool(self.reason) and lasts

    def _confirms_start(self, detections: int, used: int, grid_match: GridMatch) -> bool:
        """Whether a start pose is confirmed.

        By two matched reflectors that are most of the detections, unless the scan contradicts
        them; or by a scan that matches the grid and observes every direction.
        """
        reflectors = used >= 2 and 2 * used >= detections
        fits = grid_match.score >= self._min_score
        no_fit = grid_match.score < self._min_score  # false if there is no grid (NaN)
        return (reflectors and not no_fit) or (fits and grid_match.is_complete)
