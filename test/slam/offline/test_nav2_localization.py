# SPDX-License-Identifier: Apache-2.0
"""Localization in maps of nav2 that other programs wrote, without reflectors in them."""

from __future__ import annotations

import numpy as np
import pytest
from made_nav2_maps import VARIANTS, wall_points, write
from made_worlds import ROOM, drive, errors, observations
from scipy.spatial import cKDTree

from rlml_slam import se2
from rlml_slam.maps import nav2_map, saved_map
from rlml_slam.params import Node, Parameters
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Level


def tiny_walls():
    """Points (n, 2) on the walls of the room."""
    return np.concatenate([np.linspace(a, b, 300) for a, b in ROOM.walls.reshape(-1, 2, 2)])


@pytest.mark.parametrize('name', VARIANTS)
def test_every_way_of_writing_it_is_the_same_map(tmp_path, name):
    """Drawn over each other within half a cell in x and in y."""
    points = wall_points(load_world('room'))
    grid = nav2_map.load(write(tmp_path, name, points))
    at = np.stack(np.nonzero(grid.cells == 100)[::-1], -1) + 0.5
    middles = se2.transform(grid.T_map_grid, at * grid.resolution)
    half_cell = np.hypot(0.5, 0.5) * grid.resolution
    assert cKDTree(middles).query(points)[0].max() <= half_cell + 1e-9
    assert cKDTree(points).query(middles)[0].max() <= half_cell + 1e-9
    assert (grid.cells == -1).any()


@pytest.mark.parametrize('name', VARIANTS)
def test_robot_is_localized_in_each(tmp_path, name):
    meta = write(tmp_path, name, tiny_walls())
    # reflectors are seen that the map does not have
    path = drive((0.0, 0.1, 1.0), (0.5, 0.3, 5.0), start=(0.1, 0.1, 0.05))
    observed = observations(ROOM, path, rng=np.random.default_rng(1))
    slam = Slam(Parameters(node=Node(mode='localization')))
    slam.use_map(saved_map.load(meta))
    frames = slam.process(observed) + slam.finish()
    distance, turn = errors(np.array([f.T_map_base for f in frames]), path)
    assert distance[12:].max() < 0.03
    assert turn[12:].max() < 0.01
    assert {f.health.level for f in frames[12:]} == {Level.OK}
