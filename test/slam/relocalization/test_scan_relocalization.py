# SPDX-License-Identifier: Apache-2.0
"""A scan is found in a whole map, or it is said that it cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from made_worlds import CORRIDOR, OTHER_ROOM, ROOM, TinyWorld, drive, points_of, polygon, scan_at

from rlml_slam import se2
from rlml_slam.maps.nav2_map import load, save
from rlml_slam.maps.occupancy import OccupancyGrid, render
from rlml_slam.params import Parameters
from rlml_slam.slam.relocalization.scan_relocalization import relocalize
from rlml_slam.slam.search_area import SearchArea
from rlml_slam.types import Verdict

P = Parameters()
# turned by half a turn, it is the same
SQUARE_HALL = TinyWorld(
    polygon((-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, 3.0)), np.zeros((0, 2))
)
PATH = drive((0.6, 0.0, 4.0), (0.0, 0.8, 4.0), (0.4, 0.3, 4.0))[::4]


def scanned(world, pose, rng=None):
    return points_of(scan_at(world, pose, 1, rng))


def mapped(world, path=PATH, T_map_world=(0.0, 0.0, 0.0)):
    """The grid of a world, which is at a place of the map."""
    T = np.array(T_map_world)
    scans = [scanned(world, pose) for pose in path]
    return render(se2.compose(T, path), scans, [np.zeros(2)] * len(scans))


def places(n, seed):
    """Poses in the free part of the room."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-1.0, -1.5, -np.pi), (2.2, 1.5, np.pi), (n, 3))


@pytest.mark.parametrize('T_map_world', [(0.0, 0.0, 0.0), (40.0, -25.0, 2.0)])
def test_scan_is_found_wherever_it_was_taken(T_map_world):
    grid = mapped(ROOM, T_map_world=T_map_world)
    rng = np.random.default_rng(1)
    for pose in places(8, seed=2):
        found = relocalize(grid, scanned(ROOM, pose, rng), P)
        assert found.verdict is Verdict.UNIQUE, found.why
        error = se2.between(se2.compose(np.array(T_map_world), pose), found.pose)
        # a cell of the grid, and what a cell at 3 m turns
        assert np.hypot(*error[:2]) < 0.05
        assert abs(error[2]) < 0.02
        # the stated sigmas are no smaller than the errors by the factor that chi^2 allows
        assert error @ np.linalg.solve(found.cov, error) < 16.3  # 99.9 % of three degrees


def test_loaded_map_serves_as_well(tmp_path):
    save(mapped(ROOM), tmp_path / 'map')
    grid = load(tmp_path / 'map.yaml')
    for pose in places(4, seed=3):
        found = relocalize(grid, scanned(ROOM, pose), P)
        assert found.verdict is Verdict.UNIQUE
        assert np.hypot(*se2.between(pose, found.pose)[:2]) < 0.05


def test_hall_that_looks_the_same_turned_is_ambiguous():
    grid = mapped(SQUARE_HALL)
    rng = np.random.default_rng(4)
    for pose in places(6, seed=5):
        found = relocalize(grid, scanned(SQUARE_HALL, pose, rng), P)
        assert found.verdict is Verdict.AMBIGUOUS
        assert 'fit equally well' in found.why
        # either of the two is what is shown
        twins = np.stack([pose, se2.compose(np.array([0.0, 0.0, np.pi]), pose)])
        assert np.hypot(*se2.between(twins, found.pose)[:, :2].T).min() < 0.05


def test_of_two_places_that_look_the_same_one_is_in_the_area():
    T_map_world = np.array([12.0, -7.0, 0.4])
    grid, rng = mapped(SQUARE_HALL, T_map_world=T_map_world), np.random.default_rng(4)
    for pose in places(6, seed=5):
        near = se2.compose(T_map_world, pose)
        scan, off = scanned(SQUARE_HALL, pose, rng), rng.uniform(-0.5, 0.5, 3)
        found = relocalize(grid, scan, P, area=SearchArea(near + off, 1.5, 1.0))
        assert found.verdict is Verdict.UNIQUE, found.why
        assert np.hypot(*se2.between(near, found.pose)[:2]) < 0.05
        far = SearchArea(near + np.array([0.0, 0.0, 1.6]), 1.5, 1.0)
        assert relocalize(grid, scan, P, area=far).verdict is not Verdict.UNIQUE


def test_corridor_does_not_tell_the_place():
    path = drive((1.0, 0.0, 20.0))[::10]
    found = relocalize(mapped(CORRIDOR, path), scanned(CORRIDOR, np.array([7.0, 0.0, 0.0])), P)
    assert found.verdict is Verdict.AMBIGUOUS


def test_scan_of_another_room_is_in_no_place():
    found = relocalize(mapped(ROOM), scanned(OTHER_ROOM, np.zeros(3)), P)
    assert found.verdict is Verdict.IMPOSSIBLE
    assert 'no pose fits' in found.why
    assert found.pose is None


@pytest.mark.parametrize('points', [None, np.zeros((0, 2)), np.ones((5, 2))])
def test_frame_without_a_usable_scan_cannot_be_placed(points):
    found = relocalize(mapped(ROOM), points, P)
    assert found.verdict is Verdict.IMPOSSIBLE
    assert 'no usable scan' in found.why


@pytest.mark.parametrize(
    'grid', [None, OccupancyGrid(0.05, (0.0, 0.0), np.full((40, 40), -1, np.int8))]
)
def test_nothing_can_be_placed_in_no_map(grid):
    found = relocalize(grid, scanned(ROOM, np.zeros(3)), P)
    assert found.verdict is Verdict.IMPOSSIBLE
    assert 'no map' in found.why
