# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rlml_slam import params, se2
from rlml_slam.estimation.common_error import CommonError
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.submaps import GRID_TURN, Submaps

SIZE = 6
STEPS = 14


def drive(settles):
    """Target's cells after each of STEPS scans; ``settles``: when there is time to carve."""
    rng = np.random.default_rng(4)
    submaps = Submaps(params.Submap(insertions=SIZE))
    state = JointState(np.zeros(3), np.eye(3) * 1e-6, 0.1)
    seen = []
    for k in range(STEPS):
        state.x[:3] = [0.2 * k, 0.0, 0.02 * k]
        points = np.stack([np.linspace(-2.0, 2.0, 60), rng.uniform(1.5, 2.5, 60)], -1)
        assert submaps.insert(state, points, np.zeros(2))
        for _ in range(settles(k)):
            submaps.settle()
        target = submaps.target
        seen.append((target.insertions, target.corner, target.values.copy()))
    return seen


def test_cells_do_not_depend_on_when_they_are_carved():
    always, never = drive(lambda _k: 2), drive(lambda _k: 0)
    some = drive(lambda k: k % 3)
    for a, b, c in zip(always, never, some, strict=True):
        assert a[:2] == b[:2] == c[:2]
        np.testing.assert_array_equal(a[2], b[2])
        np.testing.assert_array_equal(a[2], c[2])
    # the second submap, begun at half of the first, was taken over when that was full
    assert [insertions for insertions, _, _ in always] == [
        1, 2, 3, 4, 5, 6, *range(4, 7), *range(4, 7), 4, 5,
    ]  # fmt: skip


def test_scan_lies_in_the_grid_where_the_robot_was():
    submaps = Submaps(params.Submap())
    state = JointState(np.array([1.0, 2.0, 0.3]), np.eye(3) * 1e-6, 0.1)
    points = np.stack([np.linspace(-2.0, 2.0, 60), np.full(60, 1.5)], -1)
    submaps.insert(state, points, np.array([0.1, 0.0]))
    alone = Submap(params.Submap())
    # of all robots, the submap's frame is that of the first pose, turned
    T = se2.inverse(np.array([0.0, 0.0, GRID_TURN]))
    alone.insert(se2.transform(T, points), se2.transform(T, np.array([[0.1, 0.0]]))[0])
    np.testing.assert_array_equal(submaps.target.values, alone.values)


@pytest.mark.parametrize('is_measured', [False, True])
def test_heading_drifts_with_the_way_unless_reflectors_measure_it(is_measured):
    p = params.Submap(heading_drift=0.01)
    submaps, common = Submaps(p), CommonError()
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.0)
    points = np.array([[2.0, 1.0], [2.0, -1.0]])
    for _ in range(21):
        submaps.insert(state, points, np.zeros(2), None if is_measured else common)
        state.x[0] += 0.5
    _, cov = common.belief(state.pose, np.zeros((3, 3)))
    assert cov[2, 2] == pytest.approx(0.0 if is_measured else 0.01**2 * 10.0)
    # of a walk of the heading, the way is beside its line by the cube of its length
    aside = 0.0 if is_measured else 0.01**2 * 10.5**3 / 3.0
    assert cov[1, 1] == pytest.approx(aside, rel=0.1)
