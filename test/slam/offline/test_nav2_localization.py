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
from rlml_slam.slam.relocalization.grid_submap import along_lattice
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


def localized(meta):
    """True path (n, 3) and frames of a drive in a map; it has none of the reflectors seen."""
    path = drive((0.0, 0.1, 1.0), (0.5, 0.3, 5.0), start=(0.1, 0.1, 0.05))
    observed = observations(ROOM, path, rng=np.random.default_rng(1))
    slam = Slam(Parameters(node=Node(mode='localization')))
    slam.use_map(saved_map.load(meta))
    return path, slam.process(observed) + slam.finish()


@pytest.mark.parametrize('name', VARIANTS)
def test_robot_is_localized_in_each(tmp_path, name):
    path, frames = localized(write(tmp_path, name, tiny_walls()))
    distance, turn = errors(np.array([f.T_map_base for f in frames]), path)
    assert distance[12:].max() < 0.03
    assert turn[12:].max() < 0.01
    assert {f.health.level for f in frames[12:]} == {Level.OK}


@pytest.mark.parametrize(
    ('name', 'least', 'most'), [('plain.pgm', 0.75, 0.85), ('turned.png', 0.0, 0.01)]
)
def test_walls_that_lie_along_the_lattice_are_known(tmp_path, name, least, most):
    """About four of five walls of the room do; the rest is a box that stands across."""
    share = along_lattice(nav2_map.load(write(tmp_path, name, tiny_walls())).cells)
    assert ((share >= least) & (share <= most)).all()


def test_no_number_of_matches_makes_the_pose_surer_than_the_cells(tmp_path):
    """A wall along the lattice lies anywhere in its cells, and all beams of all scans see that."""
    share = 0.05**2 / 12.0
    for name, least, most in (('plain.pgm', 0.75, 1.5), ('turned.png', 0.0, 0.5)):
        _, frames = localized(write(tmp_path, name, tiny_walls()))
        covs = np.array([np.diag(f.cov_map)[:2] for f in frames[40:]]) / share
        assert covs.min() > least, name
        assert covs.mean() < most, name
