# SPDX-License-Identifier: Apache-2.0
import copy
import functools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, TinyWorld, drive, errors, observations, polygon

from rlml_slam import se2
from rlml_slam.errors import SolverError
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.cost import total_cost
from rlml_slam.graph.reduction.marginalization import marginalize_pose
from rlml_slam.params import BackEnd as BackEndParameters
from rlml_slam.params import LoopClosure, Node, Parameters
from rlml_slam.slam.back_end import sparsification
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.back_end.sparsification import BATCH, EDGES, remaining
from rlml_slam.slam.back_end.trajectory import FrameTrajectory
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.keyframes import Keyframe

LAPS = 5
ROUND = [(0.8, 0.0, 3.0), (0.8, np.pi / 2, 1.0)] * 4
START = (0.5, -1.0, 0.0)
SQUARE = TinyWorld(
    np.vstack(
        [polygon((-2, -3), (6, -3), (6.5, 4), (-1.5, 3.5)), polygon((2, 0), (3, 0), (2, 1))]
    ),
    np.array([[-1.8, -2.5], [5.5, -2.4], [5.8, 3.2], [-1.2, 3.1], [2.0, 3.5], [3.5, -2.8]]),
)


def params(**values):
    few = {'keyframes_per_place': 2, 'submap_size': 10} | values
    return Parameters(back_end=BackEndParameters(**few))


def driven(observed, parameters, set_back=()):
    """After each observation: its number, the back end, and the update where there was one.

    ``set_back``: from which observation on the stamps are earlier, and by how many nanoseconds.
    """
    front_end, back_end = FrontEnd(parameters), BackEnd(parameters)
    for k, o in enumerate(observed):
        frame = front_end.process(o)
        if set_back and k >= set_back[0]:
            frame = replace(frame, stamp=frame.stamp - set_back[1])
        update = back_end.add(frame)
        if update is not None and update.optimized:
            front_end.correct(update.T_map_local)
        yield k, back_end, update


def mapped(observed, parameters, set_back=()):
    """A back end, and the number of keyframes at the end of each lap."""
    counts = []
    for k, back_end, _ in driven(observed, parameters, set_back):
        if (k + 1) % (len(observed) // LAPS) == 0:
            counts.append(len(back_end.keyframes))
    back_end.finish()
    return back_end, counts


@pytest.fixture(scope='module', params=[(True, True), (True, False), (False, True)])
def runs(request):
    scan, reflectors = request.param
    path = drive(*ROUND * LAPS, start=START)
    rng = np.random.default_rng(0)
    observed = observations(SQUARE, path, scan=scan, reflectors=reflectors, rng=rng)
    start = {'node': replace(Parameters().node, map_start_pose=START)}
    few, counts = mapped(observed, replace(params(), **start))
    all_, many = mapped(observed, replace(params(keyframes_per_place=0), **start))
    return path, few, counts, all_, many


def test_map_stops_growing_where_all_is_mapped(runs):
    _, few, counts, _, many = runs
    assert many[-1] > 2.0 * counts[-1]
    # those that wait to be judged are a few more or less
    assert max(counts[1:]) - min(counts[1:]) <= 5
    assert len(few.graph.poses) == len(few.keyframes)
    assert len(few.graph.edges) < 12 * counts[-1]


def test_what_closures_leave_behind_does_not_grow_with_the_laps():
    """Neither edges that were replaced, nor records of closures that others stand for now."""
    path = drive(*ROUND * 8, start=START)
    observed = observations(SQUARE, path, reflectors=False, rng=np.random.default_rng(0))
    closes = LoopClosure(max_distance=4.0, keyframe_interval=1)
    parameters = replace(
        params(), node=replace(Parameters().node, map_start_pose=START), loop_closure=closes
    )
    keys, rows, records, tried = [], [], [], []
    fresh = set()
    for k, back_end, update in driven(observed, parameters):
        if update is not None:
            fresh |= {c.number for c in update.closures if c.accepted}
        if update is not None and update.optimized:
            fresh = set()
        # none is let go of by an estimate that it is not in yet
        enabled, closures = back_end.graph.edges.enabled, back_end.loop_closer.records
        assert fresh <= {c.number for c in closures if c.accepted and enabled[c.edge]}
        if (k + 1) % (len(observed) // 4) == 0:
            keys.append(len(back_end.keyframes))
            rows.append(len(back_end.graph.edges))
            records.append(sum(c.accepted for c in back_end.loop_closer.records))
            tried.append(back_end.loop_closer.tried[True])
    assert tried[-1] > 2 * tried[1]  # loops are closed all the time
    recent = 10 + 20  # keyframes that were not judged yet, with their edges of each sort
    assert rows[-1] <= EDGES * keys[-1] + BATCH + 4 * recent
    assert records[-1] <= rows[-1]
    e = back_end.graph.edges
    recorded = {c.edge for c in back_end.loop_closer.records if c.accepted}
    assert set(np.flatnonzero(~e.enabled)) <= recorded
    accepted = [c.edge for c in back_end.loop_closer.records if c.accepted]
    assert len(accepted) == len(set(accepted))


def test_nothing_that_is_kept_grows_with_the_laps():
    """Sightings, edges, records, and all there is together, once the place is mapped."""
    laps = 16
    path = drive(*ROUND * laps, start=START)
    observed = observations(SQUARE, path, rng=np.random.default_rng(0))
    parameters = replace(
        params(max_trajectory_frames=1000),
        node=replace(Parameters().node, map_start_pose=START),
        loop_closure=LoopClosure(max_distance=4.0),
    )
    sizes = []
    for k, back_end, _ in driven(observed, parameters):
        if (k + 1) % (len(observed) // laps) == 0:
            graph, way = back_end.graph, back_end.path_covariance
            sizes.append(
                (len(back_end.keyframes), len(graph.edges), len(graph.sightings),
                 len(back_end.loop_closer.records), len(way._numbers), len(pickle.dumps(back_end)))
            )  # fmt: skip
    assert back_end.loop_closer.tried[True] > 20
    early, late = np.array(sizes[-8:-4]), np.array(sizes[-4:])
    # edges come up to their limit by and by, and what is pruned then comes and goes by a third
    # from lap to lap: late laps together show a growth
    assert (late.mean(axis=0) <= 1.1 * early.mean(axis=0)).all(), sizes
    # as many sightings as keyframes come with, at the most
    assert sizes[-1][2] <= len(SQUARE.reflectors) * sizes[-1][0]


def test_every_frame_keeps_its_pose(runs):
    path, few, _, all_, _ = runs
    for back_end in (few, all_):
        stamps, poses = back_end.trajectory()
        assert len(stamps) == len(path)
        assert (np.diff(stamps) > 0).all()
        distance, turn = errors(poses, path)
        assert distance.max() < 0.08
        assert turn.max() < 0.03
    # as good as with all keyframes, up to a tenth of a cell
    rmse = [np.sqrt(np.mean(errors(b.trajectory()[1], path)[0] ** 2)) for b in (few, all_)]
    assert rmse[0] < rmse[1] + 0.005


def test_reflectors_stay_where_they_are(runs):
    _, few, _, all_, _ = runs
    a, b = few.reflectors(), all_.reflectors()
    np.testing.assert_array_equal(a.keys, b.keys)
    np.testing.assert_array_equal(a.sightings, b.sightings)
    if len(a):
        gap = np.linalg.norm(a.points - b.points, axis=-1)
        assert gap.max() < 0.03


def test_indices_point_at_what_they_did(runs):
    _, few, _, _, _ = runs
    graph = few.graph
    assert [k.index for k in few.keyframes] == list(range(len(few.keyframes)))
    for c in few.loop_closer.records:
        if c.accepted:
            assert set(graph.edges.nodes[c.edge]) == {c.i, c.j}
    r = graph.residuals()
    # nothing was attached to the wrong place: no residual is out of proportion
    assert np.quantile(r.edges[graph.edges.enabled], 0.99, method='lower') < 30.0


def test_place_shows_its_newest_scans_whatever_the_clock_says():
    path = drive(*ROUND * LAPS, start=START)
    observed = observations(SQUARE, path, reflectors=False, rng=np.random.default_rng(1))
    parameters = replace(params(), node=replace(Parameters().node, map_start_pose=START))
    (same, _), (other, _) = (
        mapped(observed, parameters, (2 * len(path) // LAPS, earlier)) for earlier in (0, 10**12)
    )
    for a, b in zip(same.keyframes, other.keyframes, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(same.graph.poses, other.graph.poses)


def test_place_shows_its_newest_scans():
    path = drive(*ROUND * LAPS, start=START)
    observed = observations(SQUARE, path, reflectors=False, rng=np.random.default_rng(1))
    # in the last two laps a box stands in the corner
    box = replace(SQUARE, walls=np.vstack([SQUARE.walls, polygon((4, 2), (5, 2), (5, 3), (4, 3))]))
    with_box = observations(box, path, reflectors=False, rng=np.random.default_rng(1))
    n = len(path) * 2 // LAPS
    parameters = replace(params(), node=replace(Parameters().node, map_start_pose=START))
    back_end, _ = mapped(observed[:-n] + with_box[-n:], parameters)
    grid = back_end.occupancy_grid()
    j, i = np.floor((np.array([4.5, 2.0]) - grid.origin) / grid.resolution).astype(int)
    assert grid.cells[i - 2 : i + 3, j - 4 : j + 5].max() >= 65


def test_map_does_not_drift_with_the_laps():
    """Copies of copies of the submaps would, by 3 mm a lap, and the graph knows nothing of it."""
    laps = 15
    path = drive(*ROUND * laps, start=START)
    observed = observations(SQUARE, path, reflectors=False, rng=np.random.default_rng(5))
    start = replace(Parameters().node, map_start_pose=START)
    off = []
    for k, back_end, update in driven(observed, Parameters(node=start)):
        if update is not None and update.optimized and k > len(path) * 2 // 3:
            pose, cov = back_end.graph.poses[-1], back_end.known.cov_map
            e = se2.between(path[k], pose)
            e[:2] = se2.rotation(path[k][2]) @ e[:2]
            off.append((e @ np.linalg.solve(cov, e), np.hypot(*e[:2])))
    nees, error = np.mean(off, axis=0)
    assert error < 0.02
    assert nees < 4.0  # 3 degrees of freedom


def test_path_is_thinned_beyond_its_limit():
    path = FrameTrajectory(1000)
    for k in range(3000):
        if k and k % 10 == 0:
            path.begin_keyframe(np.array([0.5, 0.0, 0.0]))
        path.add(k, np.array([0.05 * (k % 10), 0.0, 0.0]))
    stamps = path.stamps()
    assert 400 < len(stamps) <= 1000
    assert (np.diff(stamps) > 0).all()
    keys = np.stack([0.5 * np.arange(300), np.zeros(300), np.zeros(300)], -1)
    np.testing.assert_allclose(path.poses(keys)[:, 0], 0.05 * stamps, atol=1e-6)


def test_frames_of_a_keyframe_that_goes_stay_where_they_are():
    rng = np.random.default_rng(2)
    path, keys, local = FrameTrajectory(1000), [], np.zeros(3)
    for k in range(6):
        if k:
            motion = rng.uniform(-0.5, 0.5, 3)
            local = se2.compose(local, motion)
            path.begin_keyframe(motion)
        keys.append(local + 0.05 * rng.standard_normal(3))
        for n in range(4):
            path.add(10 * k + n, 0.1 * n * np.ones(3))
    keys = np.array(keys)
    before = path.poses(keys)
    new = np.array([0, 1, -1, 2, -1, 3])
    path.renumber(keys, new, np.array([-1, -1, 0, -1, 3, -1]))
    kept = keys[[0, 1, 3, 5]]
    np.testing.assert_allclose(path.poses(kept), before, atol=1e-9)
    # and they follow the keyframe that they hang on
    moved = se2.compose(np.array([1.0, -2.0, 0.7]), kept)
    np.testing.assert_allclose(
        path.poses(moved), se2.compose(np.array([1.0, -2.0, 0.7]), before), atol=1e-9
    )


@pytest.mark.parametrize('limit', [60, 1000])
def test_path_is_the_same_however_late_anyone_asks_for_it(limit):
    """Frames refer to keyframes that were removed one by one, until the path is read."""
    rng = np.random.default_rng(5)
    lazy, eager = FrameTrajectory(limit), FrameTrajectory(limit)
    keys, local = np.zeros((0, 3)), np.zeros(3)
    for k in range(40):
        if k:
            motion = rng.uniform(-0.5, 0.5, 3)
            local = se2.compose(local, motion)
            for path in (lazy, eager):
                path.begin_keyframe(motion)
        keys = np.vstack([keys, local + 0.05 * rng.standard_normal(3)])
        for n in range(4):
            for path in (lazy, eager):
                path.add(10 * k + n, 0.1 * n * np.ones(3))
        if k % 4 == 3:
            removed = rng.choice(np.arange(1, len(keys) - 1), min(3, len(keys) - 3), replace=False)
            left = np.setdiff1d(np.arange(len(keys)), removed)
            new, onto = np.full(len(keys), -1), np.full(len(keys), -1)
            new[left], onto[removed] = np.arange(len(left)), rng.choice(left, len(removed))
            for path in (lazy, eager):
                path.renumber(keys, new, onto)
            keys = keys[left]
            eager.poses(keys)
    np.testing.assert_array_equal(lazy.stamps(), eager.stamps())
    np.testing.assert_allclose(lazy.poses(keys), eager.poses(keys), atol=1e-9)


def test_room_is_mapped_the_same_where_no_place_is_full():
    observed = observations(ROOM, drive((0.5, 0.2, 6.0)), rng=np.random.default_rng(3))
    a, _ = mapped(observed, Parameters())
    b, _ = mapped(observed, params(keyframes_per_place=0, submap_size=40))
    assert a.trajectory()[1].tobytes() == b.trajectory()[1].tobytes()


@pytest.mark.parametrize('seed', range(2))
def test_estimate_is_that_of_the_batch_solver_all_along_a_drive(seed):
    """With loops that are closed, reflectors that are merged, keyframes that go."""
    rng = np.random.default_rng(seed)
    path = drive(*ROUND * 3, start=START)
    observed = observations(SQUARE, path, rng=rng)
    parameters = replace(
        params(),
        node=replace(Parameters().node, map_start_pose=START),
        loop_closure=LoopClosure(max_distance=4.0, keyframe_interval=1),
    )
    front_end, back_end = FrontEnd(parameters), BackEnd(parameters)
    graph, live = back_end.graph, back_end.solver
    solved = sparsified = 0
    for o in observed:
        num = len(back_end.keyframes)
        update = back_end.add(front_end.process(o))
        before = graph.poses.copy()
        if back_end.belief() is not None:  # asks for covariances in the middle of a drive
            np.testing.assert_array_equal(graph.poses, before)
        if update is None or not update.optimized:
            continue
        front_end.correct(update.T_map_local)
        last = back_end.keyframes[-1]
        there = se2.compose(update.T_map_local, last.T_local)
        np.testing.assert_allclose(graph.poses[last.index], there, atol=1e-12)
        sparsified += len(back_end.keyframes) <= num
        live.solve()
        other = copy.deepcopy(graph)
        optimize(other)
        best = total_cost(other.tables(), other.poses, other.landmarks)[0]
        assert total_cost(graph.tables(), graph.poses, graph.landmarks)[0] <= 1.001 * best + 0.01
        solved += 1
    assert solved > 10
    assert sparsified > 3
    assert any(c.accepted for c in back_end.loop_closer.records)


def test_jump_is_not_forgotten_with_the_keyframe_that_it_led_to():
    jumped = np.array([0, 0, 1, 0, 1, 0, 0], dtype=bool)
    kept = np.array([1, 1, 0, 0, 0, 1, 1], dtype=bool)
    zero = np.zeros(3)
    keys = [Keyframe(k, k, zero, np.eye(3), None, None, k, jumped=j) for k, j in enumerate(jumped)]
    left = remaining(keys, kept)
    assert [k.stamp for k in left] == [0, 1, 5, 6]
    assert [k.index for k in left] == [0, 1, 2, 3]
    assert [k.jumped for k in left] == [False, False, True, False]


@functools.cache
def three_laps():
    """The path of three laps, their observations, and the back end that kept all of them."""
    path = drive(*ROUND * 3, start=START)
    observed = observations(SQUARE, path, rng=np.random.default_rng(0))
    parameters = replace(params(keyframes_per_place=0), node=Node(map_start_pose=START))
    return path, observed, mapped(observed, parameters)[0]


@pytest.mark.parametrize('share', [0.3, 1.0])
def test_keyframe_that_cannot_be_let_go_of_stays_with_all_it_tells(monkeypatch, share):
    rng = np.random.default_rng(8)
    refused = []

    def eliminated(graph, pose, floor2):
        if rng.random() < share:
            refused.append(pose)
            raise SolverError('cannot be tied')
        return marginalize_pose(graph, pose, floor2)

    path, observed, all_ = three_laps()
    monkeypatch.setattr(sparsification, 'marginalize_pose', eliminated)
    few, _ = mapped(observed, replace(params(), node=Node(map_start_pose=START)))
    assert refused
    here = {key.stamp for key in few.keyframes}
    assert len(few.graph.poses) == len(few.keyframes)
    # each is judged once, and those that are left are all there
    assert few.sparsifier._num_checked <= len(few.keyframes)
    if share == 1.0:
        assert here == {key.stamp for key in all_.keyframes}
    else:
        assert len(here) < 0.8 * len(all_.keyframes)
    distance, turn = errors(few.trajectory()[1], path)
    assert distance.max() < 0.1
    assert turn.max() < 0.03
