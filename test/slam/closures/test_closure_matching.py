# SPDX-License-Identifier: Apache-2.0
"""A scan that fits a submap only through its walls, or by their other sides, closes no loop."""

import numpy as np
import pytest
from made_scans import end_points

from rlml_slam import se2
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.slam.closures.closure_candidates import Candidate
from rlml_slam.slam.closures.closure_matching import HIDDEN, OTHER_SIDE, ClosureMatcher, Match
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap
from rlml_slam.slam.keyframes import Keyframe

NEAR = ((-15.0, 0.0, 15.0, 0.0),)  # the wall in between
FAR = ((-15.0, 2.4, 15.0, 2.4), (6.0, 0.0, 6.0, 2.4), (-3.0, 2.0, -3.0, 2.4), (1.0, 2.2, 1.0, 2.4))
WIDTH = 2.4  # [m] of two corridors that cross
CROSSING = (
    *((a, y, b, y) for y in (0.0, WIDTH) for a, b in ((-15.0, 0.0), (WIDTH, 15.0))),
    *((x, a, x, b) for x in (0.0, WIDTH) for a, b in ((-8.0, 0.0), (WIDTH, WIDTH + 8.0))),
)  # fmt: skip
VIEW = np.radians(np.arange(-90.0, 90.5, 1.0))


def scan(pose, walls):
    """End points (n, 2) in base, where the laser is."""
    return end_points(pose, walls, VIEW, 20.0)


def keyframe(index):
    none = np.zeros(3), np.zeros((3, 3)), None, np.zeros(2)
    return Keyframe(index, index + 1, *none, scan_stamp=0)


@pytest.mark.parametrize(('y', 'fits'), [(1.0, True), (-1.0, False)])
def test_scan_that_fits_through_a_wall_is_refused(y, fits):
    submap = Submap()
    for x in np.arange(-4.0, 4.0, 0.4):
        pose = np.array([x, 1.2, 0.0])
        submap.insert(se2.transform(pose, scan(pose, NEAR + FAR)), pose[:2])
    m = KeyframeSubmap(keyframe(0), submap, 20, T_anchor_grid=np.zeros(3))
    pose = np.array([-1.0, y, 0.6])
    found = ClosureMatcher(Parameters()).match(
        Candidate(m, pose, 0.5, 0.1), keyframe(30), scan(pose, FAR)
    )
    if fits:
        assert isinstance(found.result, Match)
        assert np.abs(found.result.T_grid_key - pose).max() < 0.05
    else:
        assert found.result.why == HIDDEN
        assert found.result.score < Parameters().loop_closure.min_score


@pytest.mark.parametrize(('there', 'closes'), [(np.pi, True), (0.0, False)])
def test_walls_across_of_the_way_back_are_not_those_of_the_way_there(there, closes):
    """They are a corridor's width apart, and no other wall says how far the robot is."""
    submap = Submap()
    for x in np.arange(-6.0, 6.0, 0.4):
        pose = np.array([x, 0.5 * WIDTH, there])
        submap.insert(se2.transform(pose, scan(pose, CROSSING)), pose[:2])
    m = KeyframeSubmap(keyframe(0), submap, 20, T_anchor_grid=np.zeros(3))
    pose = np.array([5.0, 0.5 * WIDTH, np.pi])
    guess = pose if closes else pose + np.array([WIDTH, 0.0, 0.0])
    found = ClosureMatcher(Parameters()).match(
        Candidate(m, guess, 0.3, 0.1), keyframe(30), scan(pose, CROSSING)
    )
    if closes:
        assert np.abs(se2.between(pose, found.result.T_grid_key)).max() < 0.05
    else:
        assert found.result.why == OTHER_SIDE
