# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.errors import MapError
from rlml_slam.maps.occupancy import OccupancyGrid, render

POSES = np.array([[0.05, 0.05, 0.0], [0.05, 0.05, np.pi / 2]])
WALL = np.stack([np.full(21, 2.0), np.linspace(-1.0, 1.0, 21)], -1)


def rendered() -> OccupancyGrid:
    return render(POSES, [WALL, WALL], [np.zeros(2), np.zeros(2)], 0.1)


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    j = int(np.floor((x - grid.origin[0]) / grid.resolution))
    i = int(np.floor((y - grid.origin[1]) / grid.resolution))
    return int(grid.cells[i, j])


def test_walls_are_occupied_rays_free_and_the_rest_unknown():
    grid = rendered()
    assert at(grid, 2.05, 0.05) == 100
    assert at(grid, 0.05, 2.05) == 100  # the same wall, seen from the turned pose
    assert at(grid, 1.0, 0.05) == 0
    assert at(grid, 2.15, 0.05) == -1
    assert at(grid, -0.1, -0.1) == -1
    assert set(np.unique(grid.cells)) <= set(range(-1, 101))


def test_cell_that_beams_only_cross_now_and_then_end_in_is_not_a_wall():
    ghosts = [np.array([[1.0, 0.0]])] + [np.array([[3.0, 0.0]])] * 19
    poses = np.tile([0.05, 0.05, 0.0], (20, 1))
    grid = render(poses, ghosts, [np.zeros(2)] * 20, 0.1)
    # 1 of 20 beams: 50 * 0.05 / 0.25
    assert at(grid, 1.05, 0.05) == 10
    assert at(grid, 3.05, 0.05) == 100


def test_map_without_scans_is_one_unknown_cell():
    grid = render(np.zeros((0, 3)), [], [], 0.1)
    np.testing.assert_array_equal(grid.cells, [[-1]])
    empty = render(np.zeros((1, 3)), [np.zeros((0, 2))], [np.zeros(2)], 0.1)
    np.testing.assert_array_equal(empty.cells, [[-1]])


def test_poses_that_are_spread_too_wide_are_refused():
    far = np.array([[0.0, 0.0, 0.0], [1e7, 1e7, 0.0]])
    with pytest.raises(MapError, match='too large'):
        render(far, [WALL, WALL], [np.zeros(2)] * 2, 0.1)
