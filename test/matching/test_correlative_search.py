# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_rooms import ROOM, built, path, scan

from rlml_slam import se2
from rlml_slam.matching.scans import correlative_search
from rlml_slam.matching.scans.correlative_search import Prior
from rlml_slam.matching.scans.submap import P_MAX, P_MIN, STEP, Submap
from rlml_slam.matching.scans.voxel_filter import thin

TRUE = np.array([0.4, -0.3, 0.5])


@pytest.fixture(scope='module')
def room() -> Submap:
    return built(ROOM, path(), sigma=0.01)


@pytest.fixture(scope='module')
def points():
    return thin(scan(ROOM, TRUE, 360, sigma=0.01), 0.05, 150)


def none(pose):
    """A pose to search around, which nothing speaks for."""
    return Prior(pose, np.zeros((3, 3)), 3.0)


@pytest.mark.parametrize('stride', [1, 2])
def test_window_takes_the_best_of_its_lattice(room, points, stride):
    offset = np.array([2 * stride * room.resolution, -stride * room.resolution, 0.0])
    found = correlative_search.window(room, points, none(TRUE + offset), 0.2, 0.0, stride=stride)
    np.testing.assert_allclose(found.pose, TRUE, atol=1e-12)
    cells = np.floor(se2.transform(TRUE, points) / room.resolution).astype(int) - room.corner
    # an unknown cell counts as value 0, one level below P_MIN
    read = P_MIN + STEP * room.values[cells[:, 1], cells[:, 0]]
    assert found.score == pytest.approx(read.mean(), abs=1e-4)


def test_window_at_the_border_counts_what_is_inside(room):
    b = room.bounds
    edge = np.array([[b[2] - 0.01, b[3] - 0.01], [b[0] + 0.01, b[1] + 0.01], [b[2] + 9.0, 0.0]])
    found = correlative_search.window(room, edge, none(np.zeros(3)), 0.5, 0.2)
    assert P_MIN - 1e-4 <= found.score <= P_MAX


def test_prior_decides_where_the_scan_does_not():
    wall = np.array([[[-30.0, 1.0], [30.0, 1.0]]])
    submap = built(wall, np.stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)], -1))
    seen = scan(wall, np.array([0.5, 0.0, 0.0]), 360, max_range=3.0)
    W = np.diag([100.0, 100.0, 200.0])
    prior = np.array([0.57, 0.1, 0.0])
    found = correlative_search.window(submap, seen, Prior(prior, W, 3.0), 0.2, 0.1)
    assert found.pose[0] == prior[0]
    assert abs(found.pose[1]) <= 0.051


def test_loss_of_the_prior_saturates_per_component():
    W = np.diag([10.0, 20.0, 30.0])
    assert correlative_search.prior_loss(0.0, 0.0, 0.0, W, 3.0) == 0.0
    assert correlative_search.prior_loss(0.3, 0.0, 0.0, W, 3.0) == pytest.approx(0.5)
    assert correlative_search.prior_loss(1e6, 0.15, 0.1, W, 3.0) == pytest.approx(2.0)


@pytest.mark.parametrize('far', [np.nan, np.inf, 1e16, 4.7e17, -1e19, 1e30, -1e300])
@pytest.mark.parametrize('place', [0, 1])
def test_pose_that_no_cell_can_have_meets_nothing(room, points, far, place):
    """No integer holds it: what its cast to one gives had passed for a cell of the grid."""
    pose = np.zeros(3)
    pose[place] = far
    with np.errstate(invalid='ignore'):
        assert correlative_search.window(room, points, none(pose), 0.5, 0.1).score == P_MIN
