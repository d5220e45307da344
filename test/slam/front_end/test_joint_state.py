# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from differences import central_differences
from made_states import made

from rlml_slam import se2
from rlml_slam.matching.reflectors.innovations import expected
from rlml_slam.slam.front_end.joint_state import (
    ANCHORS,
    BIAS,
    DRIFT,
    LANDMARKS,
    PIVOT,
    SPEED,
    TURN,
    WHEELS,
    JointState,
    measure_bias,
)
from rlml_slam.types import Motion


def motion(**kw):
    cov = np.array([[4e-4, 1e-5, 2e-5], [1e-5, 2e-4, 1e-5], [2e-5, 1e-5, 3e-4]])
    gains = {
        'bias_gain': np.array([0.01, -0.02, -0.1]),
        'turn_gain': np.array([-0.02, 0.1, 0.15]),
        'drift_gain': np.array([0.01, 0.04, 0.3]),
    }
    return Motion(np.array([0.3, -0.02, 0.2]), cov, **gains, **kw)


def moved(m, x):
    """Motion corrected by the errors of wheels and gyro in the state ``x`` (n,)."""
    delta = m.delta + m.bias_gain * x[BIAS] + m.turn_gain * x[TURN]
    delta = delta + m.drift_gain * x[DRIFT]
    delta = delta * [1.0 + x[SPEED], 1.0 + x[SPEED], 1.0]
    about = [np.cos(delta[2]) - 1.0, np.sin(delta[2]), 0.0]
    return delta + x[PIVOT] * np.array(about)


@pytest.mark.parametrize('theta', [0.0, 0.4, 3.1, -3.1])
def test_prediction_is_that_of_a_dense_ekf(theta):
    state, way, turn = made(theta=theta), 0.3, 0.2
    state.x[[BIAS, TURN, DRIFT]] = 0.0
    # an arc of the midpoint model, and a robot that went as far before
    arc = np.array([way * np.cos(0.5 * turn), way * np.sin(0.5 * turn), turn])
    by_turn = turn * np.array([-0.5 * arc[1], 0.5 * arc[0], 1.0])
    by_way = way * np.array([-0.5 * arc[1], 0.5 * arc[0], 1.0])
    m = replace(motion(), delta=arc, turn_gain=by_turn, drift_gain=by_way)
    x, P = state.x.copy(), state.P.copy()

    def f(v):
        out = v.copy()
        out[:3] = se2.compose(v[:3], moved(m, v))
        out[WHEELS] *= 0.9
        return out

    F = central_differences(f, x, angles=(2,))
    # noise is that of the motion as measured, whatever the scale of the speed
    as_measured = np.where(np.arange(len(x)) == SPEED, 0.0, x)

    def moved_by(delta):
        return se2.compose(x[:3], moved(replace(m, delta=delta), as_measured))

    G = central_differences(moved_by, m.delta, angles=(2,))
    Q = np.zeros_like(P)
    Q[:3, :3] = G @ m.cov @ G.T
    Q[BIAS, BIAS] = 1e-6
    Q[WHEELS, WHEELS] = (1.0 - 0.9**2) * np.diag([0.03, 0.05, 0.03, 0.1]) ** 2
    state.predict(m, 1e-6, 0.9, np.array([way, turn]))
    np.testing.assert_allclose(state.x, f(x), atol=1e-12)
    np.testing.assert_allclose(state.P, F @ P @ F.T + Q, atol=1e-8)


def test_prediction_and_corrected_motion_are_as_the_state_says_that_wheels_and_gyro_err():
    state, m = made(11), motion()
    x = state.x.copy()
    np.testing.assert_allclose(state.corrected(m).delta, moved(m, x), atol=1e-12)
    np.testing.assert_array_equal(state.corrected(m).cov, m.cov)
    state.predict(m, 0.0)
    np.testing.assert_allclose(state.pose, se2.compose(x[:3], moved(m, x)), atol=1e-12)


def test_share_of_turn_changes_nothing_where_the_gyro_tells_the_turn():
    state = made(12)
    state.P[TURN] = state.P[:, TURN] = 0.0
    before = state.P[:3].copy()
    state.P[TURN, TURN] = 0.05**2
    state.predict(replace(motion(), turn_gain=np.zeros(3)), 0.0, 1.0, np.array([0.0, 0.2]))
    np.testing.assert_array_equal(state.P[TURN, :3], before[:, TURN])


def test_update_is_that_of_a_dense_ekf():
    state = made(1)
    x, P = state.x.copy(), state.P.copy()
    index = np.array([2, 0])
    R = np.diag([4e-4, 1e-4, 2e-4, 3e-4])
    v = np.array([0.01, -0.02, 0.005, 0.01])

    def h(y):
        points = y[LANDMARKS:].reshape(-1, 2)[index]
        return se2.transform(se2.inverse(y[:3]), points).ravel()

    H = central_differences(h, x)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    keep = np.eye(len(x)) - K @ H
    columns = np.flatnonzero(H.any(axis=0))
    state.apply(columns, H[:, columns], R, v)
    expected = x + K @ v
    expected[2] = se2.wrap(expected[2])
    np.testing.assert_allclose(state.x, expected, atol=1e-8)
    # Joseph's form, which holds for any gain
    np.testing.assert_allclose(state.P, keep @ P @ keep.T + K @ R @ K.T, atol=1e-9)
    np.testing.assert_array_equal(state.P, state.P.T)
    assert np.linalg.eigvalsh(state.P).min() > 0.0


def test_bias_is_measured_as_a_scalar_and_an_outlier_is_not():
    state = made(2)
    x, P = state.x.copy(), state.P.copy()
    m = motion(bias=0.03, bias_var=1e-3)
    measure_bias(state.x, state.P, m.bias, m.bias_var, 0.0, 0.0)
    K = P[:, BIAS] / (P[BIAS, BIAS] + 1e-3)
    np.testing.assert_allclose(state.x, x + K * (0.03 - x[BIAS]), atol=1e-12)
    np.testing.assert_allclose(state.P, P - np.outer(K, P[BIAS]), atol=1e-12)
    x, P = state.x.copy(), state.P.copy()
    measure_bias(state.x, state.P, 5.0, 1e-3, 0.0, 0.0)
    np.testing.assert_array_equal(state.x, x)
    np.testing.assert_array_equal(state.P, P)


def test_bias_that_turning_wheels_tell_is_with_their_share_of_turn():
    state = made(13)
    x, P = state.x.copy(), state.P.copy()
    H = np.zeros((1, len(x)))
    H[0, BIAS], H[0, TURN], H[0, DRIFT] = 1.0, 0.7, 0.4
    S = H @ P @ H.T + 1e-3
    K = P @ H.T / S
    measure_bias(state.x, state.P, 0.03, 1e-3, 0.7, 0.4)
    np.testing.assert_allclose(state.x, x + K[:, 0] * (0.03 - H[0] @ x), atol=1e-12)
    np.testing.assert_allclose(state.P, P - S * K @ K.T, atol=1e-12)


def test_motion_that_tells_the_bias_changes_it():
    without_bias, with_bias = made(3), made(3)
    without_bias.predict(motion(), 0.0)
    with_bias.predict(motion(bias=0.02, bias_var=1e-5), 0.0)
    assert with_bias.P[BIAS, BIAS] < without_bias.P[BIAS, BIAS]
    assert abs(with_bias.x[BIAS] - 0.02) < abs(without_bias.x[BIAS] - 0.02)


def test_new_landmark_has_the_covariance_of_its_inverse_observation():
    state = made(4)
    x, P = state.x.copy(), state.P.copy()
    z, R = np.array([3.0, -1.0]), np.array([[4e-4, 1e-4], [1e-4, 2e-4]])

    def g(y):
        return se2.transform(y[:3], z[None])[0]

    G = central_differences(g, x)
    rot = se2.rotation(x[2])
    index = state.add_landmark(z, R)
    assert index == 3
    assert state.num_landmarks == 4
    n = len(x)
    np.testing.assert_allclose(state.landmarks()[3], g(x), atol=1e-12)
    np.testing.assert_allclose(state.P[n:, :n], G @ P, atol=1e-8)
    np.testing.assert_allclose(state.P[:n, n:], (G @ P).T, atol=1e-8)
    np.testing.assert_allclose(state.P[n:, n:], G @ P @ G.T + rot @ R @ rot.T, atol=1e-8)
    np.testing.assert_array_equal(state.P[:n, :n], P)


def test_surveyed_landmark_is_independent_of_all():
    state = made(5)
    n = len(state.x)
    cov = np.array([[[1e-4, 2e-5], [2e-5, 2e-4]], 3e-4 * np.eye(2)])
    before = state.P.copy()
    state.fix_landmarks(np.array([[1.0, 2.0], [3.0, 4.0]]), cov)
    np.testing.assert_array_equal(state.P[:n, :n], before)
    np.testing.assert_array_equal(state.P[n:, :n], 0.0)
    np.testing.assert_array_equal(state.P[n : n + 2, n + 2 :], 0.0)
    np.testing.assert_array_equal(state.landmark_covs()[3:], cov)
    np.testing.assert_array_equal(state.landmarks()[3:], [[1.0, 2.0], [3.0, 4.0]])


def test_clone_is_the_pose_with_all_its_correlations():
    state = made(6)
    cov = np.diag([1e-4, 2e-4, 3e-6])
    state.clone_pose(1, 0.5, cov)
    a = slice(ANCHORS[1], ANCHORS[1] + 3)
    np.testing.assert_allclose(state.anchor(1), se2.compose(state.pose, [0.0, 0.0, 0.5]))
    # to turn on the spot has the identity as its derivative
    np.testing.assert_array_equal(state.P[a, LANDMARKS:], state.P[:3, LANDMARKS:])
    np.testing.assert_array_equal(state.P[a, :3], state.P[:3, :3])
    np.testing.assert_allclose(state.P[a, a], state.P[:3, :3] + cov)
    np.testing.assert_array_equal(state.P, state.P.T)
    # the pose seen from its own clone is as uncertain as was added, and no more
    D = np.zeros((3, len(state.x)))
    D[:, :3], D[:, a] = np.eye(3), -np.eye(3)
    np.testing.assert_allclose(D @ state.P @ D.T, cov, atol=1e-15)


def test_moved_anchor_is_the_same_anchor():
    state = made(7)
    anchor = state.anchor(1)
    s, t = (slice(a, a + 3) for a in (ANCHORS[1], ANCHORS[0]))
    P = state.P.copy()
    state.move_anchor(1, 0)
    np.testing.assert_array_equal(state.anchor(0), anchor)
    np.testing.assert_array_equal(state.P[t, t], P[s, s])
    np.testing.assert_array_equal(state.P[t, LANDMARKS:], P[s, LANDMARKS:])
    np.testing.assert_array_equal(state.P, state.P.T)


def test_marginalisation_is_exact():
    a, b = made(8, landmarks=4), made(8, landmarks=4)
    keep = np.array([True, False, True, False])
    rows = np.r_[0:LANDMARKS, LANDMARKS + np.array([0, 1, 4, 5])]
    b.remove_landmarks(keep)
    np.testing.assert_array_equal(b.x, a.x[rows])
    np.testing.assert_array_equal(b.P, a.P[np.ix_(rows, rows)])
    # and what is measured of the others afterwards gives the same with it and without
    R, v = 1e-4 * np.eye(2), np.array([0.01, 0.02])
    for state, k in ((a, 2), (b, 1)):
        columns = np.r_[0:3, LANDMARKS + 2 * k, LANDMARKS + 2 * k + 1]
        H = np.empty((2, 5))
        expected(state.pose, *state.landmarks()[k], np.empty(2), H)
        state.apply(columns, H, R, v)
    np.testing.assert_allclose(b.x, a.x[rows], atol=1e-12)
    np.testing.assert_allclose(b.P, a.P[np.ix_(rows, rows)], atol=1e-12)


def test_replacing_keeps_means_and_the_place_of_the_anchors():
    state = made(9)
    before = state.x.copy()
    points = np.array([[1.0, 2.0], [3.0, 4.0]])
    rng = np.random.default_rng(9)
    A = 0.1 * rng.standard_normal((7, 7))
    cov, anchor_cov = A @ A.T + 1e-4 * np.eye(7), np.diag([1e-4, 1e-4, 1e-6])
    state.replace(points, cov, anchor_cov)
    np.testing.assert_array_equal(state.x[:LANDMARKS], before[:LANDMARKS])
    np.testing.assert_array_equal(state.landmarks(), points)
    np.testing.assert_allclose(state.pose_and_landmarks_cov(), cov)
    assert np.linalg.eigvalsh(state.P).min() > -1e-12
    # the relative place of pose and anchor is known but for what was added
    for a in ANCHORS:
        J_x, J_a = se2.between_jacobians(state.x[:3], state.x[a : a + 3])
        J = np.zeros((3, len(state.x)))
        J[:, :3], J[:, a : a + 3] = J_x, J_a
        np.testing.assert_allclose(J @ state.P @ J.T, J_a @ anchor_cov @ J_a.T, atol=1e-12)


def test_widening_touches_the_pose_alone():
    state = made(10)
    P = state.P.copy()
    state.widen(np.diag([0.1, 0.2, 0.3]))
    P[:3, :3] += np.diag([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(state.P, P)


def test_corrected_position_does_not_measure_an_uncertain_heading():
    """It drove backward while its odometry said forward, at a heading that is unknown."""
    state = JointState(np.zeros(3), np.diag([0.1, 0.1, 0.3]) ** 2, 0.0)
    state.clone_pose(0, 0.0, np.zeros((3, 3)))
    rows = np.r_[0:3, ANCHORS[0] : ANCHORS[0] + 3]
    for k, measured in enumerate((-0.1, -0.2, -0.3)):
        motion = Motion(np.array([0.1, 0.0, 0.0]), np.diag([0.3, 0.01, 0.01]) ** 2)
        state.predict(motion, 0.0)
        seen = se2.between(state.anchor(0), state.pose)
        J = np.hstack([np.eye(3), -np.eye(3)])
        c, s = np.cos(state.anchor(0)[2]), np.sin(state.anchor(0)[2])
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        H = R @ J
        H[:, 5] += [seen[1], -seen[0], 0.0]
        before = state.x.copy()
        error = np.array([measured, 0.0, 0.0]) - seen
        state.apply(rows, H, np.diag([0.005, 0.005, 0.003]) ** 2, error)
        state.turn_with_anchor(before)
        assert np.sqrt(state.P[2, 2]) > 0.99 * 0.3, k


def test_turn_with_anchor_is_a_change_of_coordinates():
    state = made(14)
    before, P = state.x.copy(), state.P.copy()
    state.x = before + np.random.default_rng(2).normal(0.0, 0.1, len(before))
    shift, a = state.x - before, ANCHORS[0]
    T = np.eye(len(before))
    for row in (0, ANCHORS[1], *range(LANDMARKS, len(before), 2)):
        dx, dy = shift[row : row + 2] - shift[a : a + 2]
        T[row, a + 2], T[row + 1, a + 2] = -dy, dx
    state.turn_with_anchor(before)
    np.testing.assert_allclose(state.P, T @ P @ T.T, atol=1e-12)
