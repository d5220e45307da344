# SPDX-License-Identifier: Apache-2.0
"""Anonymous detections find their place among reflectors, or it is said that they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from rlml_slam import se2
from rlml_slam.compiled import LIBRARY
from rlml_slam.matching.reflectors import pair_votes, pose_fit
from rlml_slam.matching.reflectors.constellation import Prior, locate
from rlml_slam.params import Relocalization
from rlml_slam.types import Verdict

P = Relocalization()
TRUTH = np.array([3.0, -2.0, 2.2])
SIGMA = 0.02


def covs(n, sigma=SIGMA):
    return np.tile(sigma**2 * np.eye(2), (n, 1, 1))


def scattered(m, rng, size=20.0):
    """Reflectors (m, 2) without any order, 1 m apart."""
    points = np.zeros((0, 2))
    while len(points) < m:
        p = rng.uniform(-size, size, 2)
        if (np.hypot(*(points - p).T) > 1.0).all():
            points = np.vstack([points, p])
    return points


def seen_from(T, reflectors, rng=None, sigma=SIGMA):
    """Detections of the reflectors, with noise where there is a generator."""
    z = se2.transform(se2.inverse(T), reflectors)
    return z if rng is None else z + sigma * rng.standard_normal(z.shape)


def search(z, reflectors, params=P, prior=None, z_cov=None, p_cov=None):
    z_cov = covs(len(z)) if z_cov is None else z_cov
    p_cov = covs(len(reflectors), 0.01) if p_cov is None else p_cov
    return locate(z, z_cov, reflectors, p_cov, params, prior)


def error_of(pose, truth=TRUTH):
    e = se2.between(truth, pose)
    return np.hypot(e[0], e[1]), abs(e[2])


def with_ghosts(rng, m=20):
    """A map, detections of 14 of its reflectors and 6 ghosts."""
    reflectors = scattered(m, rng)
    z = seen_from(TRUTH, reflectors[:14], rng)
    return reflectors, np.vstack([z, rng.uniform(-20.0, 20.0, (6, 2))])


# --- by equation -------------------------------------------------------------------------------


def test_exact_detections_give_the_exact_pose():
    reflectors = scattered(15, np.random.default_rng(0))
    found = search(seen_from(TRUTH, reflectors[3:11]), reflectors)
    assert found.verdict is Verdict.UNIQUE
    (best,) = found.candidates
    np.testing.assert_array_equal(best.match, np.arange(3, 11))
    np.testing.assert_allclose(best.pose, TRUTH, atol=1e-9)
    assert best.chi2 == pytest.approx(0.0, abs=1e-12)


def test_pose_is_the_weighted_least_squares_of_its_matches():
    rng = np.random.default_rng(1)
    reflectors = scattered(12, rng)
    A = rng.standard_normal((20, 2, 2)) * 0.02
    spd = A @ A.transpose(0, 2, 1) + 1e-4 * np.eye(2)
    z_cov, p_cov = spd[:8], spd[8:]
    z = seen_from(TRUTH, reflectors[:8], rng)
    (best,) = search(z, reflectors, z_cov=z_cov, p_cov=p_cov).candidates
    np.testing.assert_array_equal(best.match, np.arange(8))
    R = se2.rotation(best.pose[2])
    S = R @ (z_cov + P.sigma_floor**2 * np.eye(2)) @ R.T + p_cov[:8]
    whiten = np.linalg.cholesky(np.linalg.inv(S)).transpose(0, 2, 1)

    def residual(x):
        r = reflectors[:8] - se2.transform(x, z)
        return np.einsum('nij,nj->ni', whiten, r).ravel()

    expected = least_squares(residual, best.pose, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(best.pose, expected.x, atol=1e-7)
    np.testing.assert_allclose(best.cov, np.linalg.inv(expected.jac.T @ expected.jac), rtol=1e-4)
    assert best.chi2 == pytest.approx(2.0 * expected.cost, rel=1e-6)


def test_prior_counts_as_one_more_measurement():
    rng = np.random.default_rng(2)
    reflectors = scattered(12, rng)
    z = seen_from(TRUTH, reflectors[:8], rng)
    (free,) = search(z, reflectors).candidates
    cov = np.diag([0.01, 0.02, 0.005]) ** 2
    prior = Prior(free.pose + np.array([0.02, -0.03, 0.004]), cov)
    (held,) = search(z, reflectors, prior=prior).candidates
    W, W_free = np.linalg.inv(cov), np.linalg.inv(free.cov)
    # the fit turns with the heading, so it is linear only up to the step
    np.testing.assert_allclose(held.cov, np.linalg.inv(W + W_free), rtol=1e-2)
    step = held.cov @ W @ (prior.pose - free.pose)
    np.testing.assert_allclose(held.pose - free.pose, step, atol=1e-5)


def test_most_matches_are_those_of_a_search_through_everything():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        reflectors = scattered(8, rng, size=6.0)
        here = seen_from(TRUTH, reflectors[:4], rng)
        z = np.vstack([here, rng.uniform(-6.0, 6.0, (3, 2))])
        tolerance = np.sqrt(chi2.ppf(P.gate, 2) * (2.0 * 0.3**2 + P.sigma_floor**2))
        found = search(z, reflectors, z_cov=covs(7, 0.3), p_cov=covs(8, 0.3))
        # every pair on every pair: no pose by a pair alone has more matches than the fitted best
        most = 0
        for a, b in zip(*np.triu_indices(7, 1), strict=True):
            for i in range(8):
                for j in range(8):
                    d, e = z[b] - z[a], reflectors[j] - reflectors[i]
                    if i == j or abs(np.hypot(*d) - np.hypot(*e)) > 0.1:
                        continue
                    theta = np.arctan2(e[1], e[0]) - np.arctan2(d[1], d[0])
                    t = reflectors[i] - se2.rotation(theta) @ z[a]
                    moved = se2.transform(np.array([*t, theta]), z)
                    gap = np.hypot(*(moved[:, None] - reflectors[None]).transpose(2, 0, 1))
                    most = max(most, len(set(gap.argmin(1)[gap.min(1) < 0.3 * tolerance])))
        assert most >= 4
        assert max(c.num_matches for c in found.candidates) >= most


# --- invariances -------------------------------------------------------------------------------


def test_moving_the_map_moves_the_pose():
    rng = np.random.default_rng(3)
    reflectors, z = with_ghosts(rng)
    (here,) = search(z, reflectors).candidates
    for T in ([100.0, -40.0, 0.0], [0.0, 0.0, np.pi], [-7.0, 3.0, -2.5]):
        found = search(z, se2.transform(np.array(T), reflectors))
        assert found.verdict is Verdict.UNIQUE
        (there,) = found.candidates
        np.testing.assert_allclose(error_of(there.pose, se2.compose(T, here.pose)), 0.0, atol=1e-7)
        np.testing.assert_array_equal(there.match, here.match)
        assert there.score == pytest.approx(here.score, rel=1e-9)


def test_moving_the_sensor_moves_the_pose():
    rng = np.random.default_rng(4)
    reflectors, z = with_ghosts(rng)
    (here,) = search(z, reflectors).candidates
    T = np.array([0.4, -1.0, 1.9])
    (there,) = search(se2.transform(se2.inverse(T), z), reflectors).candidates
    np.testing.assert_allclose(error_of(there.pose, se2.compose(here.pose, T)), 0.0, atol=1e-7)


@pytest.mark.parametrize('hopeless', [False, True])
def test_order_of_detections_and_reflectors_changes_nothing(hopeless):
    rng = np.random.default_rng(5)
    reflectors, z = with_ghosts(rng)
    if hopeless:
        z = z[10:]  # four detections of a reflector, six ghosts
    a = search(z, reflectors)
    k, m = rng.permutation(len(z)), rng.permutation(len(reflectors))
    b = search(z[k], reflectors[m])
    assert a.verdict is b.verdict
    assert a.why == b.why
    assert a.chance == pytest.approx(b.chance)
    assert len(a.candidates) == len(b.candidates)
    p, q = a.candidates[0], b.candidates[0]
    np.testing.assert_allclose(q.pose, p.pose, atol=1e-9)
    np.testing.assert_array_equal(np.where(q.match >= 0, m[q.match], -1), p.match[k])


def test_same_input_gives_the_same_bits():
    reflectors, z = with_ghosts(np.random.default_rng(6))
    a, b = (search(z, reflectors).candidates[0] for _ in range(2))
    assert a.pose.tobytes() == b.pose.tobytes()
    assert a.cov.tobytes() == b.cov.tobytes()
    assert a.score == b.score


# --- it never guesses --------------------------------------------------------------------------


def symmetric(rng, m=10):
    half = scattered(m, rng)
    return np.vstack([half, -half])


def test_layout_that_looks_the_same_turned_is_ambiguous():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        true = symmetric(rng)
        # errors of the map and of the detections differ between the twins, and must not count
        reflectors = true + 0.01 * rng.standard_normal(true.shape)
        z = seen_from(TRUTH, true[rng.random(20) < 0.7], rng)
        found = search(z, reflectors)
        assert found.verdict is Verdict.AMBIGUOUS
        assert 'fit alike' in found.why
        twins = [TRUTH, se2.compose(np.array([0.0, 0.0, np.pi]), TRUTH)]
        for twin in twins:
            assert min(error_of(c.pose, twin)[0] for c in found.candidates) < 0.05


def test_one_reflector_that_differs_does_not_decide_but_three_do():
    rng = np.random.default_rng(7)
    reflectors = symmetric(rng)
    for differing, verdict in ((1, Verdict.AMBIGUOUS), (3, Verdict.UNIQUE)):
        fewer = reflectors[: 20 - differing]  # reflectors without a twin break the symmetry
        found = search(seen_from(TRUTH, fewer, rng), fewer)
        assert found.verdict is verdict
    assert error_of(found.candidates[0].pose)[0] < 0.05


def test_prior_tells_twins_apart():
    rng = np.random.default_rng(8)
    reflectors = symmetric(rng)
    prior = Prior(TRUTH + np.array([0.8, -0.5, 0.2]), np.diag([1.0, 1.0, 0.1]))
    found = search(seen_from(TRUTH, reflectors, rng), reflectors, prior=prior)
    assert found.verdict is Verdict.UNIQUE
    assert error_of(found.candidates[0].pose)[0] < 0.05


def test_prior_elsewhere_makes_it_impossible():
    rng = np.random.default_rng(9)
    reflectors = scattered(12, rng)
    prior = Prior(TRUTH + np.array([8.0, 0.0, 0.0]), np.diag([0.01, 0.01, 0.01]))
    found = search(seen_from(TRUTH, reflectors, rng), reflectors, prior=prior)
    assert found.verdict is Verdict.IMPOSSIBLE
    assert found.candidates == ()


def test_unseen_reflectors_tell_twins_apart_where_they_may_count():
    """The same seven reflectors stand in two places, but eight more around the second."""
    rng = np.random.default_rng(10)
    group = scattered(7, rng, size=6.0)
    more = scattered(8, rng, size=6.0) + np.array([60.0, 0.0])
    reflectors = np.vstack([group, group + np.array([60.0, 0.0]), more])
    here = np.array([0.5, 1.0, -0.7])
    z = seen_from(here, group, rng)
    assert search(z, reflectors).verdict is Verdict.AMBIGUOUS
    found = search(z, reflectors, replace(P, max_range=15.0))
    assert found.verdict is Verdict.UNIQUE
    assert error_of(found.candidates[0].pose, here)[0] < 0.05


def test_place_where_most_reflectors_are_unseen_is_not_unique():
    rng = np.random.default_rng(11)
    reflectors = scattered(40, rng)
    z = seen_from(TRUTH, reflectors[:8], rng)
    assert search(z, reflectors).verdict is Verdict.UNIQUE
    found = search(z, reflectors, replace(P, max_range=60.0))
    assert found.verdict is Verdict.AMBIGUOUS
    assert '32 reflectors near by are not seen' in found.why


@pytest.mark.parametrize('k', [0, 1, 2])
def test_less_than_three_detections_are_impossible(k):
    reflectors = scattered(10, np.random.default_rng(12))
    found = search(seen_from(TRUTH, reflectors[:k]).reshape(-1, 2), reflectors)
    assert found.verdict is Verdict.IMPOSSIBLE
    assert f'{k} reflectors are seen' in found.why


@pytest.mark.parametrize('m', [0, 2])
def test_less_than_three_reflectors_are_impossible(m):
    z = scattered(5, np.random.default_rng(13))
    found = search(z, np.zeros((0, 2)) if m == 0 else z[:m])
    assert found.verdict is Verdict.IMPOSSIBLE
    assert f'the map has {m} reflectors' in found.why


def test_three_that_fit_by_chance_are_not_unique():
    """In a dense map, some three reflectors lie like nearly any three detections."""
    verdicts = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        reflectors = scattered(40, rng, size=10.0)
        found = search(rng.uniform(-8.0, 8.0, (3, 2)), reflectors, z_cov=covs(3, 0.05))
        verdicts.append(found.verdict)
        if found.verdict is Verdict.AMBIGUOUS:
            assert found.chance > P.false_positive_probability
    assert Verdict.UNIQUE not in verdicts
    assert verdicts.count(Verdict.AMBIGUOUS) > 10


def test_ghosts_alone_are_nowhere():
    verdicts = []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        found = search(rng.uniform(-20.0, 20.0, (16, 2)), scattered(30, rng))
        verdicts.append(found.verdict)
        assert found.verdict is not Verdict.UNIQUE
    assert verdicts.count(Verdict.IMPOSSIBLE) > 40


def test_mirror_image_does_not_fit():
    rng = np.random.default_rng(15)
    reflectors = scattered(20, rng)
    z = seen_from(TRUTH, reflectors, rng) * np.array([1.0, -1.0])
    assert search(z, reflectors).verdict is Verdict.IMPOSSIBLE


def test_reflectors_on_one_wall_tell_the_pose_unless_they_are_evenly_spaced():
    x = np.cumsum([0.0, 1.3, 2.7, 1.1, 3.9, 3.2, 1.7, 2.2, 4.4])
    reflectors = np.stack([x, np.zeros(9)], -1)
    found = search(seen_from(TRUTH, reflectors), reflectors)
    assert error_of(found.candidates[0].pose)[0] < 1e-6
    assert found.verdict is Verdict.UNIQUE
    even = np.stack([np.arange(9.0) * 3.0, np.zeros(9)], -1)
    assert search(seen_from(TRUTH, even), even).verdict is Verdict.AMBIGUOUS


def test_pose_that_is_held_loosely_is_not_unique():
    """Reflectors close together, far from the robot: a little turn moves it far."""
    rng = np.random.default_rng(16)
    reflectors = scattered(6, rng, size=2.5) + np.array([80.0, 0.0])
    found = search(seen_from(np.zeros(3), reflectors, rng, 0.002), reflectors)
    assert found.verdict is Verdict.AMBIGUOUS
    assert 'hold only to' in found.why
    assert len(found.candidates) == 1


def test_what_is_not_finite_does_not_take_part():
    rng = np.random.default_rng(17)
    reflectors, z = with_ghosts(rng)
    (clean,) = search(z, reflectors).candidates
    bad = np.insert(z, 4, [np.nan, 1.0], axis=0)
    (found,) = search(bad, reflectors).candidates
    np.testing.assert_array_equal(found.pose, clean.pose)
    np.testing.assert_array_equal(found.match, np.insert(clean.match, 4, -1))


# --- by experiment -----------------------------------------------------------------------------


def test_covariance_of_the_pose_is_honest():
    params = replace(P, sigma_floor=1e-4)
    nees = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        true = scattered(12, rng)
        reflectors = true + 0.01 * rng.standard_normal(true.shape)
        found = search(seen_from(TRUTH, true[:8], rng), reflectors, params)
        if found.verdict is Verdict.UNIQUE:
            e = found.candidates[0].pose - TRUTH
            nees.append(e @ np.linalg.solve(found.candidates[0].cov, e))
    assert len(nees) > 190
    # 99.9 % of the mean of so many chi^2 of three degrees
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_covariances_that_are_too_small_are_widened():
    """Noise twice as large as stated: the pose's own covariance says what it truly is."""
    params = replace(P, sigma_floor=1e-4)
    ratio = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        reflectors = scattered(30, rng)
        z = seen_from(TRUTH, reflectors, rng, sigma=0.04)
        found = search(z, reflectors, params, z_cov=covs(30, 0.02), p_cov=covs(30, 1e-4))
        assert found.verdict is Verdict.UNIQUE
        assert error_of(found.candidates[0].pose)[0] < 0.05
        ratio.append(np.trace(found.candidates[0].cov[:2, :2]) / (2.0 * 0.04**2 / 30))
    # between that of the stated noise and that of the true, for the gate cuts off the tails
    assert 0.6 < np.median(ratio) < 1.2


def test_crowded_regular_map_is_searched_to_the_end():
    """Every pair of a lattice is as far apart as many others; more proposals than are kept."""
    x, y = np.meshgrid(np.arange(8) * 4.0, np.arange(5) * 4.0)
    reflectors = np.stack([x.ravel(), y.ravel()], -1)
    rng = np.random.default_rng(18)
    found = search(seen_from(TRUTH, reflectors, rng), reflectors)
    assert found.verdict is Verdict.AMBIGUOUS
    assert min(error_of(c.pose)[0] for c in found.candidates) < 0.05


def lattice(n):
    x, y = np.meshgrid(np.arange(n) * 4.0, np.arange(n) * 4.0)
    return np.stack([x.ravel(), y.ravel()], -1)


@pytest.mark.parametrize('k', [200, 1000])
def test_search_of_a_plant_in_rows_ends_without_a_guess(k):
    """Without a bound, two hundred take minutes, and a thousand days."""
    reflectors = lattice(45)
    z = np.random.default_rng(19).uniform(0.0, 28.0, (k, 2))
    found = search(z, reflectors)
    assert found.verdict is Verdict.NOT_SEARCHED
    assert found.candidates == ()
    assert f'{k} detections are too many' in found.why


def test_map_with_too_many_pairs_is_not_searched():
    found = search(22.0 * lattice(4), lattice(68))
    assert found.verdict is Verdict.NOT_SEARCHED
    assert pair_votes.pairs_of(lattice(68), 400.0) is None


def test_pairs_are_all_those_that_detections_may_be_of():
    points = np.random.default_rng(21).uniform(0.0, 9.0, (40, 2))
    first, second = np.triu_indices(len(points), 1)
    length = np.hypot(*(points[first] - points[second]).T)
    order = np.argsort(length)[: (length < 4.0).sum()]
    pairs = pair_votes.pairs_of(points, 4.0)
    np.testing.assert_array_equal(pairs.length, length[order])
    np.testing.assert_array_equal(pairs.first, first[order])
    np.testing.assert_array_equal(pairs.second, second[order])


def test_search_that_may_take_longer_finds_the_same():
    rng = np.random.default_rng(20)
    reflectors, z = with_ghosts(rng)
    arguments = z, covs(len(z)), reflectors, covs(len(reflectors), 0.01), P
    found, longer = locate(*arguments), locate(*arguments, max_tests=10**12)
    assert found.verdict is longer.verdict is Verdict.UNIQUE
    np.testing.assert_array_equal(found.candidates[0].pose, longer.candidates[0].pose)
    assert locate(*arguments, max_tests=100).verdict is Verdict.NOT_SEARCHED


def test_kernels_are_compiled_by_the_warm_up():
    pose_fit.warm_up()
    rng = np.random.default_rng(19)
    reflectors, z = with_ghosts(rng)
    prior = Prior(TRUTH, np.eye(3))
    assert search(z, np.asfortranarray(reflectors), prior=prior).verdict is Verdict.UNIQUE
    for kernel in (pair_votes._fill, pair_votes.vote, pose_fit.refine):
        name = f'{kernel.__module__}.{kernel.__name__}'
        entries = kernel.signatures if LIBRARY is None else LIBRARY.index.entries[name]
        assert len(entries) == 1
