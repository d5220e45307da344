# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from differences import central_differences
from made_states import made

from rlml_slam import se2
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.scan_update import TARGET, WITH_VELOCITY, Found, fuse, swept

HALF = np.array([0.04, 0.04, 0.04])
NOTHING = np.zeros(3)


@pytest.mark.parametrize('curved', [1.0, 25.0])
def test_match_held_back_by_its_prior_gives_the_estimate_of_both(curved):
    # scan and prior are quadratic here: eq. 3 and 11 have a closed form
    prior_cov = np.diag([0.04, 0.01, 0.002])
    state = JointState(np.array([0.3, -0.2, 0.1]), prior_cov, 0.02)
    W, alone = np.linalg.inv(prior_cov), np.diag([30.0, 900.0, 4000.0])
    optimum = np.array([0.36, -0.24, 0.12])  # of the scan
    # the matcher is surer of the scan than what this is worth in the update
    H = curved * alone
    found = np.linalg.solve(W + H, W @ state.pose + H @ optimum)
    pull = W @ (found - state.pose)
    expected = np.linalg.solve(W + alone, W @ state.pose + alone @ optimum)
    fuse(state.x, state.P, Found(found, alone, pull, H), 3.0, NOTHING, NOTHING)
    np.testing.assert_allclose(state.pose, expected, atol=1e-9)
    np.testing.assert_allclose(state.pose_cov, np.linalg.inv(W + alone), atol=1e-9)


@pytest.mark.parametrize('theta', [0.0, 0.4, 3.1])
def test_place_of_a_sweep_depends_on_the_velocity_it_was_deskewed_with(theta):
    state, used = made(theta=theta, spread=0.7), np.array([0.5, -0.1, 0.3])

    def place(x):
        pose = se2.between(x[TARGET : TARGET + 3], x[:3])
        off = HALF * (x[WITH_VELOCITY[6:]] - used)
        pose[:2] += se2.rotation(pose[2]) @ off[:2]
        pose[2] += off[2]
        return pose

    pose, J, cov = swept(state.x, state.P, HALF, used)
    np.testing.assert_allclose(se2.wrap(pose - place(state.x)), 0.0, atol=1e-9)
    # the velocity's error being small, how it turns with the pose is left out
    state.x[WITH_VELOCITY[6:]] = used
    pose, J, cov = swept(state.x, state.P, HALF, used)
    D = central_differences(place, state.x, angles=(2,))
    np.testing.assert_allclose(J, D[:, WITH_VELOCITY], atol=1e-6)
    np.testing.assert_allclose(cov, D @ state.P @ D.T, atol=1e-8)


def test_sweep_that_does_not_fit_its_velocity_corrects_it():
    state = JointState(np.zeros(3), np.diag([1e-8, 1e-8, 1e-8]), 0.02, (0.5, 0.1, 1.0))
    used = np.zeros(3)
    # driving 0.3 m/s, end points taken for those of a robot that stands
    found = np.array([0.3 * HALF[0], 0.0, 0.0])
    match = Found(found, np.diag([1e8, 1e8, 1e8]), NOTHING, np.eye(3))
    fuse(state.x, state.P, match, 3.0, HALF, used)
    assert state.velocity[0] == pytest.approx(0.3, rel=0.01)
    assert abs(state.pose[0]) < 1e-4
