# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from made_graphs import METHODS, loop_graph, shared_graph
from scipy import stats

from rlml_lab.bench.generated_graphs import city
from rlml_slam import params, se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.second_start import restart
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.g2o import read_graph
from rlml_slam.graph.model.factors import Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.normal_equations import build_system
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.types import EdgeKind

TIGHT = params.Solver(relative_tolerance=1e-12, initialization='none')


def test_hand_solved_graph():
    # x_1 is pulled to 1 (information 1) and to 1.4 (information 3): 1.3, chi2 = 0.09 + 0.03
    graph = Graph()
    graph.add_pose([0, 0, 0], fixed=True)
    graph.add_pose([0.2, 0.1, 0.3])
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [1.0, 0, 0], np.eye(3))
    graph.add_edge(EdgeKind.SCAN, 0, 1, [1.4, 0, 0], 3 * np.eye(3))
    solution = optimize(graph, TIGHT)
    np.testing.assert_allclose(graph.poses[1], [1.3, 0, 0], atol=1e-12)
    assert solution.chi2_final == pytest.approx(0.12, abs=1e-12)
    assert solution.chi2_initial == pytest.approx(0.8**2 + 0.1**2 + 0.09 + 3 * (1.2**2 + 0.1))
    assert solution.converged


def test_hand_solved_survey():
    # a landmark between a prior at (1, 0) and a fixed pose that sees it at (2, 0): midway
    graph = Graph()
    graph.add_pose([0, 0, 0], fixed=True)
    graph.add_landmark([5, 5])
    graph.add_landmark_prior(0, [1, 0], np.eye(2))
    graph.add_sighting(0, 0, [2, 0], np.eye(2))
    optimize(graph, TIGHT)
    np.testing.assert_allclose(graph.landmarks[0], [1.5, 0], atol=1e-12)


@pytest.mark.parametrize('method', METHODS)
def test_noiseless_measurements_give_zero_error(method):
    graph, truth, points = loop_graph(noise=0.0, start_noise=1.0)
    chi2 = method(graph, params.Solver(relative_tolerance=1e-12))
    # 1e-9 m: the last step's quadratic convergence, far above rounding
    np.testing.assert_allclose(graph.poses, truth, atol=1e-9)
    np.testing.assert_allclose(graph.landmarks, points, atol=1e-9)
    assert chi2 < 1e-12


@pytest.mark.parametrize('method', METHODS)
def test_gradient_vanishes_at_the_solution(method):
    graph, _, _ = loop_graph(seed=3, start_noise=1.0)
    chi2 = method(graph, params.Solver(relative_tolerance=1e-12))
    rng = np.random.default_rng(0)
    poses = graph.poses.copy()
    for _ in range(20):
        direction = rng.standard_normal(poses.shape)
        direction[0] = 0.0
        graph.poses[:] = poses + 1e-5 * direction
        assert graph.chi2() > chi2
    graph.poses[:] = poses


def test_moving_the_world_moves_the_solution_and_keeps_chi2():
    graph, _, _ = loop_graph(seed=1, start_noise=1.0)
    moved, _, _ = loop_graph(seed=1, start_noise=1.0)
    T = np.array([30.0, -7.0, 2.5])
    moved.poses[:] = se2.compose(T, moved.poses)
    moved.landmarks[:] = se2.transform(T, moved.landmarks)
    one, two = optimize(graph, TIGHT), optimize(moved, TIGHT)
    assert two.chi2_final == pytest.approx(one.chi2_final, rel=1e-9)
    # 1e-8 m: the stop of the last iteration
    np.testing.assert_allclose(se2.compose(T, graph.poses)[:, :2], moved.poses[:, :2], atol=1e-8)
    np.testing.assert_allclose(se2.transform(T, graph.landmarks), moved.landmarks, atol=1e-8)


def test_order_of_factors_does_not_matter():
    graph, _, _ = loop_graph(seed=2, start_noise=1.0)
    other = Graph()
    other.add_poses(graph.poses)
    other.add_landmarks(graph.landmarks)
    other.fixed_poses[0] = True
    for k in np.random.default_rng(0).permutation(len(graph.edges)):
        e = graph.edges
        other.add_edges(EdgeKind.SCAN, e.nodes[k], e.measured[k], e.information[k])
    for k in reversed(range(len(graph.sightings))):
        s = graph.sightings
        other.add_sightings(s.nodes[k], s.measured[k], s.information[k])
    optimize(graph, TIGHT)
    optimize(other, TIGHT)
    np.testing.assert_allclose(other.poses, graph.poses, atol=1e-9)


def test_same_graph_gives_the_same_bits():
    one, two = loop_graph(seed=4, start_noise=1.0)[0], loop_graph(seed=4, start_noise=1.0)[0]
    a, b = optimize(one), optimize(two)
    assert one.poses.tobytes() == two.poses.tobytes()
    assert one.landmarks.tobytes() == two.landmarks.tobytes()
    assert (a.chi2_final, a.iterations) == (b.chi2_final, b.iterations)


def test_surveyed_landmarks_are_a_gauge():
    graph, truth, points = loop_graph(noise=0.0, start_noise=1.0)
    graph.fixed_poses[0] = False
    graph.landmarks[:2] = points[:2]
    graph.fixed_landmarks[:2] = True
    optimize(graph, TIGHT)
    np.testing.assert_allclose(graph.poses, truth, atol=1e-8)


def test_nodes_that_nothing_touches_stay():
    graph, _, _ = loop_graph(start_noise=1.0)
    i, k = graph.add_pose([9, 9, 1]), graph.add_landmark([7, 7])
    optimize(graph)
    np.testing.assert_array_equal(graph.poses[i], [9, 9, 1])
    np.testing.assert_array_equal(graph.landmarks[k], [7, 7])


def test_empty_graph_and_graph_of_fixed_nodes_are_solved():
    assert optimize(Graph()).converged
    graph = Graph()
    graph.add_poses([[0, 0, 0], [1, 0, 0]], fixed=True)
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [2, 0, 0], np.eye(3))
    assert optimize(graph).chi2_final == pytest.approx(1.0)


def test_part_without_gauge_is_refused_by_name():
    graph, _, _ = loop_graph()
    i = graph.add_poses([[0, 0, 0], [1, 0, 0]])[0]
    graph.add_edge(EdgeKind.ODOMETRY, i, i + 1, [1, 0, 0], np.eye(3))
    with pytest.raises(SolverError, match=f'pose {i} and what is connected'):
        optimize(graph)


def test_disabling_the_only_tie_is_refused():
    graph = Graph()
    graph.add_poses(np.zeros((3, 3)))
    graph.fixed_poses[0] = True
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [1, 0, 0], np.eye(3))
    graph.add_edge(EdgeKind.ODOMETRY, 1, 2, [1, 0, 0], np.eye(3))
    graph.edges.enabled[0] = False
    with pytest.raises(SolverError, match='pose 1 and what'):
        optimize(graph)


def two_rooms(*known: int) -> Graph:
    """Two pairs of poses that share landmark 1 and no more; each sees one of its own, 0 or 2."""
    graph = Graph()
    graph.add_poses([[0, 0, 0], [1, 0, 0], [4, 0, 0], [5, 0, 0]])
    graph.add_landmarks([[0, 1], [2.5, 1], [5, 1]])
    graph.add_edges(EdgeKind.ODOMETRY, [[0, 1], [2, 3]], [[1, 0, 0]] * 2, [np.eye(3)] * 2)
    nodes = [[0, 0], [1, 0], [0, 1], [1, 1], [2, 1], [3, 1], [2, 2], [3, 2]]
    z = [graph.landmarks[k] - graph.poses[i, :2] for i, k in nodes]
    graph.add_sightings(nodes, z, [np.eye(2)] * 8)
    graph.fixed_landmarks[list(known)] = True
    return graph


def test_a_part_that_turns_about_one_known_landmark_is_named():
    with pytest.raises(SolverError, match='pose 0 and what is connected'):
        optimize(two_rooms(1))
    with pytest.raises(SolverError, match='pose 2 and what is connected'):
        optimize(two_rooms(0, 1))  # the other room cannot turn, but shares with this one a point
    for known in ((0, 1, 2), (0, 2)):
        assert optimize(two_rooms(*known)).converged


def test_two_priors_on_one_landmark_tie_no_more_than_one():
    graph = two_rooms(0, 1)
    for _ in range(2):
        graph.add_landmark_prior(2, [5, 1], np.eye(2))
    assert optimize(graph).converged
    graph.fixed_landmarks[1] = False
    graph.sightings.enabled[4:6] = False
    graph.add_pose_prior(0, [0, 0, 0], np.eye(3))
    with pytest.raises(SolverError, match='pose 2 and what is connected'):
        optimize(graph)


def test_estimate_that_is_not_finite_is_refused_by_name():
    graph, _, _ = loop_graph()
    graph.poses[4, 1] = np.nan
    with pytest.raises(SolverError, match=r'pose 4: .*not finite'):
        optimize(graph)


def test_revoked_closure_has_no_effect():
    graph, _, _ = loop_graph(seed=5, start_noise=1.0)
    clean, _, _ = loop_graph(seed=5, start_noise=1.0)
    k = graph.add_edge(EdgeKind.CLOSURE, 2, 20, [9, 9, 1], np.eye(3) * 100)
    graph.edges.enabled[k] = False
    optimize(graph, TIGHT)
    optimize(clean, TIGHT)
    np.testing.assert_allclose(graph.poses, clean.poses, atol=1e-9)


@pytest.mark.parametrize('kind', [LossKind.CAUCHY, LossKind.DCS, LossKind.GEMAN_MCCLURE])
def test_robust_loss_ignores_a_wrong_closure(kind):
    losses = Losses(closure=Loss(kind, 2.0))
    graph, _, _ = loop_graph(seed=5, losses=losses)
    clean, _, _ = loop_graph(seed=5, losses=losses)
    graph.add_edge(EdgeKind.CLOSURE, 2, 20, [9, 9, 1], np.eye(3) * 1e4)
    solution = optimize(graph)
    optimize(clean)
    # the outlier's remaining pull is below the noise of 0.05 m per edge
    np.testing.assert_allclose(graph.poses[:, :2], clean.poses[:, :2], atol=0.02)
    assert solution.cost_final < solution.chi2_final


def test_normalised_error_is_chi2_distributed():
    runs, poses = 150, 12
    nees = []
    for seed in range(runs):
        graph, truth, _ = loop_graph(seed=seed, poses=poses, landmarks=4)
        optimize(graph)
        cov = Marginals(graph).poses([poses - 1])[0]
        e = graph.poses[-1] - truth[-1]
        e[2] = se2.wrap(e[2])
        nees.append(e @ np.linalg.solve(cov, e))
    # two-sided 99.9 % interval of the mean of ``runs`` chi2 variables with 3 degrees of freedom
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * runs) / runs
    assert low < np.mean(nees) < high


@pytest.mark.parametrize(
    ('name', 'optimum'),
    [
        ('m3500/input_M3500_g2o.g2o', 137.91),
        ('m3500/manhattanOlson3500.g2o', 146.08),
        ('m3500/manhattanOlson3500-olson.g2o', 146.08),
        ('m3500/sesync-manhattan.g2o', 3549.0),
        ('intel/input_INTEL_g2o.g2o', 215.83),
        ('intel/vertigo-intel.g2o', 546.46),
        ('intel/sesync-intel.g2o', 45.00),
        ('small/simulation-pose-landmark.g2o', 474.1),
        ('small/simulation-pose-pose.g2o', 8269.4),
        ('small/ring-noisy.g2o', 11.163),
        ('small/w100.graph', 1.138),
    ],
)
def test_shared_graph_reaches_its_known_optimum(name, optimum):
    graph = read_graph(shared_graph(name)).graph
    solution = optimize(graph)
    # the optima are given with 4 to 5 digits
    assert solution.chi2_final == pytest.approx(optimum, rel=5e-4)
    assert solution.converged
    assert graph.chi2() == pytest.approx(solution.chi2_final, rel=1e-9)


@pytest.mark.parametrize('seed', range(3))
def test_headings_that_are_hardly_known_do_not_hide_the_optimum(seed):
    graph, known = city(3000, seed=seed, sigma=np.array([0.05, 0.05, 0.4])), city(3000, seed=seed)
    optimize(known)
    graph.poses[:] = known.poses
    optimum = optimize(graph, params.Solver(initialization='none')).chi2_final
    initialize(graph, 'odometry')
    assert graph.chi2() > 1e3 * optimum
    solution = optimize(graph)
    assert solution.converged
    assert solution.chi2_final < 1.001 * optimum


def test_a_second_start_is_left_where_going_on_is_better():
    graph, _, _ = loop_graph(seed=2, start_noise=0.1)
    best = optimize(graph).chi2_final
    found = restart(build_system(graph), graph.poses, graph.landmarks, 1, 1e-5, 0.0)
    assert found.cost <= best
    assert graph.chi2() == pytest.approx(found.chi2, rel=1e-9)


@pytest.mark.parametrize('start', ['none', 'odometry', 'auto'])
@pytest.mark.parametrize('name', ['intel/sesync-intel.g2o', 'small/ring-noisy.g2o'])
def test_what_is_called_converged_has_nothing_left_to_gain(name, start):
    limits = params.Solver(initialization='auto' if start == 'auto' else 'none')
    graph = read_graph(shared_graph(name)).graph
    if start == 'odometry':
        initialize(graph, start)
    solution = optimize(graph, limits)
    assert solution.converged
    rest = optimize(graph, TIGHT)
    # the tolerance is on the last step's estimate of what is left: allow it to be wrong by half
    assert solution.chi2_final <= rest.chi2_final * (1.0 + 1.5 * limits.relative_tolerance)


def test_victoria_park_is_no_worse_than_its_known_minimum():
    graph = read_graph(shared_graph('victoria-park/victoriaPark-full.g2o.gz')).graph
    assert optimize(graph).chi2_final < 18_887 * 1.001
