# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from differences import central_differences
from scipy.stats import chi2

from rlml_slam import se2
from rlml_slam.matching.reflectors.association import Associator, Believed, gate
from rlml_slam.matching.reflectors.innovations import expected, joint_distance2, pairwise
from rlml_slam.params import Reflector
from rlml_slam.types import ANONYMOUS, Detections, Status

POINTS = np.array([[4.0, 1.0], [2.0, -3.0], [-3.0, 2.0], [6.0, 5.0]])


def believed(points=POINTS, pose=(0.2, -0.1, 0.4), ids=None, sigma=0.02, pose_sigma=0.02):
    """Independent pose and reflectors, unless the test says otherwise."""
    points = np.asarray(points, dtype=np.float64)
    m = len(points)
    sigmas = np.concatenate([[pose_sigma, pose_sigma, 0.5 * pose_sigma], np.full(2 * m, sigma)])
    ids = np.full(m, ANONYMOUS) if ids is None else np.asarray(ids, dtype=np.int64)
    return Believed(np.array(pose), points, ids, np.diag(sigmas**2))


def detections(points, ids=None, sigma=0.02):
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    n = len(points)
    ids = np.full(n, ANONYMOUS) if ids is None else np.asarray(ids, dtype=np.int64)
    cov = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
    return Detections(1, 'base_link', points, cov, ids, np.full(n, np.nan))


def seen(b, index=None, shift=(0.0, 0.0), **kw):
    """Exact detections of the believed reflectors ``index``, moved by ``shift`` in the map."""
    index = np.arange(len(b.points)) if index is None else np.asarray(index)
    return detections(se2.transform(se2.inverse(b.pose), b.points[index] + shift), **kw)


def dense(b, d, i, j):
    """Innovation and its covariance by the textbook, on the whole joint state."""
    m = len(b.points)

    def h(x):
        return se2.transform(se2.inverse(x[:3]), x[3:].reshape(-1, 2)[j][None])[0]

    x = np.concatenate([b.pose, b.points.ravel()])
    H = central_differences(h, x)
    assert H.shape == (2, 3 + 2 * m)
    return d.points[i] - h(x), H @ b.cov @ H.T + d.cov[i]


# --- by equation -------------------------------------------------------------------------------


@pytest.mark.parametrize('theta', [0.0, 0.7, 3.1, -3.14159])
def test_prediction_and_jacobians_are_those_of_equation_1(theta):
    pose = np.array([0.3, -1.2, theta])
    z, J = np.empty(2), np.empty((2, 5))
    for point in POINTS:
        expected(pose, *point, z, J)
        np.testing.assert_allclose(z, seen_from(np.concatenate([pose, point])), atol=1e-14)
        by_differences = central_differences(seen_from, np.concatenate([pose, point]))
        np.testing.assert_allclose(J, by_differences, atol=1e-8)


def seen_from(x):
    """The reflector x[3:] as seen from the pose x[:3]."""
    return se2.transform(se2.inverse(x[:3]), x[3:][None])[0]


def correlated(b):
    """The same with correlations among all of it."""
    rng = np.random.default_rng(3)
    half = 0.02 * rng.normal(size=b.cov.shape)
    return replace(b, cov=b.cov + half @ half.T)


def test_pairs_are_judged_by_the_whole_joint_covariance():
    b = correlated(believed())
    d = seen(b, shift=(0.03, -0.02))
    spread2 = np.array([0.0, 0.01, 0.0, 0.02])
    nu, d2, log_det = pairwise(b.pose, b.points, b.cov, spread2, d.points, d.cov)
    for i in range(len(d)):
        for j in range(len(b.points)):
            by_hand, S = dense(b, d, i, j)
            S = S + spread2[j] * np.eye(2)
            np.testing.assert_allclose(nu[i, j], by_hand, atol=1e-12)
            assert d2[i, j] == pytest.approx(by_hand @ np.linalg.solve(S, by_hand), rel=1e-6)
            assert log_det[i, j] == pytest.approx(np.linalg.slogdet(S)[1], abs=1e-6)


def test_joint_distance_is_that_of_all_innovations_at_once():
    b = correlated(believed())
    d = seen(b, shift=(0.03, -0.02))
    nu, _, _ = pairwise(b.pose, b.points, b.cov, np.zeros(4), d.points, d.cov)
    rows, cols = np.array([0, 2, 3]), np.array([0, 2, 3])

    def h(x):
        return se2.transform(se2.inverse(x[:3]), x[3:].reshape(-1, 2)[cols]).ravel()

    x = np.concatenate([b.pose, b.points.ravel()])
    H, v = central_differences(h, x), d.points[rows].ravel() - h(x)
    S = H @ b.cov @ H.T + 0.02**2 * np.eye(6)
    joint = joint_distance2(b.pose, b.points, b.cov, nu, d.cov, rows, cols)
    assert joint == pytest.approx(v @ np.linalg.solve(S, v), rel=1e-6)


def test_gate_holds_its_share_of_the_true_matches():
    assert gate(0.95) == pytest.approx(chi2.ppf(0.95, 2))
    assert gate(0.95, 6) == pytest.approx(chi2.ppf(0.95, 6))


def test_distance_uses_the_joint_covariance():
    rng = np.random.default_rng(0)
    b = believed()
    A = rng.standard_normal((11, 11)) * 0.02
    b = replace(b, cov=A @ A.T + 1e-5 * np.eye(11))
    d = seen(b, sigma=0.03)
    d = replace(d, points=d.points + 0.01 * rng.standard_normal((4, 2)))
    result = Associator(Reflector()).associate(d, b)
    np.testing.assert_array_equal(result.match, np.arange(4))
    for k in range(4):
        nu, S = dense(b, d, k, k)
        assert result.distance2[k] == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-5)


# --- invariances -------------------------------------------------------------------------------


def test_permuting_detections_permutes_the_answer():
    rng = np.random.default_rng(1)
    b = believed()
    points = np.vstack([seen(b).points, [[9.0, -9.0]]])
    d = detections(points + 0.01 * rng.standard_normal(points.shape))
    a = Associator(Reflector()).associate(d, b)
    np.testing.assert_array_equal(a.match, [0, 1, 2, 3, -1])
    k = rng.permutation(5)
    moved = replace(d, points=d.points[k], cov=d.cov[k], ids=d.ids[k])
    c = Associator(Reflector()).associate(moved, b)
    np.testing.assert_array_equal(c.match, a.match[k])
    np.testing.assert_array_equal(c.status, a.status[k])
    np.testing.assert_allclose(c.distance2, a.distance2[k])


def test_permuting_reflectors_permutes_the_answer():
    b = believed()
    k = np.array([2, 0, 3, 1])
    c = believed(POINTS[k])
    d = seen(b)
    associate = Associator(Reflector()).associate
    np.testing.assert_array_equal(k[associate(d, c).match], associate(d, b).match)


def test_moving_the_world_changes_nothing():
    rng = np.random.default_rng(2)
    b = believed()
    d = seen(b, shift=(0.02, -0.01))
    d = replace(d, points=d.points + 0.02 * rng.standard_normal((4, 2)))
    T = np.array([5.0, -8.0, 2.5])
    R = np.eye(11)
    for k in (0, 3, 5, 7, 9):
        R[k : k + 2, k : k + 2] = se2.rotation(T[2])
    moved = Believed(se2.compose(T, b.pose), se2.transform(T, b.points), b.ids, R @ b.cov @ R.T)
    associate = Associator(Reflector()).associate
    x, y = associate(d, b), associate(d, moved)
    np.testing.assert_array_equal(x.match, y.match)
    np.testing.assert_allclose(x.distance2, y.distance2, rtol=1e-8)


# --- what becomes of a detection ---------------------------------------------------------------


def test_nothing_seen_or_nothing_known_matches_nothing():
    associate = Associator(Reflector()).associate
    empty = associate(detections(np.zeros((0, 2))), believed())
    assert len(empty.match) == 0
    new = associate(seen(believed()), believed(np.zeros((0, 2))))
    assert (new.match == -1).all()
    assert (new.status == Status.NEW).all()
    assert np.isnan(new.distance2).all()


def test_far_detection_is_new_and_near_misfit_is_gated():
    b = believed()
    # d2 at distance x from a reflector is x^2 / S: between the two gates, and beyond both
    S = dense(b, seen(b), 0, 0)[1]
    inside, beyond = gate(Reflector().gate), gate(Reflector().new_gate)
    assert inside < beyond
    direction = np.linalg.cholesky(S) @ [1.0, 0.0]
    between = seen(b).points[0] + np.sqrt(0.5 * (inside + beyond)) * direction
    params = Reflector(min_separation=0.0, separability_sigma=0.0)
    result = Associator(params).associate(detections([between, [9.0, -9.0]]), b)
    np.testing.assert_array_equal(result.match, [-1, -1])
    np.testing.assert_array_equal(result.status, [Status.GATED, Status.NEW])


def test_detection_closer_than_reflectors_can_be_told_apart_is_never_new():
    b = believed(sigma=1e-4, pose_sigma=1e-5)
    near = seen(b, [0], shift=(0.2, 0.0), sigma=1e-3)
    result = Associator(Reflector(min_separation=0.25)).associate(near, b)
    assert result.status[0] == Status.GATED
    result = Associator(Reflector(min_separation=0.1)).associate(near, b)
    assert result.status[0] == Status.NEW


def test_one_reflector_takes_one_detection():
    b = believed()
    z = seen(b).points
    d = detections([z[0] + [0.03, 0.0], z[0] + [0.005, 0.0], z[1]])
    result = Associator(Reflector()).associate(d, b)
    np.testing.assert_array_equal(result.match, [-1, 0, 1])
    assert result.status[0] == Status.AMBIGUOUS


def test_known_id_goes_to_its_reflector_and_no_other():
    b = believed([[4.0, 1.0], [4.2, 1.0]], ids=[7, 8])
    # nearer to 7, but says 8
    d = seen(b, [0], shift=(0.05, 0.0), ids=[8], sigma=0.05)
    result = Associator(Reflector()).associate(d, b)
    np.testing.assert_array_equal(result.match, [1])
    other = seen(b, [0], ids=[9], sigma=0.05)
    result = Associator(Reflector()).associate(other, b)
    assert result.match[0] == -1
    # a name never heard is a reflector never seen, however near
    assert result.status[0] == Status.NEW
    far = seen(b, [0], shift=(3.0, 0.0), ids=[7])
    result = Associator(Reflector()).associate(far, b)
    assert result.match[0] == -1
    assert result.status[0] == Status.GATED


def test_anonymous_detection_matches_a_reflector_with_an_id():
    b = believed(ids=[1, 2, 3, 4])
    np.testing.assert_array_equal(Associator(Reflector()).associate(seen(b), b).match, range(4))


def test_joint_compatibility_resolves_what_each_alone_gets_wrong():
    # a row of reflectors 0.5 m apart, the robot uncertain along it by nearly as much: one by
    # one the nearest is the neighbour, together only the shift by 0.3 m of all of them fits
    row = np.stack([np.arange(5) * 0.5 + [0.0, 0.1, 0.0, 0.17, 0.05], np.full(5, 2.0)], -1)
    b = believed(row, pose=(0.0, 0.0, 0.0), sigma=0.005)
    cov = b.cov.copy()
    cov[0, 0] = 0.3**2
    cov[1, 1] = cov[2, 2] = 1e-6
    b = replace(b, cov=cov)
    d = detections(row + np.array([0.3, 0.0]), sigma=0.01)
    result = Associator(Reflector(separability_sigma=0.0)).associate(d, b)
    np.testing.assert_array_equal(result.match, np.arange(5))
    assert (result.status == Status.USED).all()


def test_wrong_match_is_given_up_where_the_hypothesis_as_a_whole_does_not_fit():
    b = believed(POINTS, sigma=1e-3, pose_sigma=0.3)
    z = seen(b).points
    # each detection alone is within the pose's uncertainty; all together only if the robot
    # is shifted one way, and the last one says the other
    z[:3] += [0.3, 0.0]
    z[3] -= [0.3, 0.0]
    result = Associator(Reflector()).associate(detections(z, sigma=0.01), b)
    np.testing.assert_array_equal(result.match, [0, 1, 2, -1])


def wary(b, recent=()):
    return replace(b, recent=np.isin(np.arange(len(b.points)), recent))


def test_of_two_that_explain_it_alike_neither_is_used():
    twins = believed([[4.0, 0.0], [4.0, 0.3], [-2.0, 1.0]], pose=(0.0, 0.0, 0.0), sigma=0.05)
    d = detections([[4.0, 0.14], [-2.0, 1.0]], sigma=0.05)
    eager = Associator(Reflector()).associate(d, twins)
    np.testing.assert_array_equal(eager.match, [0, 2])
    careful = Associator(Reflector()).associate(d, wary(twins))
    np.testing.assert_array_equal(careful.match, [-1, 2])
    assert careful.status[0] == Status.AMBIGUOUS


def test_match_of_a_lost_pose_is_doubtful_and_of_a_sure_one_used():
    sure = wary(believed())
    np.testing.assert_array_equal(Associator(Reflector()).associate(seen(sure), sure).status, 0)
    lost = wary(believed(pose_sigma=1.0))
    result = Associator(Reflector()).associate(seen(lost, [1]), lost)
    assert (result.match[0], result.status[0]) == (-1, Status.DEFERRED)


def test_reflector_seen_a_moment_ago_and_one_with_an_id_need_no_proof():
    lost = wary(believed(pose_sigma=1.0), recent=[1])
    assert Associator(Reflector()).associate(seen(lost, [1]), lost).match[0] == 1
    with_ids = wary(believed(pose_sigma=1.0, ids=[7, 8, 9, 10]))
    result = Associator(Reflector()).associate(seen(with_ids, [1], ids=[8]), with_ids)
    assert (result.match[0], result.status[0]) == (1, Status.USED)


def test_the_denser_unknown_reflectors_may_stand_the_surer_a_match_must_be():
    b = wary(believed(pose_sigma=0.3))
    d = seen(b, [1])
    assert Associator(Reflector(unmapped_density=1e-4)).associate(d, b).match[0] == 1
    assert Associator(Reflector(unmapped_density=1.0)).associate(d, b).match[0] == -1


def test_unknown_detections_side_by_side_begin_one_reflector():
    b = wary(believed())
    status = Associator(Reflector()).associate(detections([[9.0, -7.0], [9.0, -6.9]]), b).status
    np.testing.assert_array_equal(status, [Status.NEW, Status.AMBIGUOUS])


def test_share_of_true_matches_inside_the_gate_is_the_gates():
    rng = np.random.default_rng(3)
    b = believed(POINTS[:1])
    associator = Associator(Reflector(gate=0.9))
    L = np.linalg.cholesky(b.cov)
    hits, n = 0, 1000
    for _ in range(n):
        x = np.concatenate([b.pose, b.points.ravel()]) + L @ rng.standard_normal(5)
        z = se2.transform(se2.inverse(x[:3]), x[3:][None])
        d = detections(z + 0.02 * rng.standard_normal((1, 2)))
        hits += associator.associate(d, b).match[0] == 0
    # binomial: sigma = sqrt(0.9 0.1 / n) = 1 %; four of them
    assert abs(hits / n - 0.9) < 0.04
