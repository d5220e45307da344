# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from differences import central_differences
from made_rooms import CORRIDOR, ROOM, built, moved, path, scan

from rlml_slam import params, se2
from rlml_slam.matching.scans import scan_match
from rlml_slam.matching.scans.scan_match import linearize, match
from rlml_slam.matching.scans.submap import P_MAX, Submap
from rlml_slam.matching.scans.voxel_filter import thin

P = params.ScanMatch()
WEAK = np.diag([1.0, 1.0, 1.0])
ODOMETRY = np.diag([0.02, 0.02, 0.01]) ** 2
START = np.array([0.12, -0.08, 0.2])


@pytest.fixture(scope='module')
def room() -> Submap:
    return built(ROOM, path(), sigma=0.01)


def test_interpolation_is_twice_continuously_differentiable(room):
    i, j = np.argwhere(room.probability() > 0.6)[7]
    for edge in ((j + 0.5, i + 0.2), (j + 0.2, i + 0.5)):
        near = [
            scan_match.sample_curved(room.values, edge[0] + s, edge[1] + s) for s in (-1e-9, 1e-9)
        ]
        np.testing.assert_allclose(near[0], near[1], atol=1e-7)


def test_slope_and_curvature_are_the_derivatives_of_the_interpolation(room):
    rng = np.random.default_rng(0)
    cells = np.argwhere(room.probability() > 0.5)
    for i, j in cells[rng.integers(len(cells), size=30)]:
        at = np.array([j, i]) + rng.uniform(-1.5, 1.5, 2)

        def value(x):
            return np.array(scan_match.sample_curved(room.values, x[0], x[1])[:3])

        d = central_differences(value, at)
        _, m_u, m_v, m_uu, m_uv, m_vv = scan_match.sample_curved(room.values, at[0], at[1])
        # truncation: step^2 times third derivatives of order 1
        np.testing.assert_allclose(d[0], [m_u, m_v], atol=1e-8)
        np.testing.assert_allclose(d[1:], [[m_uu, m_uv], [m_uv, m_vv]], atol=1e-7)


def test_gradient_is_the_derivative_of_the_cost(room):
    # points of clutter have no constraint, so that the gradient is that of the cost itself
    rng = np.random.default_rng(1)
    points = scan(ROOM, START, 120)
    points = points[rng.permutation(len(points))] + rng.normal(size=points.shape) * 0.02
    held = np.zeros((len(points), 3))
    held[:, [0, 2]] = 1.0

    def cost(pose):
        out = np.empty(12)
        scan_match.accumulate(room.grid, points, held, pose, out)
        return out

    for pose in (
        START,
        START + np.array([0.03, -0.02, 0.01]),
        START + np.array([0.0, 0.0, np.pi]),
    ):
        d = central_differences(lambda x: cost(x)[:1], np.asarray(pose))
        np.testing.assert_allclose(d[0], cost(np.asarray(pose))[1:4], rtol=1e-6, atol=1e-5)


def test_gradient_of_a_surface_point_has_no_part_along_the_surface(room):
    points = scan(ROOM, START, 720)
    wall = points[np.abs(se2.transform(START, points)[:, 1] + 2.2) < 1e-6][20:-20]
    term = linearize(room, wall, START + np.array([0.0, 0.02, 0.0]))
    assert abs(term.gradient[1]) > 1.0
    assert abs(term.gradient[0]) < 1e-9 * abs(term.gradient[1])
    assert term.hessian[0, 0] < 1e-12 * term.hessian[1, 1]


def test_hessian_is_symmetric_and_positive_semidefinite(room):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        pose = START + rng.normal(size=3) * [0.2, 0.2, 0.3]
        term = linearize(room, rng.normal(size=(60, 2)) * 3.0, pose)
        np.testing.assert_array_equal(term.hessian, term.hessian.T)
        assert np.linalg.eigvalsh(term.hessian)[0] >= -1e-9 * np.trace(term.hessian)


def test_score_and_inliers_tell_a_good_pose_from_a_bad_one(room):
    points = scan(ROOM, START, 360)
    good, bad = (
        linearize(room, points, START),
        linearize(room, points, START + np.array([0.5, 0.3, 0.4])),
    )
    assert 0.55 < good.score < P_MAX
    # half a metre and 23 deg off, some end points still meet some wall
    assert bad.score < 0.3
    assert good.inliers > 0.9 * good.count == 0.9 * len(points)
    assert bad.inliers < 0.3 * bad.count
    assert good.cost < bad.cost


def test_noiseless_room_gives_the_pose_back():
    # turned so that walls and cells are not aligned; a wall that lies on a cell's border all
    # along is known to half a cell only
    world = moved(np.array([0.3, -0.2, 0.35]), ROOM)
    poses = se2.compose(np.array([0.3, -0.2, 0.35]), path(12))
    submap = built(world, poses)
    for offset in ([0.0, 0.0, 0.0], [0.05, -0.04, 0.02], [-0.06, 0.05, -0.15]):
        true = se2.compose(poses[5], [0.07, 0.04, 0.1])
        found = match(submap, scan(world, true), se2.compose(true, offset), WEAK)
        error = se2.between(true, found.pose)
        assert found.converged
        # a tenth of a cell; the angle over half the room's size of 3 m
        assert np.hypot(error[0], error[1]) < 0.005
        assert abs(error[2]) < 0.002


def test_match_does_not_depend_on_where_the_world_is(room):
    # whole cells: the same numbers; elsewhere the cells fall differently
    for shift in ([2.0, -3.0, 0.0], [150.0, 75.0, 0.0]):
        T = np.array(shift)
        submap = built(moved(T, ROOM), se2.compose(T, path()), sigma=0.01)
        points = scan(ROOM, START, sigma=0.01, seed=77)
        prior = se2.compose(START, [0.03, 0.02, -0.02])
        here = match(room, points, prior, WEAK)
        there = match(submap, points, se2.compose(T, prior), WEAK)
        np.testing.assert_allclose(se2.between(T, there.pose), here.pose, atol=2e-6)
        assert there.score == pytest.approx(here.score, abs=1e-6)


@pytest.mark.parametrize('turn', [0.4, 1.3, 3.0])
def test_turning_the_world_turns_the_match(room, turn):
    T = np.array([1.234, -0.577, turn])
    submap = built(moved(T, ROOM), se2.compose(T, path()), sigma=0.01)
    points = scan(ROOM, START, sigma=0.01, seed=77)
    here = match(room, points, START, WEAK)
    there = match(submap, points, se2.compose(T, START), WEAK)
    # two grids of 5 cm cells over walls with 1 cm of noise agree to a fraction of a cell
    error = se2.between(se2.compose(T, here.pose), there.pose)
    assert np.hypot(error[0], error[1]) < 0.008
    assert abs(error[2]) < 0.003


def test_search_finds_what_refinement_alone_does_not(room):
    points = scan(ROOM, START, 360, sigma=0.01)
    prior = se2.compose(START, [0.45, -0.35, 0.3])
    p = dataclasses.replace(P, search_window=0.5, wide_search_threshold=0.0)
    odometry = np.linalg.inv(ODOMETRY)
    alone = match(room, points, prior, odometry, p, searched=False)
    searched = match(room, points, prior, odometry, p)
    assert np.abs(se2.between(START, searched.pose)).max() < 0.01
    assert np.abs(se2.between(START, alone.pose)).max() > 0.1
    assert searched.score > alone.score


def test_poor_fit_is_searched_wider(room):
    points = scan(ROOM, START, 360, sigma=0.01)
    prior = se2.compose(START, [0.45, -0.35, 0.3])
    found = match(room, points, prior, np.linalg.inv(ODOMETRY))
    assert np.abs(se2.between(START, found.pose)).max() < 0.01
    narrow = dataclasses.replace(P, wide_search_threshold=0.0)
    lost = match(room, points, prior, np.linalg.inv(ODOMETRY), narrow)
    assert np.abs(se2.between(START, lost.pose)).max() > 0.1


def test_odometry_that_is_plainly_wrong_loses(room):
    points = scan(ROOM, START, 360, sigma=0.01)
    wrong = se2.compose(START, [0.07, 0.0, 0.2])
    tight = np.linalg.inv(np.diag([0.005, 0.005, 0.005]) ** 2)
    found = match(room, points, wrong, tight)
    assert found.prior_weight < 0.01
    assert np.abs(se2.between(START, found.pose)).max() < 0.01


def test_component_of_odometry_that_is_right_stays_where_another_loses():
    T = np.array([0.0, 0.0, 0.37])
    world = moved(T, CORRIDOR)
    poses = np.stack([np.linspace(0, 2, 9), np.zeros(9), np.zeros(9)], -1)
    submap = built(world, se2.compose(T, poses), sigma=0.01)
    true = se2.compose(T, [1.1, 0.05, 0.0])
    # the heading is wrong by 20 sigma; only odometry constrains the position along the corridor
    prior = se2.compose(true, [0.02, 0.0, 0.2])
    tight = np.linalg.inv(np.diag([0.01, 0.01, 0.01]) ** 2)
    found = match(submap, scan(world, true, 360, sigma=0.01), prior, tight)
    error = se2.between(true, found.pose)
    assert abs(error[2]) < 0.003
    assert abs(error[1]) < 0.01
    assert error[0] == pytest.approx(0.02, abs=0.005)


@pytest.mark.parametrize('beams', [180, 1440])
def test_corridor_has_no_information_along_itself(beams):
    turn = np.array([0.0, 0.0, 0.37])
    world = moved(turn, CORRIDOR)
    poses = se2.compose(turn, np.stack([np.linspace(0, 3, 30)] + [np.zeros(30)] * 2, -1))
    submap = built(world, poses, sigma=0.01, beams=beams)
    true = se2.compose(turn, [1.53, 0.1, 0.03])
    p = params.ScanMatch()
    points = thin(scan(world, true, beams, sigma=0.01, seed=99), p.voxel_size, p.max_points)
    prior = se2.compose(true, [0.08, 0.0, 0.0])
    found = match(submap, points, prior, np.linalg.inv(np.diag([0.05, 0.05, 0.02]) ** 2))
    # the odometry's 8 cm along the corridor are left alone, across it is held to millimetres
    error = se2.between(true, found.pose)
    assert error[0] == pytest.approx(0.08, abs=0.01)
    assert abs(error[1]) < 0.01
    J = se2.rotation(turn[2])
    along = (J.T @ np.linalg.inv(found.information)[:2, :2] @ J)[0, 0]
    across = (J.T @ np.linalg.inv(found.information)[:2, :2] @ J)[1, 1]
    assert along > 50.0 * across


def test_match_of_nothing_is_the_prior_without_information(room):
    prior = np.array([0.1, 0.2, 0.3])
    for submap, points in ((room, np.zeros((0, 2))), (Submap(), np.ones((5, 2)))):
        found = match(submap, points, prior, WEAK)
        np.testing.assert_array_equal(found.pose, prior)
        assert found.score == 0.0
        assert not found.information.any()
        assert not found.converged
    term = linearize(room, np.zeros((0, 2)), prior)
    assert (term.cost, term.score, term.inliers, term.count) == (0.0, 0.0, 0, 0)


def test_two_matches_are_the_same_to_the_last_bit(room):
    points = scan(ROOM, START, 360, sigma=0.01)
    a, b = (match(room, points, START + np.array([0.05, 0.0, 0.1]), WEAK) for _ in range(2))
    assert a.pose.tobytes() == b.pose.tobytes()
    assert a.information.tobytes() == b.information.tobytes()


def test_whitening_is_a_root_of_the_information():
    A = np.random.default_rng(5).normal(size=(3, 3))
    information = A @ A.T
    W = scan_match.whitening_of(information, 0.7)
    np.testing.assert_allclose(W.T @ W, information, rtol=1e-12)


def test_negative_part_of_a_curvature():
    rng = np.random.default_rng(2)
    for a, b, d in rng.normal(size=(50, 3)):
        n_a, n_b, n_d = scan_match.downward(a, b, d)
        values, axes = np.linalg.eigh([[a, b], [b, d]])
        expected = (axes * np.maximum(-values, 0.0)) @ axes.T
        np.testing.assert_allclose([[n_a, n_b], [n_b, n_d]], expected, atol=1e-12)
    assert scan_match.downward(0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
