# SPDX-License-Identifier: Apache-2.0
"""The grid of a saved map as a submap."""

import tracemalloc

import numpy as np
import pytest

from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.scans.search_pyramid import BYTES
from rlml_slam.matching.scans.submap import P_MIN, probability_of
from rlml_slam.params import Parameters
from rlml_slam.slam.relocalization.grid_submap import possible, submap_of

ANGLES = np.linspace(-0.6, 0.6, 360)
AHEAD = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)


def grid_with_wall(resolution: float, wall: int) -> OccupancyGrid:
    """40 x 40 free cells around the origin, one column of them occupied."""
    cells = np.zeros((40, 40), dtype=np.int8)
    cells[:, wall] = 100
    return OccupancyGrid(resolution, (-20 * resolution, -20 * resolution), cells)


@pytest.mark.parametrize('resolution', [0.05, 0.001])
def test_end_points_behind_a_wall_do_not_fit_whatever_the_cells(resolution):
    submap = submap_of(grid_with_wall(resolution, 36), Parameters().submap).submap
    assert possible(submap, 60 * resolution * AHEAD, np.zeros(3), 0.3, 0.9) == 0.3


def test_cells_that_more_beams_hit_read_more_in_a_match_a_score_and_a_search():
    """Cells of one and two percent are floor that was hit once in a hundred times."""
    cells = np.arange(101, dtype=np.int8).reshape(1, -1)
    saved = submap_of(OccupancyGrid(0.05, (0.0, 0.0), cells), Parameters().submap)
    values = saved.submap.values[0]
    for read in (values, probability_of(values), BYTES[values]):
        assert (np.diff(read.astype(float)) >= 0.0).all()
    assert probability_of(values)[:3].max() == P_MIN


def test_end_points_beyond_the_map_may_fit():
    submap = submap_of(grid_with_wall(0.05, 0), Parameters().submap).submap
    assert possible(submap, 3.0 * AHEAD, np.zeros(3), 0.3, 0.9) > 0.6


def test_a_grid_of_tiny_cells_costs_bounded_memory():
    submap = submap_of(grid_with_wall(0.001, 36), Parameters().submap).submap
    tracemalloc.start()
    try:
        possible(submap, 100.0 * AHEAD, np.zeros(3), 0.3, 0.9)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 5e6  # bytes; 360 beams x 100 000 cells at once were a gigabyte
