# SPDX-License-Identifier: Apache-2.0
"""Range-only factor: a beacon's distance from a pose, in every solver and in the file."""

from __future__ import annotations

import numpy as np
import pytest
from differences import central_differences
from made_graphs import METHODS, range_graph
from normal_equations import normal_equations, unknowns
from scipy import optimize as scipy_optimize
from scipy import stats

from rlml_slam import params, se2
from rlml_slam.errors import FileFormatError, SolverError
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.batch.landmark_start import locate_beacon, trilaterate
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.g2o import read_graph, write_graph
from rlml_slam.graph.incremental.incremental_solver import IncrementalSolver, Thresholds
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.factors import FactorKind, Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.types import EdgeKind

TIGHT = params.Solver(relative_tolerance=1e-14, max_iterations=200)


@pytest.mark.parametrize('theta', [0.0, 1e-9, np.pi, -2.9, 1.3])
def test_jacobians_match_central_differences(theta):
    rng = np.random.default_rng(1)
    X, m, r = np.array([*rng.uniform(-3, 3, 2), theta]), rng.uniform(-3, 3, 2), 1.7
    e, J_X, J_m = factors.range_only(X, m, r)
    assert e == pytest.approx(np.linalg.norm(m - X[:2]) - r, abs=1e-15)
    D_X = central_differences(lambda x: factors.range_only(x, m, r)[0], X)
    D_m = central_differences(lambda x: factors.range_only(X, x, r)[0], m)
    # 1e-8: rounding of the differences at step 1e-6 with values near 3
    np.testing.assert_allclose(J_X, D_X, atol=1e-8)
    np.testing.assert_allclose(J_m, D_m, atol=1e-8)


def test_zero_distance_has_a_unit_gradient_and_is_left():
    e, J_X, J_m = factors.range_only([1.0, 2.0, 0.3], [1.0, 2.0], 0.5)
    np.testing.assert_array_equal(e, [-0.5])
    np.testing.assert_array_equal(J_m, [[1.0, 0.0]])
    np.testing.assert_array_equal(J_X, [[-1.0, 0.0, 0.0]])
    graph, _, points = range_graph(noise=0.0)
    graph.landmarks[:] = graph.poses[3:5, :2]
    optimize(graph, params.Solver(initialization='none'))
    assert np.isfinite(graph.landmarks).all()
    graph.landmarks[:] = graph.poses[3:5, :2]
    optimize(graph)
    np.testing.assert_allclose(graph.landmarks, points, atol=1e-5)


def test_normal_equations_are_those_of_the_batched_factors():
    from rlml_slam.graph.model.linearization import linearize
    from rlml_slam.graph.model.normal_equations import build_system

    losses = Losses(range=Loss(LossKind.CAUCHY, 1.0))
    graph, _, _ = range_graph(seed=2, start_noise=1.0, losses=losses)
    system = build_system(graph)
    cost, chi2 = linearize(system, graph.poses, graph.landmarks, False)
    columns = unknowns(graph)
    expected = normal_equations(graph, columns)
    assert (cost, chi2) == (pytest.approx(expected.cost), pytest.approx(expected.chi2))
    v = system.variables
    starts = np.concatenate([columns.poses, columns.landmarks])[v['node']]
    for start, k, size in zip(starts, v['scalar'], v['size'], strict=True):
        np.testing.assert_allclose(system.g[k : k + size], expected.g[start : start + size])


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('seed', range(4))
def test_optimum_is_that_of_scipy_least_squares(seed, method):
    """An independent oracle: its residuals are written with hypot and arctan2 here."""
    graph, _, _ = range_graph(seed=seed, start_noise=1.0)
    e, s = graph.edges, graph.sightings
    L = np.linalg.cholesky(e.information)

    def residuals(x):
        poses = np.vstack([graph.poses[:1], x[: 3 * (len(graph.poses) - 1)].reshape(-1, 3)])
        beacons = x[3 * (len(graph.poses) - 1) :].reshape(-1, 2)
        (i, j), (a, k) = e.nodes.T, s.nodes.T
        d = poses[j] - poses[i]
        angle = poses[i, 2] + e.measured[:, 2]
        # in the axes of the measured second pose, as relative_pose has them
        rows = [np.cos(angle) * d[:, 0] + np.sin(angle) * d[:, 1],
                -np.sin(angle) * d[:, 0] + np.cos(angle) * d[:, 1]]  # fmt: skip
        c, q = np.cos(e.measured[:, 2]), np.sin(e.measured[:, 2])
        rows[0] -= c * e.measured[:, 0] + q * e.measured[:, 1]
        rows[1] -= c * e.measured[:, 1] - q * e.measured[:, 0]
        turn = d[:, 2] - e.measured[:, 2]
        rows.append(np.arctan2(np.sin(turn), np.cos(turn)))
        between = (np.swapaxes(L, 1, 2) @ np.stack(rows, -1)[..., None])[..., 0].ravel()
        r = np.hypot(*(beacons[k] - poses[a, :2]).T) - s.measured[:, 0]
        return np.concatenate([between, r * np.sqrt(s.information[:, 0, 0])])

    x0 = np.concatenate([graph.poses[1:].ravel(), graph.landmarks.ravel()])
    found = scipy_optimize.least_squares(residuals, x0, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    limits = params.Solver(relative_tolerance=1e-14, max_iterations=200, initialization='none')
    chi2 = method(graph, limits)
    assert chi2 == pytest.approx(2.0 * found.cost, rel=1e-9)
    assert graph.chi2() == pytest.approx(chi2, rel=1e-9)
    n = 3 * (len(graph.poses) - 1)
    # 1e-5: what is left of the gradient at the oracle's own stop
    np.testing.assert_allclose(graph.landmarks.ravel(), found.x[n:], atol=1e-5)


def test_noiseless_beacons_are_found_from_the_factors_alone():
    for method in ('spanning_tree', 'odometry', 'chordal'):
        graph, truth, points = range_graph(noise=0.0)
        graph.landmarks[:] = 0.0
        graph.poses[1:] = np.random.default_rng(0).uniform(-50, 50, (len(truth) - 1, 3))
        initialize(graph, method)
        # the relaxation holds beacons to their poses, with a share of 1e-6
        np.testing.assert_allclose(graph.poses[:, :2], truth[:, :2], atol=1e-3)
        np.testing.assert_allclose(graph.landmarks, points, atol=1e-2)
    optimize(graph, TIGHT)
    np.testing.assert_allclose(graph.landmarks, points, atol=1e-7)


def test_beacon_heard_from_a_line_has_two_hypotheses_until_the_robot_turns():
    graph = Graph()
    graph.add_poses([[k, 0.0, 0.0] for k in range(5)])
    beacon = graph.add_landmark([0.0, 0.0])
    assert locate_beacon(graph, beacon) is None
    at = np.array([1.5, 3.0])

    def hear(i):
        r = np.hypot(*(at - graph.poses[i, :2]))
        row = graph.add_range(i, beacon, r, 1e2)
        graph.sightings.enabled[row] = False

    for i in range(5):
        hear(i)
    found = locate_beacon(graph, beacon)
    assert found.cost == pytest.approx(found.other_cost, abs=1e-6)
    both = sorted([found.position.tolist(), found.other.tolist()])
    np.testing.assert_allclose(both, [[1.5, -3.0], [1.5, 3.0]], atol=1e-4)
    hear(graph.add_pose([5.0, 2.0, 1.5]))
    found = locate_beacon(graph, beacon)
    np.testing.assert_allclose(found.position, at, atol=1e-6)
    assert found.other_cost > 10.0


def test_trilateration_takes_noise_and_degenerate_geometry():
    rng = np.random.default_rng(3)
    for _ in range(50):
        points, at = rng.uniform(-5, 5, (6, 2)), rng.uniform(-5, 5, 2)
        r = np.hypot(*(points - at).T) + 0.02 * rng.standard_normal(6)
        found = trilaterate(points, r, np.full(6, 0.02**-2))
        # 0.5 m: noise of 0.02 m where the poses are nearly in a line
        assert min(np.hypot(*(found.position - at)), np.hypot(*(found.other - at))) < 0.5
    for points in (np.zeros((1, 2)), np.zeros((4, 2))):  # one pose only: on the circle
        found = trilaterate(points, np.full(len(points), 2.0), np.ones(len(points)))
        assert np.hypot(*found.position) == pytest.approx(2.0)


def test_normalised_error_is_chi2_distributed():
    runs = 150
    of_pose, of_beacon = [], []
    for seed in range(runs):
        graph, truth, points = range_graph(seed=seed)
        optimize(graph)
        marginals = Marginals(graph)
        e = graph.poses[-1] - truth[-1]
        e[2] = se2.wrap(e[2])
        of_pose.append(e @ np.linalg.solve(marginals.poses([len(truth) - 1])[0], e))
        e = graph.landmarks[0] - points[0]
        of_beacon.append(e @ np.linalg.solve(marginals.landmarks([0])[0], e))
    # two-sided 99.9 % interval of the mean of ``runs`` chi2 variables with 3, 2 degrees of freedom
    for nees, dof in ((of_pose, 3), (of_beacon, 2)):
        low, high = stats.chi2.ppf([0.0005, 0.9995], dof * runs) / runs
        assert low < np.mean(nees) < high


@pytest.mark.parametrize('kind', [LossKind.NONE, LossKind.HUBER])
def test_incremental_solver_follows_the_batch_optimum(kind):
    losses = Losses(range=Loss(kind, 1.5))
    source, _, _ = range_graph(seed=5, poses=60, losses=losses)
    graph = Graph(losses)
    solver = IncrementalSolver(graph)
    for k in range(len(source.landmarks)):
        graph.add_landmark(source.landmarks[k])
    for i in range(len(source.poses)):
        graph.add_pose(source.poses[i], bool(source.fixed_poses[i]))
        e, s = source.edges, source.sightings
        for row in np.flatnonzero(e.nodes.max(axis=1) == i):
            graph.add_edge(EdgeKind.ODOMETRY, *e.nodes[row], e.measured[row], e.information[row])
        for row in np.flatnonzero(s.nodes[:, 0] == i):
            graph.add_range(*s.nodes[row], s.measured[row, 0], s.information[row, 0, 0])
        if i >= 10:  # from there on three ranges determine every beacon
            solver.update()
    for _ in range(20):
        if solver.settled:
            break
        solver.update()
    before, chi2, cov = graph.poses.copy(), graph.chi2(), solver.joint([59], [0])
    best = optimize(graph, TIGHT)
    if kind == LossKind.NONE:
        assert chi2 == pytest.approx(best.chi2_final, rel=1e-3)
    marginals = Marginals(graph)
    sigmas = np.sqrt(np.diagonal(marginals.poses(np.arange(1, 60)), axis1=1, axis2=2))
    # thresholds of 0.05 sigma per factor leave a tenth of a sigma at most
    off = np.abs(before - graph.poses)[1:]
    assert (off / sigmas).max() < 0.1
    np.testing.assert_allclose(cov, marginals.joint([59], [0]), atol=0.05 * np.abs(cov).max())


def test_a_beacon_that_moves_has_its_ranges_relinearized():
    """Where poses are fixed, a beacon alone turns the directions of its ranges."""
    graph = Graph()
    graph.add_poses([[0, 0, 0], [4, 0, 0], [0, 4, 0]], fixed=True)
    graph.add_landmark([1.0, 1.5])
    at = np.array([3.0, 3.5])
    for i in range(3):
        graph.add_range(i, 0, np.hypot(*(at - graph.poses[i, :2])), 1e4)
    solver = IncrementalSolver(graph, Thresholds(linear=1e-6, turn=1e-6, wildfire=0.0))
    for _ in range(10):
        solver.update()
    np.testing.assert_allclose(graph.landmarks[0], at, atol=1e-6)


def test_file_reads_back_to_the_same_bits(tmp_path):
    graph, _, _ = range_graph(seed=1)
    graph.add_sighting(3, 0, [1.0, 2.0], np.eye(2))
    write_graph(tmp_path / 'a.g2o', graph)
    back = read_graph(tmp_path / 'a.g2o').graph
    s, t = graph.sightings, back.sightings
    np.testing.assert_array_equal(np.sort(s.kinds), np.sort(t.kinds))
    ranges = [table.kinds == FactorKind.RANGE for table in (s, t)]
    np.testing.assert_array_equal(s.nodes[ranges[0]], t.nodes[ranges[1]])
    np.testing.assert_array_equal(s.measured[ranges[0]], t.measured[ranges[1]])
    np.testing.assert_array_equal(s.information[ranges[0]], t.information[ranges[1]])
    assert back.chi2() == pytest.approx(graph.chi2(), rel=1e-12)


@pytest.mark.parametrize(
    ('line', 'match'),
    [
        ('EDGE_RANGE_SE2_XY 0 1 -2 4', ':3: the range is negative'),
        ('EDGE_RANGE_SE2_XY 0 1 2 -4', ':3: information is not positive definite'),
        ('EDGE_RANGE_SE2_XY 0 7 2 4', ':3: unknown vertex 7'),
        ('EDGE_RANGE_SE2_XY 0 1 2', ':3: EDGE_RANGE_SE2_XY has 3 values instead of 4'),
    ],
)
def test_malformed_line_is_refused(tmp_path, line, match):
    path = tmp_path / 'a.g2o'
    path.write_text(f'VERTEX_SE2 0 0 0 0\nVERTEX_XY 1 2 0\n{line}\n')
    with pytest.raises(FileFormatError, match=match):
        read_graph(path)


@pytest.mark.parametrize(
    ('distance', 'information', 'match'),
    [(-1.0, 1.0, 'negative'), (1.0, 0.0, r'range, pose 0 to landmark 0.*positive definite'),
     (np.nan, 1.0, 'not finite'), (1.0, np.inf, 'positive definite')],
)  # fmt: skip
def test_bad_range_is_refused_by_name(distance, information, match):
    graph = Graph()
    graph.add_pose([0, 0, 0])
    graph.add_landmark([1, 1])
    with pytest.raises(SolverError, match=match):
        graph.add_range(0, 0, distance, information)
    assert len(graph.sightings) == 0
