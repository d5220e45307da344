# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rlml_slam.estimation.common_error import CommonError
from rlml_slam.estimation.correction import Correction, ReferencePose

FAR = np.diag([30.0, 30.0, 1.8]) ** 2
COV = 1e-4 * np.eye(3)
POSE, LATER = np.array([3.0, 1.0, 0.5]), np.array([7.0, -2.0, 1.5])


def test_covariance_has_it_with_the_lever_of_its_heading_until_it_is_cleared():
    common = CommonError()
    assert_array_equal(common.belief(POSE, COV)[1], COV)
    common.add(POSE, FAR)
    assert_allclose(common.belief(POSE, COV)[1], COV + FAR)
    P = common.belief(LATER, COV)[1]
    assert P[1, 1] == pytest.approx(30.0**2 + 4.0**2 * 1.8**2 + 1e-4)
    assert P[0, 0] == pytest.approx(30.0**2 + 3.0**2 * 1.8**2 + 1e-4)
    common.clear()
    assert_array_equal(common.belief(LATER, COV)[1], COV)


def test_between_two_poses_after_it_it_is_no_uncertainty():
    common = CommonError()
    common.add(POSE, FAR)
    then = ReferencePose(*common.belief(POSE, COV), 1e-3 * np.eye(3))
    _, in_map = Correction(np.zeros(3), then).apply(*common.belief(LATER, COV))
    alone = Correction(np.zeros(3), ReferencePose(POSE, COV, 1e-3 * np.eye(3))).apply(LATER, COV)
    assert_allclose(in_map, alone[1], atol=1e-6)


def test_second_one_adds_to_the_first():
    common = CommonError()
    common.add(POSE, COV)
    common.add(LATER, 2.0 * COV)
    there = LATER + np.array([1.0, 1.0, 0.0])
    one, other = CommonError(), CommonError()
    one.add(POSE, COV)
    other.add(LATER, 2.0 * COV)
    nothing = np.zeros((3, 3))
    total = one.belief(there, nothing)[1] + other.belief(there, nothing)[1]
    assert_allclose(common.belief(there, nothing)[1], total)
