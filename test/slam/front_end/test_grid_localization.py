# SPDX-License-Identifier: Apache-2.0
"""What a match with the grid of a saved map says, and until when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, STEP, observations

from rlml_slam.maps.occupancy import render
from rlml_slam.params import Node, Parameters
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.map_localization import MapLocalization
from rlml_slam.types import Reflectors

ALONG = np.linspace((-1.0, 0.0, 0.0), (1.5, 0.0, 0.0), 11)
STANDS = np.tile(ALONG[-1], (80, 1))


@pytest.fixture(scope='module')
def grid():
    seen = observations(ROOM, ALONG)
    return render(ALONG, [o.points for o in seen], [o.origin for o in seen])


@pytest.fixture
def localized(grid):
    """After a drive, at its end: the localization, its state, and scans where it stands."""
    out = MapLocalization(Parameters(node=Node(mode='localization')))
    none = np.zeros(0, dtype=np.int64)
    out.use_map(
        Reflectors(none, np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none, np.zeros(0)), grid
    )
    rng = np.random.default_rng(1)
    for pose, observation in zip(ALONG, observations(ROOM, ALONG, rng=rng), strict=True):
        state = JointState(pose, 1e-4 * np.eye(3), 0.0)
        out.update(state, observation, Sweep())
        assert out.grid_match.used
    return out, state, observations(ROOM, STANDS, rng=rng)


def with_truck(observation):
    """All but what is far behind ends on something near."""
    points = observation.points.copy()
    front = points[:, 0] > -1.5
    points[front] *= 0.5 / np.linalg.norm(points[front], axis=1, keepdims=True)
    return replace(observation, points=points)


def test_one_bad_scan_is_no_verdict_on_a_robot_that_stands(localized):
    """As it does not drive on, no keyframe distance would end what that scan said."""
    out, state, scans = localized
    state.x[0] += 0.31  # so that the next scan is due; it is matched where the robot is
    bad = replace(with_truck(scans[0]), points=with_truck(scans[0]).points - (0.31, 0.0))
    out.update(state, bad, Sweep())
    assert out.grid_match.is_weak
    assert out.grid_match.used
    for k in range(1, 4):
        good = replace(scans[k], points=scans[k].points - (0.31, 0.0))
        out.update(state, good, Sweep())
        assert not out.grid_match.refutes


def test_scans_of_a_robot_that_stands_do_not_make_it_surer(localized):
    out, state, scans = localized
    before = state.pose_cov
    for observation in scans[:10]:
        out.update(state, with_truck(observation), Sweep())
        out.update(state, observation, Sweep())
    np.testing.assert_array_equal(state.pose_cov, before)


def test_match_lapses_where_no_scan_comes_any_more(localized):
    """It was taken for one of each later place, however far that is."""
    out, state, scans = localized
    last = scans[0].stamp
    out.update(state, scans[0], Sweep())
    for k, points in ((40, None), (45, scans[0].points[:3])):
        out.update(state, replace(scans[0], stamp=last + k * STEP, points=points), Sweep())
        assert out.grid_match.used  # a slow laser misses some
    out.update(state, replace(scans[0], stamp=last + 60 * STEP, points=None), Sweep())
    assert not out.grid_match.used
    assert np.isnan(out.grid_match.score)
