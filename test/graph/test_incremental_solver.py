# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_graphs import loop_graph
from normal_equations import normal_equations, unknowns
from scipy import sparse

from rlml_lab.bench.bench_incremental import Ours, keyframes
from rlml_lab.bench.generated_graphs import city, warehouse
from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.incremental.affected_subtree import MAX_OWN_ROWS
from rlml_slam.graph.incremental.incremental_solver import (
    MAX_FILL_GROWTH,
    MAX_FRAGMENTATION,
    IncrementalSolver,
    Step,
    Thresholds,
)
from rlml_slam.graph.incremental.relinearization_test import GROUP_SHARE, RESIDUAL_BOUND
from rlml_slam.graph.incremental.solver_state import (
    CLIQUES,
    FACTORS,
    IN_USE,
    LITTLE,
    TOP,
    UNKNOWNS,
    compacted,
    new_state,
)
from rlml_slam.graph.model.factors import Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.types import EdgeKind

EXACT = Thresholds(linear=1e-9, turn=1e-9, wildfire=0.0)


def driven(source: Graph) -> Ours:
    ours = Ours(source)
    for key in keyframes(source):
        ours.add(key)
        ours.work.append(ours.solver.update())
    return ours


def batch_chi2(graph: Graph) -> float:
    """Where the batch solver goes from the estimate at hand, which is put back."""
    before = graph.poses.copy(), graph.landmarks.copy()
    chi2 = optimize(graph).chi2_final
    graph.poses[:], graph.landmarks[:] = before
    return chi2


def chain(poses: int) -> Graph:
    """A straight drive along reflectors on one side, each seen from a few poses in a row."""
    rng = np.random.default_rng(3)
    truth = np.stack([np.arange(poses, dtype=float), np.zeros(poses), np.zeros(poses)], -1)
    points = np.stack([np.arange(0.0, poses, 4.0), np.full(-(-poses // 4), 3.0)], -1)
    graph = Graph()
    graph.add_poses(truth)
    graph.fixed_poses[0] = True
    graph.add_landmarks(points)
    for i in range(poses - 1):
        delta = [1.0, 0.0, 0.0] + 0.01 * rng.standard_normal(3)
        graph.add_edge(EdgeKind.ODOMETRY, i, i + 1, delta, 1e4 * np.eye(3))
    for i in range(poses):
        for k in np.flatnonzero(np.abs(points[:, 0] - i) < 5.0):
            z = points[k] - truth[i, :2] + 0.02 * rng.standard_normal(2)
            graph.add_sighting(i, int(k), z, 2500.0 * np.eye(2))
    return graph


@pytest.mark.parametrize('seed', range(6))
def test_every_step_stays_near_the_batch_optimum(seed: int) -> None:
    source, _, _ = loop_graph(seed, poses=60, landmarks=12)
    ours = Ours(source)
    for key in keyframes(source):
        ours.add(key)
        ours.solver.update()
        if key.index % 5 == 4:
            chi2, best = ours.graph.chi2(), batch_chi2(ours.graph)
            # 0.1 %, and what a step that has not been followed by another may leave
            assert best * (1.0 - 1e-6) <= chi2 <= best * 1.001 + 0.1


@pytest.mark.parametrize('source', [city(600), warehouse(300, 60)], ids=['city', 'warehouse'])
def test_ends_at_the_batch_optimum(source: Graph) -> None:
    graph = driven(source).graph
    best = batch_chi2(graph)
    assert best * (1.0 - 1e-6) <= graph.chi2() <= 1.001 * best


@pytest.mark.parametrize('whole', [False, True])
def test_a_step_that_relinearizes_all_solves_the_linear_equations(whole: bool) -> None:
    source, _, _ = loop_graph(1, poses=40)
    ours = Ours(source)
    for key in keyframes(source)[:-1]:
        ours.add(key)
        ours.solver.update()
    ours.solver.thresholds = EXACT
    for _ in range(6):
        ours.solver.update(whole=True)
    # at the optimum of all but the last keyframe; its factors make the right-hand side
    ours.add(keyframes(source)[-1])
    expected = gauss_newton_step(ours.graph)
    ours.solver.update(whole=whole)
    np.testing.assert_allclose(se2.wrap((ours.graph.poses - expected)[:, 2]), 0.0, atol=1e-8)
    np.testing.assert_allclose(ours.graph.poses[:, :2], expected[:, :2], atol=1e-8)


def test_linear_models_hold_up_to_the_valid_turn() -> None:
    """Turned by it, with residuals changed by RESIDUAL_BOUND sigmas, they are just off enough."""
    solver = driven(loop_graph(3, poses=60, landmarks=12)[0]).solver
    z = solver._state.factors[: solver._state.counts[FACTORS]]
    z = z[z['a'] >= 0]
    sigma, phi = 1.0 / np.sqrt(z['I00'] + z['I11']), z['valid_turn']
    t = np.stack([z['dx'], z['dy']], -1)  # in axes in which the pose heads along x
    worst = np.zeros(len(z))
    for angle in np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False):
        change = RESIDUAL_BOUND * sigma[:, None] * [np.cos(angle), np.sin(angle)]
        turned = np.stack([np.zeros_like(phi), np.zeros_like(phi), phi], -1)
        now = se2.transform(turned, (t + change)[:, None])[:, 0]
        model = now + phi[:, None] * np.stack([t[:, 1], -t[:, 0]], -1)
        worst = np.maximum(worst, np.linalg.norm(t + change - model, axis=1) / sigma)
    limits = solver.thresholds
    by_turn = phi == GROUP_SHARE * limits.turn
    assert not by_turn.all()
    # half phi^2 of the change itself is not in the bound
    assert (worst <= 1.01 * GROUP_SHARE * limits.linear).all()
    assert (worst[~by_turn] >= 0.99 * GROUP_SHARE * limits.linear).all()
    assert (phi <= GROUP_SHARE * limits.turn).all()


def gauss_newton_step(graph: Graph) -> np.ndarray:
    """Poses (n, 3) after one step of the normal equations of the oracle."""
    columns = unknowns(graph)
    equations = normal_equations(graph, columns)
    step = sparse.linalg.spsolve(equations.H, -equations.g)
    poses = graph.poses.copy()
    free = columns.poses >= 0
    poses[free] += step[columns.poses[free][:, None] + np.arange(3)]
    return poses


def test_odometry_costs_the_same_at_any_length() -> None:
    work = np.array(driven(chain(900)).work)
    plain = work[:, 0] == 0  # what has to be relinearised comes on top, now and then
    assert plain[100:].mean() > 0.9
    early, late = work[100:300][plain[100:300]], work[700:][plain[700:]]
    for name in ('factors', 'refactored', 'kept'):
        k = Step._fields.index(name)
        assert 0 < late[:, k].max() <= early[:, k].max()


def test_a_closure_costs_the_path_and_not_the_graph() -> None:
    ours = driven(chain(900))
    graph = ours.graph
    delta = se2.between(graph.poses[-6], graph.poses[-1])
    graph.add_edge(EdgeKind.CLOSURE, 894, 899, delta, 1e4 * np.eye(3))
    assert ours.solver.update().refactored < 60


def test_a_step_factors_the_end_of_a_wide_root_and_not_all_of_it() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-5.0, 5.0, (60, 2))
    graph = Graph()
    graph.add_landmarks(points)
    graph.add_pose([0.0, 0.0, 0.0], fixed=True)

    def see(x: float, landmarks: range) -> None:
        i = graph.add_pose([x, 0.0, 0.0])
        graph.add_edge(EdgeKind.ODOMETRY, i - 1, i, [0.1, 0.0, 0.0], 1e4 * np.eye(3))
        for k in landmarks:
            z = points[k] - [x, 0.0] + 0.02 * rng.standard_normal(2)
            graph.add_sighting(i, k, z, 2500.0 * np.eye(2))

    # what all poses see, they tie to one clique
    for i in range(1, 9):
        see(0.1 * i, range(60))
    solver = IncrementalSolver(graph)
    assert solver.update().refactored == 68
    for i in range(9, 12):
        see(0.1 * i, range(2))
        step = solver.update()
    assert step.refactored <= MAX_OWN_ROWS // 2 + 1
    assert graph.chi2() == pytest.approx(batch_chi2(graph), rel=1e-3)


def test_nothing_new_costs_nothing() -> None:
    ours = driven(loop_graph(2)[0])
    while any(ours.solver.update()):
        pass
    before = ours.graph.poses.copy()
    assert ours.solver.update() == Step(0, 0, 0, 0, 0, 0)
    np.testing.assert_array_equal(ours.graph.poses, before)


@pytest.mark.parametrize('seed', range(4))
def test_a_removed_closure_is_as_if_it_had_never_been(seed: int) -> None:
    source, _, _ = loop_graph(seed)
    ours = driven(source)
    graph = ours.graph
    wrong = graph.add_edge(EdgeKind.CLOSURE, 3, 25, [4.0, 4.0, 1.0], 100.0 * np.eye(3))
    ours.solver.update()
    bad = graph.chi2()
    graph.edges.enabled[wrong] = False
    for _ in range(10):
        ours.solver.update()
    best = batch_chi2(graph)
    assert bad > 2.0 * best
    assert graph.chi2() <= 1.001 * best
    graph.edges.enabled[wrong] = True
    for _ in range(10):
        ours.solver.update()
    assert graph.chi2() == pytest.approx(batch_chi2(graph), rel=1e-3)


def test_random_factors_come_and_go() -> None:
    rng = np.random.default_rng(5)
    source, _, _ = loop_graph(5, poses=60)
    ours = driven(source)
    graph = ours.graph
    closures = np.flatnonzero(np.abs(np.diff(graph.edges.nodes, axis=1))[:, 0] > 1)
    for _ in range(40):
        row = rng.choice(closures)
        graph.edges.enabled[row] ^= True
        seen = rng.integers(len(graph.sightings))
        graph.sightings.enabled[seen] ^= True
        ours.solver.update()
    for _ in range(5):
        ours.solver.update()
    assert graph.chi2() == pytest.approx(batch_chi2(graph), rel=1e-3)


def test_a_landmark_without_sightings_stays_where_it_is() -> None:
    ours = driven(loop_graph(0)[0])
    rows = np.flatnonzero(ours.graph.sightings.nodes[:, 1] == 0)
    ours.graph.sightings.enabled[rows] = False
    ours.solver.update()
    before = ours.graph.landmarks[0].copy()
    ours.graph.add_edge(EdgeKind.CLOSURE, 0, 20, [1.0, 2.0, 0.3], 1e4 * np.eye(3))
    ours.solver.update()
    np.testing.assert_array_equal(ours.graph.landmarks[0], before)
    ours.graph.sightings.enabled[rows] = True
    for _ in range(10):
        ours.solver.update()
    assert ours.graph.chi2() == pytest.approx(batch_chi2(ours.graph), rel=1e-3)


def test_robust_losses_give_the_batch_optimum() -> None:
    losses = Losses(closure=Loss(LossKind.CAUCHY, 2.0), reflector=Loss(LossKind.HUBER, 1.5))
    source, _, _ = loop_graph(3, poses=60)
    ours = Ours(source)
    ours.graph.losses = losses
    for key in keyframes(source):
        ours.add(key)
        ours.solver.update()
    graph = ours.graph
    graph.add_edge(EdgeKind.CLOSURE, 10, 40, [0.5, 0.5, 0.3], 400.0 * np.eye(3))
    for _ in range(30):
        ours.solver.update()
    before = graph.poses.copy()
    optimize(graph)
    np.testing.assert_allclose(before, graph.poses, atol=5e-3)


def test_new_losses_are_taken_over() -> None:
    ours = driven(loop_graph(3, poses=60)[0])
    ours.graph.losses = Losses(odometry=Loss(LossKind.HUBER, 0.5))
    for _ in range(30):
        ours.solver.update()
    before = ours.graph.poses.copy()
    optimize(ours.graph)
    np.testing.assert_allclose(before, ours.graph.poses, atol=5e-3)


def test_priors_hold_a_graph_without_a_fixed_pose() -> None:
    graph = Graph()
    graph.add_poses([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    graph.add_landmark([1.0, 1.0])
    graph.add_pose_prior(0, [0.1, 0.2, 0.3], np.eye(3))
    graph.add_edge(EdgeKind.ODOMETRY, 0, 1, [1.0, 0.0, 0.1], np.eye(3))
    graph.add_sighting(1, 0, [0.0, 1.0], np.eye(2))
    graph.add_landmark_prior(0, [1.0, 1.5], np.eye(2))
    solver = IncrementalSolver(graph, EXACT)
    for _ in range(10):
        solver.update()
    before = graph.poses.copy()
    optimize(graph)
    np.testing.assert_allclose(before, graph.poses, atol=1e-3)


def test_a_landmark_that_was_seen_before_is_surveyed() -> None:
    graph, _, points = loop_graph(4)
    solver = IncrementalSolver(graph, EXACT)

    def at_the_optimum() -> None:
        for _ in range(10):
            solver.update()
        assert graph.chi2() == pytest.approx(batch_chi2(graph), rel=1e-7)

    at_the_optimum()
    free = graph.chi2()
    for k in range(4):
        graph.add_landmark_prior(k, points[k] + [0.1, -0.2], 1e4 * np.eye(2))
    graph.add_sighting(7, 1, [1.0, 2.0], np.eye(2))
    at_the_optimum()
    assert graph.chi2() > 2.0 * free
    graph.landmark_priors.enabled[1:3] = False
    graph.add_sighting(9, 0, [2.0, 1.0], np.eye(2))
    at_the_optimum()
    graph.landmark_priors.enabled[:] = False
    graph.sightings.enabled[-2:] = False
    at_the_optimum()
    assert graph.chi2() == pytest.approx(free, rel=1e-7)


def test_a_loose_pose_is_named_and_can_be_tied() -> None:
    ours = driven(loop_graph(0)[0])
    graph = ours.graph
    i = graph.add_pose([0.0, 0.0, 0.0])
    j = graph.add_pose([1.0, 0.0, 0.0])
    graph.add_edge(EdgeKind.ODOMETRY, i, j, [1.0, 0.0, 0.0], np.eye(3))
    with pytest.raises(SolverError, match=f'near pose ({i}|{j})'):
        ours.solver.update()
    graph.add_edge(EdgeKind.CLOSURE, 5, j, [1.0, 0.5, 0.2], np.eye(3))
    for _ in range(5):
        ours.solver.update()
    assert graph.chi2() == pytest.approx(batch_chi2(graph), rel=1e-3)


def test_a_pose_with_one_sighting_is_named() -> None:
    ours = driven(loop_graph(0)[0])
    graph = ours.graph
    i = graph.add_pose([0.0, 0.0, 0.0])
    graph.add_sighting(i, 0, [1.0, 0.0], np.eye(2))
    with pytest.raises(SolverError, match='too few measurements'):
        ours.solver.update()


def test_memory_is_that_of_the_tree_whatever_came_and_went() -> None:
    """Blocks come and go with each closure; what they leave behind is given back."""
    rng = np.random.default_rng(0)
    graph = city(400)
    solver = IncrementalSolver(graph)
    solver.update()
    closures = np.flatnonzero(graph.edges.kinds == 2)
    for _ in range(300):
        graph.edges.enabled[rng.choice(closures, 3)] ^= True
        solver.update()
        in_use = int(solver._state.counts[IN_USE])
        # the quarter to spare, on what one more step may need besides
        assert len(solver._pool) <= 1.25 * MAX_FRAGMENTATION * (in_use + LITTLE)
    solver.update(whole=True)
    assert in_use < MAX_FILL_GROWTH * solver._state.counts[IN_USE] + LITTLE


def test_pool_without_gaps_holds_the_same_tree() -> None:
    graph = city(300)
    ours = driven(graph)
    solver = ours.solver
    before = solver.joint(np.arange(0, 300, 7))
    solver._pool = compacted(solver._state, solver._pool)
    assert solver._state.counts[TOP] == solver._state.counts[IN_USE]
    np.testing.assert_array_equal(solver.joint(np.arange(0, 300, 7)), before)
    closures = np.flatnonzero(ours.graph.edges.kinds == 2)
    ours.graph.edges.enabled[closures[-5:]] = False
    for _ in range(5):
        solver.update()
    assert ours.graph.chi2() == pytest.approx(batch_chi2(ours.graph), rel=1e-3)


def test_clique_is_moved_once_whatever_lies_where_it_came_to() -> None:
    """Where the second one comes to, the old pool has a member of the third: its own 31."""
    state, pool = new_state(40, 0, 1, 1), np.zeros(100)
    numbers, at = pool.view(np.int64), (32, 64, 12)
    members = ([0], [30, 31], [35, 29, 28, 30, 31])
    own = (1, 2, 1)
    state.unknowns['clique'] = -1
    for c in range(3):
        state.cliques[c]['block'], state.cliques[c]['size_class'] = at[c], 0
        numbers[at[c] : at[c] + len(members[c])] = members[c]
        state.unknowns['clique'][members[c][: own[c]]] = c
    state.counts[UNKNOWNS], state.counts[CLIQUES], state.counts[IN_USE] = 40, 3, 48
    after = compacted(state, pool).view(np.int64)
    assert state.counts[TOP] == 48
    assert sorted(state.cliques['block'][:3]) == [0, 16, 32]
    for c in range(3):
        block = state.cliques['block'][c]
        assert after[block : block + len(members[c])].tolist() == members[c]


def test_many_changes_at_a_time_do_not_fill_the_tree() -> None:
    """An order that keeps many for the end has fronts of all of them."""
    graph = warehouse(300, 40)
    solver = IncrementalSolver(graph)
    solver.update(whole=True)
    before = int(solver._state.counts[IN_USE])
    graph.sightings.enabled[graph.sightings.nodes[:, 1] % 3 == 0] = False
    solver.update()
    assert solver._state.counts[IN_USE] < 1.5 * before


def test_whether_an_update_is_due_is_told() -> None:
    graph = chain(12)
    solver = IncrementalSolver(graph)
    assert not solver.is_current
    changes = (
        lambda: graph.add_pose([12.0, 0.0, 0.0]),
        lambda: graph.add_edge(EdgeKind.ODOMETRY, 11, 12, [1.0, 0.0, 0.0], np.eye(3)),
        lambda: graph.sightings.enabled.__setitem__(3, False),
        lambda: graph.fixed_landmarks.__setitem__(1, True),
        lambda: graph.add_landmark_prior(0, [0.0, 3.0], np.eye(2)),
        lambda: setattr(graph, 'losses', Losses(scan=Loss(LossKind.HUBER, 2.0))),
        solver.start_over,
    )
    for change in changes:
        solver.update()
        assert solver.is_current
        change()
        assert not solver.is_current
