# SPDX-License-Identifier: Apache-2.0
"""The covariance of a corrected pose: that of the graph, and what has come since."""

import numpy as np
from differences import central_differences
from made_worlds import ROOM, drive, observations

from rlml_slam import se2
from rlml_slam.estimation.correction import Correction, ReferencePose, carried, either, positive
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.front_end.front_end import FrontEnd

RNG = np.random.default_rng(7)


def random_cov():
    A = RNG.standard_normal((3, 3))
    return A @ A.T + 1e-3 * np.eye(3)


def smallest(A):
    return np.linalg.eigvalsh(A)[0]


def test_without_a_graph_the_covariance_is_the_front_ends_turned():
    T, cov = np.array([1.0, -2.0, 0.7]), random_cov()
    R = np.eye(3)
    R[:2, :2] = se2.rotation(0.7)
    pose, turned = Correction(T).apply(np.array([0.5, 0.1, -3.0]), cov)
    np.testing.assert_allclose(pose, se2.compose(T, [0.5, 0.1, -3.0]))
    np.testing.assert_allclose(turned, R @ cov @ R.T)


def test_pose_that_the_graph_knows_has_the_graphs_covariance():
    known = ReferencePose(np.array([3.0, 1.0, 0.4]), random_cov(), random_cov())
    _, cov = Correction(np.array([1.0, -2.0, 0.7]), known).apply(known.pose, known.cov_local)
    np.testing.assert_allclose(cov, known.cov_map, atol=1e-12)


def test_what_the_front_ends_covariance_has_grown_by_is_added():
    known = ReferencePose(np.zeros(3), random_cov(), random_cov())
    T = np.array([0.0, 0.0, 0.5 * np.pi])
    grown = np.diag([0.1, 0.2, 0.0])
    _, cov = Correction(T, known).apply(known.pose, known.cov_local + grown)
    np.testing.assert_allclose(cov, known.cov_map + np.diag([0.2, 0.1, 0.0]), atol=1e-12)


def test_what_was_learnt_since_is_not_taken_off():
    known = ReferencePose(np.zeros(3), random_cov(), random_cov())
    _, cov = Correction(np.zeros(3), known).apply(known.pose, 0.5 * known.cov_local)
    np.testing.assert_allclose(cov, known.cov_map, atol=1e-12)


def test_carried_covariance_is_that_of_a_rigidly_tied_pose():
    pose, tie, cov = np.array([1.0, 2.0, 0.3]), np.array([2.0, -1.0, 0.9]), random_cov()
    J = central_differences(lambda x: se2.compose(x, tie), pose)
    way = se2.compose(pose, tie)[:2] - pose[:2]
    np.testing.assert_allclose(carried(cov, way), J @ cov @ J.T, rtol=1e-6)


def test_either_is_no_smaller_than_both_and_no_larger_than_one_that_is():
    for _ in range(20):
        P, Q = random_cov(), random_cov()
        both = either(P, Q)
        assert smallest(both - P) > -1e-9
        assert smallest(both - Q) > -1e-9
        np.testing.assert_allclose(both, either(Q, P), rtol=1e-6)
        np.testing.assert_allclose(either(P, P + Q), P + Q, rtol=1e-6)


def test_either_of_a_singular_one_is_the_other():
    P = random_cov()
    np.testing.assert_allclose(either(P, np.zeros((3, 3))), P, rtol=1e-6)


def test_positive_part_keeps_what_is_positive():
    A = random_cov()
    np.testing.assert_allclose(positive(A), A, atol=1e-12)
    np.testing.assert_allclose(positive(-A), 0.0, atol=1e-12)


def test_newest_keyframe_is_known_no_better_than_graph_or_front_end_know_the_one_before():
    params = Parameters()
    front_end, back_end = FrontEnd(params), BackEnd(params)
    poses = drive((0.5, 0.2, 10.0))
    asked = 0
    for o in observations(ROOM, poses, scan=False, rng=np.random.default_rng(3)):
        update = back_end.add(front_end.process(o))
        if update is None or not update.optimized:
            continue
        asked += 1
        before, last = back_end.keyframes[-2:]
        way = back_end.graph.poses[last.index, :2] - back_end.graph.poses[before.index, :2]
        graph = Marginals(back_end.graph).poses([before.index])[0]
        R = np.eye(3)
        R[:2, :2] = se2.rotation(back_end.T_map_local[2])
        for cov in (graph, R @ before.cov_local @ R.T):
            assert smallest(update.known.cov_map - carried(cov, way)) > -1e-6
    assert asked >= 3
