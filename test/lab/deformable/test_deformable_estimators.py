# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares
from test_deformable_model import whitened_residuals

from rlml_lab.deformable import nls
from rlml_lab.deformable.ekf import dead_reckoning, run_ekf
from rlml_lab.deformable.experiment import ROWS, Draws, Measurements, Row, draw, edges
from rlml_lab.deformable.nls import run_nls
from rlml_lab.deformable.rts import run_rts
from rlml_lab.deformable.scoring import chi2_bounds, run_nees, ss3, step_nees
from rlml_lab.deformable.simulated_runs import simulate
from rlml_slam.deformable import block_tridiagonal
from rlml_slam.deformable.covariance import advance
from rlml_slam.deformable.model import Noise
from rlml_slam.se2 import rotation

NOISE = Noise()


def random_block_tridiagonal(N=6, n=4):
    g = np.random.default_rng(1)
    diagonal, below = np.empty((N, n, n)), 0.3 * g.standard_normal((N - 1, n, n))
    for i in range(N):
        a = g.standard_normal((n, n))
        diagonal[i] = a @ a.T + 4.0 * np.eye(n)
    dense = np.zeros((N * n, N * n))
    for i in range(N):
        dense[i * n : (i + 1) * n, i * n : (i + 1) * n] = diagonal[i]
    for i in range(N - 1):
        dense[(i + 1) * n : (i + 2) * n, i * n : (i + 1) * n] = below[i]
        dense[i * n : (i + 1) * n, (i + 1) * n : (i + 2) * n] = below[i].T
    return diagonal, below, dense


def test_block_tridiagonal_solution_and_marginals_are_the_dense_ones():
    diagonal, below, dense = random_block_tridiagonal()
    N, n, _ = diagonal.shape
    b = np.random.default_rng(2).standard_normal((N, n))
    expected = np.linalg.solve(dense, b.ravel()).reshape(N, n)
    inverse = np.linalg.inv(dense)
    assert block_tridiagonal.factorize(diagonal, below)
    block_tridiagonal.solve(diagonal, below, b)
    np.testing.assert_allclose(b, expected, atol=1e-12)
    cov = np.empty_like(diagonal)
    nls.marginals(diagonal, below, cov)
    for i in range(N):
        block = inverse[i * n : (i + 1) * n, i * n : (i + 1) * n]
        np.testing.assert_allclose(cov[i], block, atol=1e-12)


def test_factorisation_refuses_an_indefinite_matrix():
    diagonal, below, _ = random_block_tridiagonal()
    diagonal[3] -= 100.0 * np.eye(4)
    assert not block_tridiagonal.factorize(diagonal, below)


def test_prediction_is_f_p_f_transposed_plus_q():
    a = np.random.default_rng(0).standard_normal((9, 9))
    P = a @ a.T
    F = np.eye(9)
    F[0, 2], F[1, 2] = -0.7, 1.3
    expected = F @ P @ F.T + np.diag([0.02**2] * 2 + [0.01**2] + [0.13] * 6)
    advance(P, -0.7, 1.3, NOISE)
    np.testing.assert_allclose(P, expected, atol=1e-12)


def textbook_ekf(m):
    """Run 0 by dense matrices and one joint update per step."""
    N, M = m.sigma.shape[1:]
    x, P = np.zeros(3 + 2 * M), np.zeros((3 + 2 * M, 3 + 2 * M))
    x[3:] = m.feature[0, 0].ravel()
    P[3:, 3:] = np.diag(np.repeat(m.sigma[0, 0] ** 2, 2))
    means, covs = [], []
    for i in range(N):
        if i > 0:
            u, d = m.control[0, i - 1], rotation(x[2]) @ m.control[0, i - 1, :2]
            F = np.eye(len(x))
            F[:2, 2] = -d[1], d[0]
            x = x + np.concatenate([d, u[2:], m.drift[0, i - 1].ravel()])
            P = F @ P @ F.T + np.diag([4e-4, 4e-4, 1e-4] + [0.13] * 2 * M)
        H, y, r = [], [], []
        for j in range(M):
            if i == 0 or np.isnan(m.sigma[0, i, j]):
                continue
            R, f = rotation(x[2]), slice(3 + 2 * j, 5 + 2 * j)
            z = R.T @ (x[f] - x[:2])
            h = np.zeros((2, len(x)))
            h[:, :2], h[:, f], h[:, 2] = -R.T, R.T, [z[1], -z[0]]
            H.append(h)
            y.append(m.feature[0, i, j] - z)
            r += [m.sigma[0, i, j] ** 2] * 2
        for e, (j1, j2) in enumerate(edges(M)):
            h = np.zeros((2, len(x)))
            h[:, 3 + 2 * j1 : 5 + 2 * j1] = -np.eye(2)
            h[:, 3 + 2 * j2 : 5 + 2 * j2] = np.eye(2)
            H.append(h)
            y.append(m.edge[0, i, e] - h @ x)
            r += [0.04] * 2
        H = np.concatenate(H)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(r))
        x, P = x + K @ np.concatenate(y), P - K @ H @ P
        means.append(x)
        covs.append(P)
    return np.array(means), np.array(covs)


@pytest.mark.parametrize('row', ROWS[:4], ids=lambda r: r.name)
def test_ekf_is_the_textbook_filter(row):
    _, m = simulate(row, draw(range(1)))
    mean, cov = textbook_ekf(m)
    ekf = run_ekf(m, NOISE)
    np.testing.assert_allclose(ekf.mean[0], mean, atol=1e-9)
    np.testing.assert_allclose(ekf.cov[0], cov, atol=1e-9)


def test_nls_is_the_optimum_that_scipy_finds():
    truth, m = simulate(Row('circle', 'changing', 'predetermined'), draw(range(1)))
    nls = run_nls(m, NOISE)
    n = truth.shape[-1]

    def residuals(free):
        return whitened_residuals(np.concatenate([np.zeros(3), free]), m, NOISE)

    start = dead_reckoning(m)[0].ravel()[3:]
    found = least_squares(residuals, start, method='lm', xtol=1e-13, ftol=1e-13, gtol=1e-13)
    assert nls.converged[0]
    assert nls.cost[0] == pytest.approx(2.0 * found.cost, rel=1e-9)
    # scipy differentiates numerically, which limits it to about 1e-6
    np.testing.assert_allclose(nls.mean[0].ravel()[3:], found.x, atol=1e-5)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    newest = nls.cov[0, -1]
    np.testing.assert_allclose(newest, covariance[-n:, -n:], rtol=1e-3, atol=1e-5)


def test_gauss_newton_finds_the_same_optimum_from_the_truth():
    truth, m = simulate(Row('circle', 'fixed', 'predetermined'), draw(range(20)))
    from_reckoning, from_truth = run_nls(m, NOISE), run_nls(m, NOISE, truth)
    np.testing.assert_allclose(from_reckoning.mean, from_truth.mean, atol=1e-7)


@pytest.mark.parametrize('row', ROWS, ids=lambda r: r.name)
def test_noiseless_run_has_no_error(row):
    nothing = Draws(*(np.zeros_like(a) for a in vars(draw(range(1))).values()))
    truth, m = simulate(row, nothing)
    ekf = run_ekf(m, NOISE)
    for mean in (ekf.mean, run_rts(m, NOISE, ekf).mean, run_nls(m, NOISE).mean, dead_reckoning(m)):
        np.testing.assert_allclose(mean, truth, atol=1e-9)


def test_rts_and_nls_agree_where_the_problem_is_linear():
    """With a known heading nothing is nonlinear, and both are the one least-squares optimum."""
    still = Noise(heading=1e-8)
    _, m = simulate(Row('circle', 'fixed', 'predetermined'), draw(range(10)))
    ekf, nls = run_ekf(m, still), run_nls(m, still)
    rts = run_rts(m, still, ekf)
    np.testing.assert_allclose(rts.mean, nls.mean, atol=1e-6)
    np.testing.assert_allclose(rts.cov, nls.cov, atol=1e-6)


def test_newest_state_is_the_same_filtered_or_smoothed():
    _, m = simulate(Row('straight', 'fixed', 'predetermined'), draw(range(5)))
    ekf = run_ekf(m, NOISE)
    rts = run_rts(m, NOISE, ekf)
    np.testing.assert_array_equal(rts.mean[:, -1], ekf.mean[:, -1])
    assert np.all(
        np.trace(rts.cov, axis1=2, axis2=3) <= np.trace(ekf.cov, axis1=2, axis2=3) + 1e-9
    )


def test_order_of_the_features_does_not_matter():
    _, m = simulate(Row('straight', 'changing', 'predetermined'), draw(range(10)))
    order, state = [2, 0, 1], [0, 1, 2, 7, 8, 3, 4, 5, 6]
    where = {tuple(p): k for k, p in enumerate(edges(3).tolist())}
    edge = np.empty_like(m.edge)
    for k, (a, b) in enumerate(edges(3)):
        old = (order[a], order[b])
        edge[:, :, k] = (
            m.edge[:, :, where[old]] if old in where else -m.edge[:, :, where[old[::-1]]]
        )
    permuted = Measurements(
        m.control, m.drift[:, :, order], m.feature[:, :, order], m.sigma[:, :, order], edge
    )
    for run in (run_ekf, run_nls):
        a, b = run(m, NOISE), run(permuted, NOISE)
        np.testing.assert_allclose(b.mean, a.mean[..., state], atol=1e-9)


def test_covariances_account_for_the_errors():
    seeds = range(300)
    for row in (
        Row('straight', 'fixed', 'predetermined'),
        Row('circle', 'changing', 'predetermined'),
    ):
        truth, m = simulate(row, draw(seeds))
        nls = run_nls(m, NOISE)
        low, high = chi2_bounds(177, len(seeds))
        assert low < run_nees(truth, nls).mean() < high
        assert nls.converged.all()
        ekf = run_ekf(m, NOISE)
        # the EKF's is what it is, above its bound under changing noise; far off would be a bug
        assert 8.5 < step_nees(truth, ekf).mean() < 11.5


def test_run_nees_is_that_of_the_dense_information():
    truth, m = simulate(Row('circle', 'fixed', 'predetermined'), draw(range(2)))
    nls = run_nls(m, NOISE)
    J = least_squares(
        lambda x: whitened_residuals(np.concatenate([np.zeros(3), x]), m, NOISE),
        nls.mean[0].ravel()[3:], max_nfev=1,
    ).jac  # fmt: skip
    e = (nls.mean - truth)[0].ravel()[3:]
    assert run_nees(truth, nls)[0] == pytest.approx(((J @ e) ** 2).sum(), rel=1e-4)


def test_estimators_do_not_change_their_input():
    _, m = simulate(Row('circle', 'fixed', 'predetermined'), draw(range(2)))
    before = {k: v.copy() for k, v in dataclasses.asdict(m).items()}
    ekf = run_ekf(m, NOISE)
    frozen = ekf.mean.copy()
    run_rts(m, NOISE, ekf)
    run_nls(m, NOISE)
    np.testing.assert_array_equal(ekf.mean, frozen)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(m, name), value)


def test_ss3_is_the_sum_over_the_steps_of_one_run():
    truth, mean = np.zeros((1, 20, 9)), np.zeros((1, 20, 9))
    mean[0, 4, :3], mean[0, 7, 3:] = (0.1, 0.2, 0.3), 5.0
    assert ss3(truth, mean)[0] == pytest.approx(0.14)
