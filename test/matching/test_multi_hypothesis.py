# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from differences import central_differences

from rlml_slam import se2
from rlml_slam.matching.reflectors.hypothesis_filter import to_invariant
from rlml_slam.matching.reflectors.multi_hypothesis import MultiHypothesis, Sight

POSE = np.array([1.0, -2.0, 0.6])
POINTS = np.array([[4.0, 1.0], [4.0, 4.0], [-3.0, 2.0]])
KEYS = np.array([10, 11, 12])
R = 0.05**2 * np.eye(2)


def begin(pose=POSE, points=POINTS, pose_sigma=(0.01, 0.01, 0.01), sigma=0.02, density=0.02):
    m = len(points)
    cov = np.diag(np.concatenate([pose_sigma, np.full(2 * m, sigma)]) ** 2)
    return MultiHypothesis(np.array(pose), KEYS[:m], np.asarray(points), cov, density)


def sight(key, pose, point, noise=(0.0, 0.0)):
    return Sight(key, se2.transform(se2.inverse(pose), np.asarray(point)[None])[0] + noise, R)


def state(h, i=0):
    n = int(h._sizes[i])
    return h._x[i, :n].copy(), h._P[i, :n, :n].copy()


def plain_cov(h, i=0):
    x, P = state(h, i)
    M = np.linalg.inv(to_invariant(x[:3], x[3:].reshape(-1, 2)))
    return M @ P @ M.T


# --- by equation -------------------------------------------------------------------------------


def test_prediction_has_the_covariance_of_the_composed_pose():
    h = begin()
    delta, cov = np.array([0.8, 0.1, -0.4]), np.diag([0.02, 0.01, 0.03]) ** 2
    J_a, J_b = se2.compose_jacobians(POSE, delta)
    before = plain_cov(h)
    h.move(delta, cov)
    x, _ = state(h)
    np.testing.assert_allclose(x[:3], se2.compose(POSE, delta), atol=1e-12)
    expected = before.copy()
    expected[:3, :3] = J_a @ before[:3, :3] @ J_a.T + J_b @ cov @ J_b.T
    np.testing.assert_allclose(plain_cov(h), expected, rtol=1e-9, atol=1e-14)


def test_update_is_that_of_the_plain_filter_where_errors_are_small():
    h = begin(pose_sigma=(1e-4, 1e-4, 1e-4), sigma=1e-4)
    before = plain_cov(h)
    s = sight(11, POSE, POINTS[1], noise=(2e-5, -1e-5))
    h.see([Sight(s.key, s.z, 1e-8 * np.eye(2))])

    def z(x):
        return se2.transform(se2.inverse(x[:3]), x[5:7][None])[0]

    x0 = np.concatenate([POSE, POINTS.ravel()])
    H = central_differences(z, x0)
    S = H @ before @ H.T + 1e-8 * np.eye(2)
    K = before @ H.T @ np.linalg.inv(S)
    x, _ = state(h)
    np.testing.assert_allclose(x - x0, K @ (s.z - z(x0)), atol=1e-8)
    np.testing.assert_allclose(plain_cov(h), before - K @ S @ K.T, rtol=1e-3, atol=1e-13)


def test_new_reflector_stands_where_it_was_seen_with_the_covariance_of_pose_and_detection():
    h = begin(points=POINTS[:1])
    h.see([sight(20, POSE, [30.0, 30.0])])
    assert len(h) == 1
    x, _ = state(h)
    np.testing.assert_allclose(x[-2:], [30.0, 30.0], atol=1e-9)
    J = np.array([[1.0, 0.0, -(30.0 - POSE[1])], [0.0, 1.0, 30.0 - POSE[0]]])
    rot = se2.rotation(POSE[2])
    expected = J @ (0.01**2 * np.eye(3)) @ J.T + rot @ R @ rot.T
    np.testing.assert_allclose(plain_cov(h)[-2:, -2:], expected, rtol=1e-9)


def test_wide_heading_turns_map_and_robot_together():
    # a heading off by 0.6 rad: after two known reflectors the pose is right to the noise, which
    # a filter of plain differences misses by the curvature of the arc
    truth = np.array([0.0, 0.0, 0.6])
    h = begin(pose=(0.0, 0.0, 0.0), pose_sigma=(0.01, 0.01, 0.4), sigma=0.001)
    h.see([sight(10, truth, POINTS[0]), sight(12, truth, POINTS[2])])
    x, _ = state(h)
    assert abs(se2.wrap(x[2] - truth[2])) < 0.05
    np.testing.assert_allclose(x[:2], truth[:2], atol=0.1)


# --- answers -----------------------------------------------------------------------------------


def test_what_fits_one_reflector_alone_is_it():
    h = begin()
    for _ in range(3):
        h.see([sight(20, POSE, POINTS[1], noise=(0.02, 0.01))])
    assert h.answers(0.99) == {20: 11}
    assert not h.pending
    assert len(h) == 1


def test_what_fits_none_is_a_reflector_of_its_own():
    h = begin()
    h.see([sight(20, POSE, [8.0, -4.0])])
    assert h.answers(0.99) == {20: 20}


def test_answer_waits_for_the_sighting_that_tells():
    # two reflectors 3 m apart, and a robot that does not know where along them it is
    h = begin(pose_sigma=(0.3, 2.0, 0.05))
    truth = POSE + np.array([0.0, 1.5, 0.0])
    h.see([sight(20, truth, POINTS[1])])
    assert h.answers(0.999) == {}
    assert h.pending == {20}
    for _ in range(4):
        h.see([sight(20, truth, POINTS[1]), sight(21, truth, POINTS[2])])
    assert h.answers(0.999) == {20: 11, 21: 12}


def test_symmetric_place_is_never_decided():
    # exactly between two equal candidates: only a third reflector could decide
    h = begin(pose=(0.0, 0.0, 0.0), points=[[4.0, 1.5], [4.0, -1.5]], pose_sigma=(0.2, 2.0, 0.02))
    for _ in range(20):
        h.see([sight(20, np.zeros(3), [4.0, 0.0])])
        assert h.answers(0.99) == {}
    assert h.pending == {20}


def test_keys_in_view_together_are_two_reflectors():
    h = begin()
    h.see([sight(20, POSE, [8.0, -4.0]), sight(21, POSE, [8.0, -3.6])])
    assert h.answers(0.9) == {20: 20, 21: 21}


def test_outlier_moves_nothing():
    h = begin()
    before, P = state(h)
    h.see([sight(11, POSE, POINTS[1] + [20.0, 0.0])])
    np.testing.assert_array_equal(state(h)[0], before)
    np.testing.assert_array_equal(state(h)[1], P)


def test_many_reflectors_leave_room_for_few_hypotheses():
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    n = 3 + 2 * len(grid)
    h = MultiHypothesis(np.zeros(3), np.arange(len(grid)), grid, 0.5 * np.eye(n), 0.02)
    h.see([Sight(10**6, np.array([3.0, 4.0]), R)])
    assert 1 < len(h) <= 4


# --- by property -------------------------------------------------------------------------------


@pytest.mark.parametrize('seed', range(8))
def test_drive_with_blind_stretches_is_told_right(seed):
    """Six reflectors, half a minute blind between them: heading off by up to half a radian."""
    rng = np.random.default_rng(seed)
    points = np.array([[0.6, -4.4], [2.9, -4.3], [3.0, -2.4], [1.6, 2.7], [3.3, 3.9], [1.3, 4.5]])
    pose = np.array([2.0, -0.5, -1.5])
    h = MultiHypothesis(pose, np.arange(6), points, np.diag(np.full(15, 1e-4)), 0.02)
    key, truth_of, wrong, num_answers = 100, {}, 0, 0
    for _ in range(25):
        blind = np.diag([0.25, 0.15, 0.2]) ** 2
        delta = np.array([rng.uniform(-0.5, 1.0), 0.0, rng.uniform(-2.0, 2.0)])
        pose = se2.compose(pose, delta + np.sqrt(np.diag(blind)) * rng.standard_normal(3))
        h.move(delta, blind)
        local = se2.transform(se2.inverse(pose), points)
        view = np.flatnonzero(np.abs(np.arctan2(local[:, 1], local[:, 0])) < 0.8)
        seen = {key + j: int(v) for j, v in enumerate(view)}
        key += len(view)
        truth_of |= seen
        for _ in range(3):
            noise = 0.1 * rng.standard_normal((len(view), 2))
            h.see(
                [
                    Sight(k, local[v] + e, 0.1**2 * np.eye(2))
                    for (k, v), e in zip(seen.items(), noise, strict=True)
                ]
            )
            for k, other in h.answers(0.999).items():
                num_answers += 1
                wrong += truth_of[k] != truth_of.get(other, other)
    # an answer of a reflector of its own counts as wrong too: all six are known
    assert wrong == 0
    assert num_answers > 0.5 * len(truth_of)
