# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from differences import central_differences

from rlml_lab.deformable.experiment import SENSORS, Draws, Row, draw, edges, nominal
from rlml_lab.deformable.nls import linearize
from rlml_lab.deformable.simulated_runs import simulate
from rlml_slam.deformable.model import (
    Noise,
    in_range_probability,
    motion,
    observe_feature,
    sigma_at,
)
from rlml_slam.se2 import rotation

HEADINGS = (0.0, 1e-9, 0.7, -2.0, math.pi - 1e-9, 6.5)


@pytest.mark.parametrize('theta', HEADINGS)
def test_motion_jacobian_is_the_difference_quotient(theta):
    control = np.array([1.7, -0.4, 0.3])

    def move(pose):
        return np.array(motion(*pose, control)[:3])

    at = np.array([0.3, -1.2, theta])
    _, _, _, a, b = motion(*at, control)
    expected = np.eye(3)
    expected[:2, 2] = a, b
    np.testing.assert_allclose(central_differences(move, at), expected, atol=1e-8)
    # the note prints R J v^T; R J v is what the derivative is
    J = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose([a, b], rotation(theta) @ J @ control[:2], atol=1e-14)


@pytest.mark.parametrize('theta', HEADINGS)
def test_feature_jacobian_is_the_difference_quotient(theta):
    at = np.array([0.3, -1.2, theta, 9.0, 9.0, 1.1, 0.4])
    z, H = np.empty(2), np.empty((2, 5))
    observe_feature(at, 1, z, H)

    def see(state):
        out = np.empty(2)
        observe_feature(state, 1, out, np.empty((2, 5)))
        return out

    numeric = central_differences(see, at)
    np.testing.assert_allclose(numeric[:, [0, 1, 2, 5, 6]], H, atol=1e-8)
    assert np.all(numeric[:, 3:5] == 0.0)
    np.testing.assert_allclose(z, rotation(theta).T @ (at[5:] - at[:2]), atol=1e-14)


def whitened_residuals(flat, m, noise):
    """The whole objective of run 0 written once more, plainly, from the pinned experiment."""
    state = flat.reshape(m.feature.shape[1], -1)
    out = []
    for i in range(len(state)):
        p, theta, f = state[i, :2], state[i, 2], state[i, 3:].reshape(-1, 2)
        for j in range(len(f)):
            if not np.isnan(m.sigma[0, i, j]):
                z = rotation(theta).T @ (f[j] - p)
                out.append((z - m.feature[0, i, j]) / m.sigma[0, i, j])
        for e, (j1, j2) in enumerate(edges(len(f))):
            out.append((f[j2] - f[j1] - m.edge[0, i, e]) / noise.edge)
        if i + 1 < len(state):
            u, after = m.control[0, i], state[i + 1]
            out.append((after[:2] - p - rotation(theta) @ u[:2]) / noise.position)
            out.append([(after[2] - theta - u[2]) / noise.heading])
            moved = after[3:].reshape(-1, 2) - f - m.drift[0, i]
            out.append(moved.ravel() / math.sqrt(noise.drift2))
    return np.concatenate(out)


def test_normal_equations_are_those_of_the_objective():
    noise = Noise()
    truth, m = simulate(Row('circle', 'changing', 'predetermined'), draw(range(1)))
    at = truth[0] + 0.05 * np.random.default_rng(0).standard_normal(truth[0].shape)
    at[0, :3] = 0.0
    N, n = at.shape
    diagonal, below, g = np.empty((N, n, n)), np.empty((N - 1, n, n)), np.empty((N, n))
    cost = linearize(
        at, m.control[0], m.drift[0], m.feature[0], m.sigma[0], m.edge[0], edges(3), noise,
        diagonal, below, g,
    )  # fmt: skip
    r = whitened_residuals(at.ravel(), m, noise)
    J = central_differences(lambda x: whitened_residuals(x, m, noise), at.ravel(), step=1e-5)
    J[:, :3] = 0.0  # pose 1 is fixed
    H = np.zeros((N * n, N * n))
    for i in range(N):
        H[i * n : i * n + n, i * n : i * n + n] = diagonal[i]
        if i + 1 < N:
            H[(i + 1) * n : (i + 2) * n, i * n : i * n + n] = below[i]
            H[i * n : i * n + n, (i + 1) * n : (i + 2) * n] = below[i].T
    expected = J.T @ J
    expected[:3, :3] = np.eye(3)
    assert cost == pytest.approx(r @ r, rel=1e-12)
    # entries reach 1e6 (sigma 1e-3); 1e-6 of the largest is what the issue allows
    np.testing.assert_allclose(H, expected, atol=1e-6 * np.abs(H).max(), rtol=1e-6)
    np.testing.assert_allclose(g.ravel(), J.T @ r, atol=1e-6 * np.abs(g).max(), rtol=1e-6)


def test_changing_noise_is_linear_between_its_pinned_ends():
    sensor = SENSORS['changing']
    assert sigma_at(0.1, sensor) == pytest.approx(0.001, abs=1e-15)
    assert sigma_at(2.0, sensor) == pytest.approx(0.09, abs=1e-15)
    assert sigma_at(1.05, sensor) == pytest.approx(0.0455, abs=1e-15)
    assert sigma_at(0.01, sensor) == pytest.approx(0.001, abs=1e-15)
    assert sigma_at(9.0, sensor) == pytest.approx(0.09, abs=1e-15)
    assert sigma_at(1.3, SENSORS['fixed']) == 0.05


@pytest.mark.parametrize(
    ('mean', 'S'),
    [
        ((0.5, 0.2), ((0.2, 0.0), (0.0, 0.2))),
        ((1.9, 0.0), ((0.04, 0.01), (0.01, 0.3))),
        ((0.0, 0.0), ((1.0, 0.0), (0.0, 1.0))),
        ((2.5, -1.0), ((0.5, -0.3), (-0.3, 0.4))),
    ],
)
def test_in_range_probability_is_the_share_of_samples_in_range(mean, S):
    samples = np.random.default_rng(0).multivariate_normal(mean, S, 200_000)
    distance = np.linalg.norm(samples, axis=-1)
    share = ((distance >= 0.1) & (distance <= 2.0)).mean()
    # the cube-root law is good to about 0.01; sampling adds 0.001
    assert in_range_probability(*mean, np.array(S), 0.1, 2.0) == pytest.approx(share, abs=0.02)


def test_in_range_probability_of_a_certain_distance_is_zero_or_one():
    none = np.zeros((2, 2))
    assert in_range_probability(1.0, 0.0, none, 0.1, 2.0) == 1.0
    assert in_range_probability(2.1, 0.0, none, 0.1, 2.0) == 0.0
    assert in_range_probability(0.05, 0.0, none, 0.1, 2.0) == 0.0


def test_noiseless_robot_keeps_the_pinned_paths_beside_its_features():
    nothing = Draws(*(np.zeros_like(a) for a in vars(draw(range(1))).values()))
    for path in ('straight', 'circle'):
        truth, m = simulate(Row(path, 'fixed', 'predetermined'), nothing)
        steps = np.diff(truth[0, :, :2], axis=0)
        np.testing.assert_allclose(np.linalg.norm(steps, axis=-1), 2.0, atol=1e-12)
        # robot and features make the same steps: the nominal translation
        np.testing.assert_allclose(steps, nominal(path).translation[:19], atol=1e-12)
        assert not np.isnan(m.sigma).any()
    np.testing.assert_allclose(truth[0, 0, 3:], [0.5, 0.5, 0.9, 0.8, 0.3, 0.4])
    assert truth[0, -1, 2] == pytest.approx(1.9 * math.pi)


def test_unseen_exactly_where_the_true_distance_is_out_of_range():
    truth, m = simulate(Row('straight', 'fixed', 'predetermined'), draw(range(50)))
    f = truth[..., 3:].reshape(*truth.shape[:2], 3, 2)
    distance = np.linalg.norm(f - truth[:, :, None, :2], axis=-1)
    seen = (distance >= 0.1) & (distance <= 2.0)
    seen[:, 0] = True
    np.testing.assert_array_equal(~np.isnan(m.sigma), seen)
    np.testing.assert_array_equal(~np.isnan(m.feature).any(-1), seen)


def test_noise_has_the_pinned_sizes():
    truth, m = simulate(Row('circle', 'fixed', 'predetermined'), draw(range(400)))
    turn = np.diff(truth[..., 2], axis=1) - math.pi / 10
    own = np.diff(truth[..., 3:].reshape(400, 20, 3, 2), axis=1) - m.drift
    f = truth[..., 3:].reshape(400, 20, 3, 2)
    edge = m.edge - (f[:, :, edges(3)[:, 1]] - f[:, :, edges(3)[:, 0]])
    # relative error of a sigma from n samples is 1 / sqrt(2 n): 0.8 % of 7600
    assert turn.std() == pytest.approx(0.01, rel=0.03)
    assert own.var() == pytest.approx(0.13, rel=0.03)
    assert edge.std() == pytest.approx(0.2, rel=0.03)


def test_a_run_depends_on_its_own_seed_alone():
    together, alone = draw(range(5)), draw(range(3, 4))
    for a, b in zip(vars(together).values(), vars(alone).values(), strict=True):
        np.testing.assert_array_equal(a[3], b[0])
