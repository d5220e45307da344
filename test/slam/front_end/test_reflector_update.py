# SPDX-License-Identifier: Apache-2.0
"""The update with reflectors is the optimum of eq. 3, as an independent solver finds it."""

from __future__ import annotations

import numpy as np
import pytest
from differences import central_differences
from scipy.optimize import least_squares

from rlml_slam import se2
from rlml_slam.slam.front_end.joint_state import LANDMARKS, JointState
from rlml_slam.slam.front_end.reflector_update import use_reflectors

INDEX = np.array([2, 0, 3])


def made(sigma: float) -> JointState:
    """Four reflectors around a pose that is uncertain by ``sigma``, correlated with all."""
    rng = np.random.default_rng(4)
    pose = np.array([0.3, -0.5, 2.9])
    state = JointState(pose, sigma**2 * np.eye(3), 0.01, (1.0, 1.0, 1.0), (0.03, 0.05, 0.03, 0.1))
    for slot in range(2):
        state.clone_pose(slot, 0.5, 1e-6 * np.eye(3))
    for z in 5.0 * rng.normal(size=(4, 2)):
        state.add_landmark(z, 0.03**2 * np.eye(2))
    state.widen((0.3 * sigma) ** 2 * np.eye(3))
    return state


@pytest.mark.parametrize('sigma', [0.002, 0.02])
def test_update_is_the_optimum_over_prior_and_reflectors(sigma):
    state = made(sigma)
    x0, P0 = state.x.copy(), state.P.copy()
    noise = np.array([[[4e-4, 1e-4], [1e-4, 9e-4]]] * 3)
    z = seen(x0 + np.r_[0.5 * sigma, -0.4 * sigma, 0.6 * sigma, np.zeros(len(x0) - 3)])
    z += 0.01 * np.random.default_rng(5).normal(size=z.shape)

    root = np.linalg.cholesky(np.linalg.inv(P0)).T
    white = np.linalg.cholesky(np.linalg.inv(noise)).transpose(0, 2, 1)

    def residual(x):
        innovation = (white @ (z - seen(x))[:, :, None]).ravel()
        return np.concatenate([root @ (x - x0), innovation])

    best = least_squares(residual, x0, xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale='jac').x
    use_reflectors(state.x, state.P, INDEX, z, noise, np.zeros(3), np.zeros(3), 1.0)
    np.testing.assert_allclose(state.x, best, atol=5e-3 * sigma)
    J = central_differences(residual, state.x)
    np.testing.assert_allclose(state.P, np.linalg.inv(J.T @ J), atol=0.01 * sigma**2)
    np.testing.assert_array_equal(state.P, state.P.T)


def test_spread_and_huber_widen_the_noise():
    noise = np.array([[[4e-4, 1e-4], [1e-4, 9e-4]]] * 3)
    spread2, distance2, scale = np.array([0.0, 2e-4, 0.0]), np.array([1.0, 9.0, 16.0]), 2.0
    state, wider = made(0.02), made(0.02)
    z = seen(state.x) + 0.01
    use_reflectors(state.x, state.P, INDEX, z, noise, spread2, distance2, scale)
    # the weight of Huber's loss is scale / distance, here for squared distances
    excess = np.maximum(distance2 / scale**2, 1.0)
    noise = (noise + spread2[:, None, None] * np.eye(2)) * excess[:, None, None]
    use_reflectors(wider.x, wider.P, INDEX, z, noise, np.zeros(3), np.zeros(3), scale)
    np.testing.assert_allclose(state.x, wider.x, atol=1e-12)
    np.testing.assert_allclose(state.P, wider.P, atol=1e-15)


def seen(x):
    """Reflectors INDEX of a state as its pose sees them (3, 2)."""
    return se2.transform(se2.inverse(x[:3]), x[LANDMARKS:].reshape(-1, 2)[INDEX])
