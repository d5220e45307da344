# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from made_graphs import loop_graph

from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.cost import total_cost
from rlml_slam.graph.model.factors import Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, LossKind, loss
from rlml_slam.graph.reduction.marginalization import marginalize_pose
from rlml_slam.types import EdgeKind

ROBUST = Losses(
    odometry=Loss(LossKind.CAUCHY, 3.0),
    closure=Loss(LossKind.HUBER, 2.0),
    reflector=Loss(LossKind.CAUCHY, 2.0),
)
SIGMA = np.array([0.05, 0.05, 0.02])


def cost(graph: Graph) -> float:
    return total_cost(graph.tables(), graph.poses, graph.landmarks)[0]


def best_cost(graph: Graph) -> float:
    """Of the batch solver, from the estimate at hand, which stays."""
    other = copy.deepcopy(graph)
    optimize(other)
    return cost(other)


def assert_at_the_optimum(live: OnlineSolver) -> None:
    best = best_cost(live.graph)
    # 0.1 %, and of a cost of nearly nothing what linear models may be off, a twentieth of a sigma
    assert best * (1.0 - 1e-6) <= cost(live.graph) <= 1.001 * best + 0.01


@pytest.mark.parametrize('losses', [Losses(), ROBUST], ids=['squares', 'robust'])
def test_cost_is_that_of_the_residuals(losses: Losses) -> None:
    graph, _, points = loop_graph(3, start_noise=1.0, losses=losses)
    graph.add_pose_prior(4, [1.0, 2.0, 0.5], np.diag([3.0, 2.0, 1.0]))
    graph.add_landmark_prior(2, points[2] + 0.3, [[4.0, 1.0], [1.0, 3.0]])
    graph.edges.enabled[3] = graph.sightings.enabled[5] = False
    r, expected, num = graph.residuals(), 0.0, 0
    for table, s in (
        (graph.edges, r.edges),
        (graph.sightings, r.sightings),
        (graph.pose_priors, r.pose_priors),
        (graph.landmark_priors, r.landmark_priors),
    ):
        for k in np.flatnonzero(table.enabled):
            one = losses.in_order()[table.kinds[k]]
            expected += loss(int(one.kind), one.scale, float(s[k]))[0]
            num += table.dimension
    found = total_cost(graph.tables(), graph.poses, graph.landmarks)
    assert found == (pytest.approx(expected, rel=1e-12), num)


def drive_on(graph: Graph, truth: list[np.ndarray], rng: np.random.Generator) -> None:
    """One more pose, with odometry and what it sees of the landmarks."""
    step = np.array([0.7, 0.0, rng.uniform(-0.4, 0.5)])
    truth.append(se2.compose(truth[-1], step))
    delta = se2.compose(step, SIGMA * rng.standard_normal(3))
    last = len(graph.poses) - 1
    graph.add_pose(se2.compose(graph.poses[last], delta))
    graph.add_edge(EdgeKind.ODOMETRY, last, last + 1, delta, np.diag(SIGMA**-2))


def do_something(
    live: OnlineSolver, truth: list[np.ndarray], points: np.ndarray, rng: np.random.Generator
) -> str:
    """One of what happens to the graph of a robot; its name."""
    graph = live.graph
    e, closures = graph.edges, np.flatnonzero(graph.edges.kinds == 2)
    what = rng.choice(
        [
            'drive',
            'drive',
            'close',
            'wrong',
            'toggle',
            'see',
            'marginalize_pose',
            'move',
            'fix',
            'losses',
        ]
    )
    if what == 'drive':
        drive_on(graph, truth, rng)
    elif what in ('close', 'wrong'):
        i, j = sorted(rng.choice(len(truth), 2, replace=False).tolist())
        off = (1.0 if what == 'close' else 30.0) * SIGMA * rng.standard_normal(3)
        delta = se2.compose(se2.between(truth[i], truth[j]), off)
        graph.add_edge(EdgeKind.CLOSURE, i, j, delta, np.diag(SIGMA**-2))
    elif what == 'toggle' and len(closures):
        e.enabled[rng.choice(closures)] ^= True
    elif what == 'see':
        i, k = int(rng.integers(len(truth))), int(rng.integers(len(points)))
        z = se2.transform(se2.inverse(truth[i]), points[k][None])[0]
        graph.add_sighting(i, k, z + 0.03 * rng.standard_normal(2), np.eye(2) / 0.03**2)
    elif what == 'eliminate' and len(truth) > 20:
        live.solve()
        removed = int(rng.integers(1, len(truth) - 1))
        graph.sightings.enabled[graph.sightings.nodes[:, 0] == removed] = False
        marginalize_pose(graph, removed, 1e-6 * np.ones(3))
        kept = np.arange(len(truth)) != removed
        live.keep(kept, np.ones(len(points), np.bool_), np.zeros(len(e), np.bool_))
        del truth[removed]
    elif what == 'move':
        T = rng.uniform(-3.0, 3.0, 3)
        graph.move(T)
        truth[:] = [se2.compose(T, pose) for pose in truth]
        points[:] = se2.transform(T, points)
        live.start_over()
    elif what == 'fix':
        graph.fixed_landmarks[0] ^= True
    elif what == 'losses':
        graph.losses = replace(ROBUST, scan=Loss(LossKind.HUBER, float(rng.uniform(1.0, 3.0))))
    return str(what)


@pytest.mark.parametrize('seed', range(6))
def test_estimate_is_that_of_the_batch_solver_whatever_happens(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph, true, points = loop_graph(seed, poses=40, losses=ROBUST)
    truth, live = list(true), OnlineSolver(graph)
    live.solve()
    done = set()
    for _ in range(80):
        done.add(do_something(live, truth, points, rng))
        live.solve()
        assert_at_the_optimum(live)
    assert len(done) == 9


def test_what_happens_every_day_takes_no_batch_solve() -> None:
    rng = np.random.default_rng(1)
    graph, true, _ = loop_graph(1, poses=60)
    truth, live = list(true), OnlineSolver(graph)
    live.solve()
    for k in range(40):
        drive_on(graph, truth, rng)
        if k % 4 == 0:
            i, j = int(rng.integers(20)), len(truth) - 1
            graph.add_edge(
                EdgeKind.CLOSURE, i, j, se2.between(truth[i], truth[j]), np.diag(SIGMA**-2)
            )
        live.solve()
    assert live.batches == 0
    assert_at_the_optimum(live)


def test_a_solver_goes_on_with_a_renumbered_graph() -> None:
    """What is left is not factored again, except where poses were removed."""
    rng = np.random.default_rng(2)
    graph, true, points = loop_graph(2, poses=40)
    truth, live = list(true), OnlineSolver(graph)
    for _ in range(200):
        drive_on(graph, truth, rng)
        live.solve()
    for removed in (230, 233, 235):
        marginalize_pose(graph, removed, 1e-6 * np.ones(3))
    kept = np.ones(len(truth), np.bool_)
    kept[[230, 233, 235]] = False
    live.keep(kept, np.ones(len(points), np.bool_), np.zeros(len(graph.edges), np.bool_))
    truth = [pose for pose, stays in zip(truth, kept, strict=True) if stays]
    drive_on(graph, truth, rng)
    assert live._incremental.update().refactored < 40
    assert_at_the_optimum(live)


def test_a_bad_start_is_the_batch_solvers() -> None:
    graph, truth, _ = loop_graph(0, poses=40)
    rng = np.random.default_rng(0)
    graph.poses[1:] += rng.normal(0.0, 2.0, (39, 3))
    live = OnlineSolver(graph)
    live.solve()
    assert live.batches == 1
    live.solve()
    np.testing.assert_allclose(graph.poses[:, :2], truth[:, :2], atol=0.3)


@pytest.mark.parametrize('seed', range(3))
def test_joint_covariance_is_that_of_the_whole_graph(seed: int) -> None:
    graph, _, _ = loop_graph(seed, poses=50, losses=ROBUST)
    loose = graph.add_landmark([1.0, 1.0])
    graph.fixed_landmarks[3] = True
    live = OnlineSolver(graph)
    for _ in range(20):  # linearised at the optimum itself
        live.start_over()
        live.solve()
    poses, landmarks = [0, 7, 49, 20, 21], [2, 3, loose, 0]
    found, expected = (
        live.joint(poses, landmarks),
        Marginals(graph).joint(poses, landmarks),
    )
    sigma = np.sqrt(np.diag(expected))
    assert (np.abs(found - expected) <= 1e-6 * np.outer(sigma, sigma)).all()
    assert (found[:3] == 0.0).all()  # fixed
    assert live.joint([], []).shape == (0, 0)


def test_covariance_that_cannot_be_told_moves_nothing() -> None:
    """A graph that cannot be solved: poses stay, until it can be solved."""
    graph, truth, _ = loop_graph(1, poses=30, losses=ROBUST)
    live = OnlineSolver(graph)
    live.solve()
    drive_on(graph, list(truth), np.random.default_rng(1))
    island = [graph.add_pose([x, 1.0, 0.0]) for x in (1.0, 2.0)]
    graph.add_edge(EdgeKind.ODOMETRY, *island, [1.0, 0.0, 0.0], np.eye(3))
    before = graph.poses.copy(), graph.landmarks.copy()
    with pytest.raises(SolverError):
        live.joint([30])
    np.testing.assert_array_equal(graph.poses, before[0])
    np.testing.assert_array_equal(graph.landmarks, before[1])
    graph.edges.enabled[-1] = False
    assert np.linalg.eigvalsh(live.joint([30])).min() > 0.0


def test_what_is_at_rest_stays_there() -> None:
    """Robust weights come to rest slowly: a solve that ended may have left a little to gain."""
    rng = np.random.default_rng(3)
    graph, true, points = loop_graph(3, poses=40, losses=ROBUST)
    truth, live = list(true), OnlineSolver(graph)
    for _ in range(60):
        do_something(live, truth, points, rng)
        live.solve()
        before, steps = graph.poses.copy(), live.steps
        live.joint([3, len(truth) - 1], [0])
        live.solve()
        np.testing.assert_array_equal(graph.poses, before)
        if live.batches == 0:
            assert live.steps == steps


@pytest.mark.parametrize('seed', range(3))
def test_joint_covariance_moves_nothing_until_the_next_solve(seed: int) -> None:
    """Also where it has to be solved for; and the next solve has no more to do then."""
    rng = np.random.default_rng(seed)
    graph, true, _ = loop_graph(seed, poses=40, losses=ROBUST)
    truth, live = list(true), OnlineSolver(graph)
    live.solve()
    moved = 0
    for k in range(40):
        drive_on(graph, truth, rng)
        if k % 5 == 0:
            i, j = int(rng.integers(20)), len(truth) - 1
            delta = se2.compose(se2.between(truth[i], truth[j]), SIGMA * rng.standard_normal(3))
            graph.add_edge(EdgeKind.CLOSURE, i, j, delta, np.diag(SIGMA**-2))
        before = graph.poses.copy(), graph.landmarks.copy()
        cov = live.joint([len(truth) - 1], [0])
        assert np.linalg.eigvalsh(cov).min() > 0.0
        np.testing.assert_array_equal(graph.poses, before[0])
        np.testing.assert_array_equal(graph.landmarks, before[1])
        steps = live.steps
        live.solve()
        assert live.steps == steps
        moved += not np.array_equal(graph.poses, before[0])
        np.testing.assert_array_equal(live.joint([len(truth) - 1], [0]), cov)
        assert_at_the_optimum(live)
    assert moved > 30


def test_joint_covariance_is_there_where_the_batch_solver_had_to_come() -> None:
    graph, _, _ = loop_graph(0, poses=40)
    graph.poses[1:] += np.random.default_rng(0).normal(0.0, 2.0, (39, 3))
    live, before = OnlineSolver(graph), graph.poses.copy()
    cov = live.joint([7])
    assert live.batches == 1
    np.testing.assert_array_equal(graph.poses, before)
    live.solve()
    expected = Marginals(graph).joint([7])
    sigma = np.sqrt(np.diag(expected))
    # the linear models may be off by a twentieth of a sigma
    assert (np.abs(cov - expected) <= 0.1 * np.outer(sigma, sigma)).all()
