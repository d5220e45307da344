# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_lab.deformable.ekf import predict, run_ekf, update
from rlml_lab.deformable.experiment import SENSORS, Draws, Row, draw, edges, nominal
from rlml_lab.deformable.simulated_runs import simulate
from rlml_slam.deformable.active import HORIZON, choose_control, offsets, rollout
from rlml_slam.deformable.model import Noise, observe_feature

NOISE = Noise()
PAIRS = edges(3)


def belief(path='straight', step=3):
    _, m = simulate(Row(path, 'fixed', 'predetermined'), draw(range(1)))
    ekf = run_ekf(m, NOISE)
    return ekf.mean[0, step].copy(), ekf.cov[0, step].copy()


def test_candidates_are_none_and_four_rings_of_eight():
    ring = np.linalg.norm(offsets(), axis=-1)
    assert offsets().shape == (33, 2)
    assert ring[0] == 0.0
    values, counts = np.unique(np.round(ring[1:], 12), return_counts=True)
    np.testing.assert_allclose(values, [0.25, 0.5, 0.75, 1.0])
    assert counts.tolist() == [8, 8, 8, 8]


def test_rollout_with_every_feature_surely_in_range_is_the_ekf():
    """Where visibility is certain, the cost is the trace that the EKF will have."""
    state, P = belief()
    state[3:] = np.tile(state[:2], 3) + np.array([0.6, 0.2, 0.9, -0.3, 0.5, 0.5])
    near = SENSORS['fixed']._replace(near=0.0, far=1e6)
    plan = nominal('straight')
    expected, mean, cov = 0.0, state.copy(), P.copy()
    for k in range(HORIZON):
        predict(mean, cov, plan.control[k], np.tile(plan.translation[k], (3, 1)), NOISE)
        z = np.empty((3, 2))
        for j in range(3):
            observe_feature(mean, j, z[j], np.empty((2, 5)))
        edge = np.array(
            [mean[3 + 2 * b : 5 + 2 * b] - mean[3 + 2 * a : 5 + 2 * a] for a, b in PAIRS]
        )
        update(mean, cov, z, np.full(3, 0.05), edge, PAIRS, NOISE)
        expected += np.trace(cov)
    cost = rollout(
        state, P, plan.control[:HORIZON], plan.translation[:HORIZON], PAIRS, NOISE, near, np.inf
    )
    # the cube-root law leaves some 1e-4 below distance 0
    assert cost == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize('path', ['straight', 'circle'])
def test_choice_is_the_cheapest_of_all_candidates(path):
    state, P = belief(path, 6)
    plan = nominal(path)
    planned, ahead = plan.control[:HORIZON], plan.translation[6 : 6 + HORIZON]
    costs, controls = [], []
    for offset in offsets():
        control = planned.copy()
        control[0, :2] += offset
        sensor = SENSORS['changing']
        costs.append(rollout(state.copy(), P.copy(), control, ahead, PAIRS, NOISE, sensor, np.inf))
        controls.append(control[0])
    before, best = (state.copy(), P.copy()), np.empty(3)
    args = (planned, ahead, offsets(), PAIRS, NOISE, SENSORS['changing'], best)
    lowest = choose_control(state, P, *args)
    assert lowest == min(costs)
    np.testing.assert_array_equal(best, controls[int(np.argmin(costs))])
    assert best[2] == planned[0, 2]  # the turn stays as predetermined
    np.testing.assert_array_equal(state, before[0])
    np.testing.assert_array_equal(P, before[1])


def test_robot_turns_towards_features_that_it_is_about_to_lose():
    state, P = belief()
    state[3:] = np.tile(state[:2], 3) + np.array(
        [0.0, 2.2, 0.3, 2.4, -0.3, 2.1]
    )  # all to the left
    plan, best = nominal('straight'), np.empty(3)
    choose_control(
        state, P, plan.control[:HORIZON], plan.translation[:HORIZON], offsets(), PAIRS, NOISE,
        SENSORS['fixed'], best,
    )  # fmt: skip
    assert best[1] > 0.2


def test_controller_cannot_see_the_future_noise():
    """Two worlds that are the same up to step 10 are driven the same up to step 10."""
    a = draw(range(1))
    b = Draws(*(x.copy() for x in vars(a).values()))
    b.odometry[:, 10:] *= -1.0
    b.drift[:, 10:] *= -1.0
    b.feature[:, 11:] *= -1.0
    b.edge[:, 11:] *= -1.0
    row = Row('circle', 'fixed', 'active')
    (_, m_a), (_, m_b) = simulate(row, a), simulate(row, b)
    np.testing.assert_array_equal(m_a.control[:, :11], m_b.control[:, :11])
    assert not np.array_equal(m_a.control, m_b.control)
