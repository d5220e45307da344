# SPDX-License-Identifier: Apache-2.0
"""End points behind walls of a submap are found; what only comes near a wall is not."""

import numpy as np
import pytest
from made_scans import end_points

from rlml_slam import se2
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.matching.scans.visibility import ASIDE, BEHIND, hidden_share

WIDTH = 2.4  # [m] of the corridor
CORRIDOR = ((-15.0, 0.0, 15.0, 0.0), (-15.0, WIDTH, 15.0, WIDTH), (15.0, 0.0, 15.0, WIDTH))
VIEW = np.radians(np.arange(-90.0, 90.5, 1.0))
ORIGIN = np.array([0.2, 0.0])  # of the laser in base


def scan(pose, walls=CORRIDOR):
    """End points (n, 2) in base."""
    return end_points(pose, walls, VIEW, 30.0, ORIGIN)


def mapped(walls=CORRIDOR):
    submap = Submap()
    for x in np.arange(-6.0, 6.0, 0.4):
        pose = np.array([x, 1.2, 0.0])
        at = se2.transform(pose, np.vstack([scan(pose, walls), ORIGIN]))
        submap.insert(at[:-1], at[-1])
    return submap


@pytest.mark.parametrize('x', [-4.0, 0.0, 4.0])
@pytest.mark.parametrize('aside', [-0.8, 0.0, 0.8])
def test_scan_of_the_corridor_sees_all_of_it(x, aside):
    pose = np.array([x, 0.5 * WIDTH + aside, 0.1])
    assert hidden_share(mapped(), scan(pose), ORIGIN, pose) == 0.0


@pytest.mark.parametrize(('y', 'share'), [(0.6 * WIDTH, 0.0), (-0.6 * WIDTH, 1.0)])
@pytest.mark.parametrize('heading', [0.0, 2.0])
def test_from_beside_the_corridor_its_near_wall_hides_the_far_one(y, share, heading):
    pose = np.array([0.0, y, heading])
    far = np.stack([np.linspace(-4.0, 4.0, 40), np.full(40, WIDTH)], -1)
    points = se2.transform(se2.inverse(pose), far)
    assert hidden_share(mapped(), points, ORIGIN, pose) == share


def test_small_map_error_hides_nothing():
    pose = np.array([0.0, 0.5 * WIDTH, 0.0])
    for error in ((0.0, 0.15, 0.0), (0.2, -0.15, 0.0), (0.0, 0.0, 0.02)):
        assert hidden_share(mapped(), scan(pose), ORIGIN, pose + error) < 0.02


@pytest.mark.parametrize(('half', 'hides'), [(0.3 * ASIDE, False), (3.0 * ASIDE, True)])
def test_what_is_as_thin_as_a_leg_hides_nothing(half, hides):
    box = (2.0, 1.2 - half, 2.0, 1.2 + half)
    submap = mapped((*CORRIDOR, box))
    pose = np.array([0.0, 0.5 * WIDTH, 0.0])
    assert (hidden_share(submap, scan(pose), ORIGIN, pose) > 0.01) == hides


def test_wall_just_before_the_end_point_hides_nothing():
    pose = np.array([0.0, 0.5 * WIDTH, 0.0])
    submap = mapped()
    for beyond, hides in ((0.5 * BEHIND, False), (2.0 * BEHIND, True)):
        ends = np.array([[x, 0.5 * WIDTH + beyond] for x in (0.1, 0.2, 0.3)])
        assert (hidden_share(submap, ends, ORIGIN, pose) == 1.0) == hides


def test_nothing_is_hidden_where_nothing_is_known_and_of_no_points():
    assert hidden_share(Submap(), scan(np.array([0.0, 1.2, 0.0])), ORIGIN, np.zeros(3)) == 0.0
    assert hidden_share(mapped(), np.zeros((0, 2)), ORIGIN, np.zeros(3)) == 0.0
