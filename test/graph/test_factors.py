# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from differences import central_differences

from rlml_slam import se2
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.factors import FactorKind, Losses

# angles near 0, near pi and on either side of the cut, and random ones
ANGLES = [0.0, 1e-9, -1e-7, np.pi, np.pi - 1e-7, -np.pi + 1e-7, 1.3, -2.9]


def poses(rng: np.random.Generator, turn: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b, d = rng.uniform(-3, 3, (3, 3))
    b[2] = a[2] + d[2] + turn  # so that the residual's angle is ``turn``
    return a, b, d


@pytest.mark.parametrize('turn', ANGLES)
def test_relative_pose_jacobians_match_central_differences(turn):
    a, b, d = poses(np.random.default_rng(1), turn)
    _, J_a, J_b = factors.relative_pose(a, b, d)
    # 1e-8: rounding of the differences at step 1e-6 with values near 3
    D_a = central_differences(lambda x: factors.relative_pose(x, b, d)[0], a, angles=(2,))
    D_b = central_differences(lambda x: factors.relative_pose(a, x, d)[0], b, angles=(2,))
    np.testing.assert_allclose(J_a, D_a, atol=1e-8)
    np.testing.assert_allclose(J_b, D_b, atol=1e-8)


@pytest.mark.parametrize('theta', ANGLES)
def test_pose_landmark_jacobians_match_central_differences(theta):
    rng = np.random.default_rng(2)
    X, m, z = (
        np.array([*rng.uniform(-3, 3, 2), theta]),
        rng.uniform(-3, 3, 2),
        rng.uniform(-1, 1, 2),
    )
    _, J_X, J_m = factors.pose_landmark(X, m, z)
    D_X = central_differences(lambda x: factors.pose_landmark(x, m, z)[0], X)
    D_m = central_differences(lambda x: factors.pose_landmark(X, x, z)[0], m)
    np.testing.assert_allclose(J_X, D_X, atol=1e-8)
    np.testing.assert_allclose(J_m, D_m, atol=1e-8)


@pytest.mark.parametrize('turn', ANGLES)
def test_prior_jacobians_match_central_differences(turn):
    rng = np.random.default_rng(3)
    X, m, m_0 = rng.uniform(-3, 3, 3), rng.uniform(-3, 3, 2), rng.uniform(-3, 3, 2)
    X_0 = X - [0.3, -0.2, turn]
    D = central_differences(lambda x: factors.pose_prior(x, X_0)[0], X, angles=(2,))
    np.testing.assert_allclose(factors.pose_prior(X, X_0)[1], D, atol=1e-8)
    D = central_differences(lambda x: factors.landmark_prior(x, m_0)[0], m)
    np.testing.assert_allclose(factors.landmark_prior(m, m_0)[1], D, atol=1e-8)


def test_relative_pose_residual_is_the_chart_of_the_error_pose():
    a, b, d = np.random.default_rng(4).uniform(-3, 3, (3, 50, 3))
    error_pose = se2.compose(se2.inverse(d), se2.compose(se2.inverse(a), b))
    np.testing.assert_allclose(factors.relative_pose(a, b, d)[0], error_pose, atol=1e-14)


def test_chart_agrees_with_the_group_logarithm_to_first_order():
    a, b, _ = np.random.default_rng(5).uniform(-3, 3, (3, 3))
    for size in (1e-2, 1e-3):
        d = se2.compose(se2.between(a, b), size * np.array([1.0, -2.0, 1.5]))
        e = factors.relative_pose(a, b, d)[0]
        # the difference of chart and logarithm is omega * |t| / 2, second order
        assert np.linalg.norm(e - se2.log(e)) <= 2.0 * size**2


def test_residuals_do_not_change_when_the_world_is_moved():
    rng = np.random.default_rng(6)
    a, b, d, T = rng.uniform(-3, 3, (4, 20, 3))
    T = T[0]
    m, z = rng.uniform(-5, 5, (2, 20, 2))
    e = factors.relative_pose(a, b, d)[0]
    moved = factors.relative_pose(se2.compose(T, a), se2.compose(T, b), d)[0]
    np.testing.assert_allclose(moved, e, atol=1e-13)
    e = factors.pose_landmark(a, m, z)[0]
    moved = factors.pose_landmark(se2.compose(T, a), se2.transform(T, m), z)[0]
    np.testing.assert_allclose(moved, e, atol=1e-13)


def test_batches_of_any_shape_give_the_same_as_single_calls():
    rng = np.random.default_rng(7)
    a, b, d = rng.uniform(-3, 3, (3, 2, 4, 3))
    e, J_a, J_b = factors.relative_pose(a, b, d)
    assert e.shape == (2, 4, 3)
    assert J_a.shape == J_b.shape == (2, 4, 3, 3)
    one = factors.relative_pose(a[1, 2], b[1, 2], d[1, 2])
    for batch, single in zip((e, J_a, J_b), one, strict=True):
        np.testing.assert_array_equal(batch[1, 2], single)


def test_relative_information_is_that_of_the_residual():
    rng = np.random.default_rng(8)
    delta, L = rng.uniform(-2, 2, 3), rng.uniform(-0.01, 0.01, (3, 3))
    cov = L @ L.T + 1e-5 * np.eye(3)
    samples = delta + rng.multivariate_normal(np.zeros(3), cov, 200_000)
    e = factors.relative_pose(np.zeros(3), delta, samples)[0]
    sampled = np.cov(e.T)
    # 2 % is 6 sigma of the sampled covariance's relative error sqrt(2 / n)
    information = factors.relative_information(delta, cov)
    np.testing.assert_allclose(sampled @ information, np.eye(3), atol=0.03)


def test_every_kind_has_its_rows_and_its_loss():
    assert len(factors.COUNTED) == len(Losses().in_order()) == len(FactorKind)
    names = [kind.name.lower() for kind in FactorKind]
    assert [field.name for field in dataclasses.fields(Losses)] == names
