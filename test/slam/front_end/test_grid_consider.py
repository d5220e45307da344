# SPDX-License-Identifier: Apache-2.0
"""Matches with a grid whose cells are all off by the same: a consider filter (Schmidt 1966)."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.slam.front_end.grid_localization import at_most, relative_update

SHARED = np.diag([4e-4, 2e-4, 0.0])


def spd(rng, scale):
    A = rng.normal(size=(3, 3))
    return scale * (A @ A.T + 0.1 * np.eye(3))


@pytest.mark.parametrize('rank', [1, 2, 3])
def test_pose_is_as_if_the_error_of_the_map_were_a_state_that_is_not_corrected(rank):
    rng = np.random.default_rng(rank)
    for _ in range(20):
        cov = spd(rng, 1e-3) + SHARED
        root, v = 30.0 * rng.normal(size=(rank, 3)), rng.normal(size=rank)
        rows, values = relative_update(cov, SHARED, root, v)
        K = cov @ rows.T @ np.linalg.inv(rows @ cov @ rows.T + np.eye(rank))
        # the pose relative to the map, by a Kalman filter; then the map's error is added
        P = cov - SHARED
        L = P @ root.T @ np.linalg.inv(root @ P @ root.T + np.eye(rank))
        np.testing.assert_allclose(K @ values, L @ v, atol=1e-9)
        np.testing.assert_allclose(cov - K @ rows @ cov, P - L @ root @ P + SHARED, atol=1e-9)


def test_covariance_stays_above_what_is_shared():
    cov, rng = np.diag([0.1, 0.1, 0.01]), np.random.default_rng(0)
    for _ in range(200):
        shared = at_most(SHARED, cov)
        rows, _ = relative_update(cov, shared, 100.0 * rng.normal(size=(3, 3)), np.zeros(3))
        cov = np.linalg.inv(np.linalg.inv(cov) + rows.T @ rows)
    assert np.linalg.eigvalsh(cov - 0.95 * SHARED).min() > 0.0
    assert cov[0, 0] < 1.1 * SHARED[0, 0]


def test_of_a_pose_that_is_surer_only_a_part_is_shared():
    cov = np.diag([1e-6, 1.0, 1e-4])
    shared = at_most(SHARED, cov)
    assert np.linalg.eigvalsh(cov - shared).min() > 0.0
    np.testing.assert_allclose(np.diag(shared), [0.9999e-6, 2e-4, 0.0], atol=1e-10)
    assert not at_most(SHARED, np.zeros((3, 3))).any()


def test_pose_stays_finite_and_gets_no_less_sure_at_any_scale():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        A = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-4.0, 1.0, 3)
        cov = A @ A.T + 1e-12 * np.eye(3)
        shared = at_most(SHARED * 10.0 ** rng.uniform(-4.0, 2.0), cov)
        rank = int(rng.integers(1, 4))
        root = rng.normal(size=(rank, 3)) * 10.0 ** rng.uniform(-4.0, 4.0, (rank, 1))
        rows, values = relative_update(cov, shared, root, rng.normal(size=rank))
        assert np.isfinite(rows).all()
        assert np.isfinite(values).all()
        # what the rows add is no more than what the match tells
        gain = root @ cov @ root.T - rows @ cov @ rows.T
        assert np.trace(gain) > -1e-6 * np.trace(root @ cov @ root.T)
