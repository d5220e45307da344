# SPDX-License-Identifier: Apache-2.0
"""What is known of a keyframe by one way alone: no surer than what lasts lets it be."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from rlml_slam import se2
from rlml_slam.estimation.correction import either
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.factors import relative_information
from rlml_slam.graph.model.graph import Graph
from rlml_slam.slam.back_end.path_covariance import (
    PathCovariance,
    intersection,
    is_constrained_by_reflectors,
)
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import EdgeKind, Motion

SHARES = (0.03, 0.05)
NOISE = np.diag([0.02, 0.01, 0.01]) ** 2  # of one motion
MATCH = np.diag([0.02, 0.02, 0.005]) ** 2
# out along a bend, and back by the same way
STEPS = 12 * [[1.0, 0.0, 0.05]] + 6 * [[0.0, 0.0, np.pi / 6]] + 12 * [[1.0, 0.0, -0.05]]


def random_cov(rng, n=3):
    A = rng.standard_normal((n, n))
    return A @ A.T + 1e-3 * np.eye(n)


def keyframe(index, pose, cov):
    return Keyframe(index, index, np.array(pose), np.array(cov), None, None, index)


def chain(steps):
    """Keyframes at the poses and with the covariances that the front end's state has."""
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.0, wheels=(*SHARES, 0.0, 0.0))
    keys = [keyframe(0, state.pose, state.pose_cov)]
    for k, step in enumerate(np.array(steps), 1):
        motion = Motion(step, NOISE, turn_gain=np.array([0.0, 0.5 * step[0], 1.0]) * step[2])
        state.predict(motion, 0.0, 1.0, step[[0, 2]])
        keys.append(keyframe(k, state.pose, state.pose_cov))
    return keys


def graph_of(keys):
    graph = Graph()
    for k in keys:
        graph.add_pose(k.T_local, fixed=k.index == 0)
    for a, b in pairwise(keys):
        delta = se2.between(a.T_local, b.T_local)
        graph.add_edge(
            EdgeKind.ODOMETRY, a.index, b.index, delta, relative_information(delta, NOISE)
        )
    return graph


def closure(graph, number, i, j, delta, cov):
    edge = graph.add_edge(EdgeKind.CLOSURE, i, j, delta, np.linalg.inv(cov))
    return Closure(i, j, np.array(delta), 0.8, edge, 'fits', number=number)


def test_way_driven_is_known_as_the_front_end_knows_it():
    way = PathCovariance()
    for key in chain(STEPS):
        assert_allclose(se2.rotate_cov(way.cov(key), key.T_local[2]), key.cov_local, atol=1e-15)


def test_other_end_of_a_closure_is_known_as_a_graph_of_the_closure_alone_knows_it():
    rng = np.random.default_rng(4)
    for _ in range(5):
        i = keyframe(0, rng.uniform(-3.0, 3.0, 3), 1e-3 * random_cov(rng))
        delta, cov = rng.uniform(-3.0, 3.0, 3), 1e-3 * random_cov(rng)
        j = keyframe(1, se2.compose(i.T_local, delta), 1e6 * np.eye(3))
        graph = Graph()
        graph.add_poses([i.T_local, j.T_local])
        graph.add_pose_prior(0, i.T_local, np.linalg.inv(i.cov_local))
        way = PathCovariance()
        way.add_closures(
            ClosureRecords([closure(graph, 0, 0, 1, delta, cov)]), [i, j], graph.edges
        )
        expected = Marginals(graph).poses([1])[0]
        assert_allclose(se2.rotate_cov(way.cov(j), j.T_local[2]), expected, rtol=1e-6, atol=1e-12)


def test_nothing_gets_less_sure_by_a_closure_and_what_was_driven_before_it_gets_surer():
    keys = chain(STEPS)
    graph, way, before = graph_of(keys), PathCovariance(), PathCovariance()
    way.add_closures(
        ClosureRecords([closure(graph, 0, 2, 28, [0.0, 0.0, np.pi], MATCH)]), keys, graph.edges
    )
    for key in keys:
        ratio = np.linalg.det(way.cov(key)) / max(np.linalg.det(before.cov(key)), 1e-300)
        assert ratio <= 1.0 + 1e-9 or key.index == 0
        if key.index in (20, 28, 30):
            assert ratio < 0.5


def test_closures_that_are_none_leave_nothing_behind():
    keys = chain(STEPS)
    graph, way = graph_of(keys), PathCovariance()
    closures = [closure(graph, n, 2 + n, 28 - n, [0.0, 0.0, np.pi], MATCH) for n in range(3)]
    way.add_closures(ClosureRecords(closures), keys, graph.edges)
    surer = way.cov(keys[-1])
    graph.edges.enabled[closures[0].edge] = False
    way.remove_closures()
    way.add_closures(ClosureRecords(closures), keys, graph.edges)
    assert np.linalg.det(way.cov(keys[-1])) > np.linalg.det(surer)
    for c in closures:
        graph.edges.enabled[c.edge] = False
    way.remove_closures()
    way.add_closures(ClosureRecords(closures), keys, graph.edges)
    assert_allclose(way.cov(keys[-1]), PathCovariance().cov(keys[-1]), atol=1e-15)


def test_place_found_anew_counts_for_what_comes_after_it_alone():
    keys = chain(STEPS)
    way, found = PathCovariance(), 1e-4 * np.eye(3)
    before = way.cov(keys[14])
    for key in keys[15:]:
        key.cov_local = found + key.cov_local - keys[15].cov_local
    way.start(keys[15])
    assert_allclose(way.cov(keys[14]), before, atol=1e-15)
    assert_allclose(way.cov(keys[15]), found, atol=1e-12)
    way.remove_closures()
    assert_allclose(way.cov(keys[15]), found, atol=1e-12)


def test_letting_go_of_keyframes_changes_nothing_for_those_that_stay():
    rng = np.random.default_rng(3)
    keys = chain(8 * STEPS)
    graph, way = graph_of(keys), PathCovariance()
    way.start(keys[40])
    pairs = [np.sort(rng.choice(len(keys), 2, replace=False)) for _ in range(150)]
    pairs.sort(key=lambda pair: pair[1])
    delta = [se2.between(keys[i].T_local, keys[j].T_local) for i, j in pairs]
    closures = [closure(graph, n, *pairs[n], delta[n], MATCH) for n in range(150)]
    way.add_closures(ClosureRecords(closures), keys, graph.edges)
    kept = [key for key in keys if key.index % 25 == 0]
    before = [way.cov(key) for key in kept]
    way.keep(kept)
    for key, cov in zip(kept, before, strict=True):
        np.testing.assert_array_equal(way.cov(key), cov)
    # two between each two that stay, and what began there
    assert len(way._numbers) <= 2 * len(kept) + 1
    way.remove_closures()
    again = PathCovariance()
    again.start(keys[40])
    for key in kept:
        np.testing.assert_array_equal(way.cov(key), again.cov(key))


def test_clock_that_was_set_back_between_two_drives_changes_nothing():
    results = []
    for set_back in (0, 1000):
        keys = chain(3 * STEPS)
        graph, way = graph_of(keys), PathCovariance()
        for key in keys[50:]:
            key.stamp -= set_back
        way.start(keys[50])
        delta = se2.between(keys[52].T_local, keys[78].T_local)
        closures = [closure(graph, 0, 52, 78, delta, MATCH)]
        way.add_closures(ClosureRecords(closures), keys, graph.edges)
        way.keep(keys[::2])
        results.append([way.cov(key) for key in keys])
    np.testing.assert_array_equal(*results)


def test_two_reflectors_hold_a_pose_to_those_that_saw_them_and_one_does_not():
    graph = Graph()
    for x in range(5):
        graph.add_pose([x, 0.0, 0.0])
    near, far = graph.add_landmark([1.0, 2.0]), graph.add_landmark([5.0, 2.0])
    for pose, landmark in ((0, near), (0, near), (1, near), (2, far), (3, near), (3, far)):
        graph.add_sighting(pose, landmark, [1.0, 2.0], np.eye(2))
    for landmark in (near, far):
        graph.add_sighting(4, landmark, [1.0, 2.0], np.eye(2))
    assert not is_constrained_by_reflectors(graph.sightings, 1, 0)
    assert not is_constrained_by_reflectors(graph.sightings, 3, 1)  # ``far`` is new since then
    assert is_constrained_by_reflectors(graph.sightings, 3, 2)
    assert is_constrained_by_reflectors(graph.sightings, 3, 3)
    graph.add_sighting(2, near, [1.0, 2.0], np.eye(2))
    assert not is_constrained_by_reflectors(graph.sightings, 2, 2)  # which saw ``far`` first
    assert is_constrained_by_reflectors(graph.sightings, 4, 3)
    graph.sightings.enabled[graph.sightings.nodes[:, 0] == 4] = False
    assert not is_constrained_by_reflectors(graph.sightings, 4, 3)


def test_intersection_is_no_surer_than_what_was_fused_whatever_the_two_have_in_common():
    rng = np.random.default_rng(9)
    for _ in range(50):
        both = random_cov(rng, 6)
        P, Q = both[:3, :3], both[3:, 3:]
        R = intersection(P, Q)
        A, B = np.linalg.inv(P), np.linalg.inv(Q)
        w = np.sum((np.linalg.inv(R) - B) * (A - B)) / np.sum((A - B) ** 2)
        G = np.concatenate([w * R @ A, (1.0 - w) * R @ B], axis=1)
        scale = np.linalg.eigvalsh(R)[-1]
        assert np.linalg.eigvalsh(R - G @ both @ G.T)[0] > -1e-9 * scale
        assert np.linalg.det(R) <= min(np.linalg.det(P), np.linalg.det(Q)) * (1.0 + 1e-9)
        assert_allclose(intersection(P, 4.0 * P), P, rtol=1e-6)


@pytest.mark.parametrize('honest', [True, False])
def test_wheels_that_err_for_long_are_in_the_covariance_after_a_loop(honest):
    """The graph alone is too sure of them; with the front end's way it is not, nor far from it."""
    rng, nees = np.random.default_rng(12), []
    runs, steps = 150, np.array(STEPS[:18])
    for _ in range(runs):
        speed, turn = rng.standard_normal(2) * SHARES
        poses = np.zeros((len(steps) + 1, 3))
        for k, step in enumerate(steps):
            share = [1.0 + speed, 1.0 + speed, 1.0 + turn]
            moved = share * step + np.sqrt(np.diag(NOISE)) * rng.standard_normal(3)
            poses[k + 1] = se2.compose(poses[k], moved)
        keys = chain(steps)
        graph, way = graph_of(keys), PathCovariance()
        # a short loop, which hardly constrains the scale errors
        true = se2.between(poses[12], poses[15])
        seen = se2.compose(true, np.sqrt(np.diag(MATCH)) * rng.standard_normal(3))
        found = closure(graph, 0, 12, 15, seen, MATCH)
        optimize(graph)
        cov = Marginals(graph).poses([len(steps)])[0]
        if honest:
            way.add_closures(ClosureRecords([found]), keys, graph.edges)
            cov = either(cov, se2.rotate_cov(way.cov(keys[-1]), graph.poses[-1, 2]))
        e = graph.poses[-1] - poses[-1]
        e[2] = se2.wrap(e[2])
        nees.append(e @ np.linalg.solve(cov, e))
    # two-sided 99.9 % of the mean of so many independent runs
    low, high = chi2.ppf([0.0005, 0.9995], 3 * runs) / runs
    if honest:
        assert 0.5 * low < np.mean(nees) < high
    else:
        assert np.mean(nees) > 2.0 * high
