# SPDX-License-Identifier: Apache-2.0
import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from made_maps import whole
from made_worlds import (
    FIRST,
    ROOM,
    STEP,
    TinyWorld,
    detections_of,
    drive,
    errors,
    motion_cov,
    observations,
    polygon,
    seen_at,
)

from rlml_slam import se2
from rlml_slam.graph.model.factors import relative_information
from rlml_slam.graph.model.graph import EDGE_KINDS, Graph
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import BackEnd as BackEndParameters
from rlml_slam.params import LoopClosure, Node, Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_candidates import candidates
from rlml_slam.slam.closures.closure_consistency import _RelativeCovariance
from rlml_slam.slam.closures.closure_matching import ClosureMatcher
from rlml_slam.slam.closures.keyframe_submap import TURN, KeyframeSubmap, edge_of_match
from rlml_slam.slam.keyframes import FoundPose, Interval, Keyframe, Sighting
from rlml_slam.types import ANONYMOUS, EdgeKind, Frame, Motion, Observation, Status

CURVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 4.0), (0.5, -0.7, 2.0))
# one lap around a block: from any corner one sees two of the four sides
BLOCK = TinyWorld(
    np.vstack(
        [
            polygon((-2.0, -1.5), (9.0, -1.5), (9.0, 5.5), (6.0, 5.5), (6.0, 6.5), (-2.0, 6.5)),
            polygon((0.0, 1.0), (6.5, 1.0), (6.5, 3.5), (1.0, 4.0)),
        ]
    ),
    np.zeros((0, 2)),
)
LAP = drive(
    *[(0.8, 0.0, 9.0), (0.6, np.pi / 3, 1.5), (0.8, 0.0, 4.4), (0.6, np.pi / 3, 1.5)],
    *[(0.8, 0.0, 9.0), (0.6, np.pi / 3, 1.5), (0.8, 0.0, 4.4), (0.6, np.pi / 3, 1.5)],
    (0.8, 0.0, 5.0),
)
EYE = np.eye(3)


def frame_of(observation, T_local, landmarks=None, cov=None, score=float('nan')):
    """A frame as the front end would give it."""
    k = 0 if observation.detections is None else len(observation.detections)
    landmarks = np.arange(k) if landmarks is None else np.asarray(landmarks)
    cov = 1e-4 * EYE if cov is None else cov
    return Frame(
        observation.stamp, observation, T_local, cov, T_local, cov, landmarks.astype(np.int64),
        np.where(landmarks >= 0, Status.USED, Status.NEW), scan_score=score,
        scan_used=bool(np.isfinite(score)),
    )  # fmt: skip


def frames_along(path, world=None, local=None, landmarks=None, rng=None, **inputs):
    """Frames of a front end that believes ``local`` where ``path`` is true."""
    world = world or ROOM
    local = path if local is None else local
    out = []
    for k, o in enumerate(observations(world, path, rng=rng, **inputs)):
        delta = se2.between(local[k - 1], local[k]) if k else np.zeros(3)
        o = replace(o, motion=Motion(delta, motion_cov(delta) if k else np.zeros((3, 3))))
        score = 0.7 if o.points is not None and k else float('nan')
        out.append(frame_of(o, local[k], landmarks(k) if landmarks else None, score=score))
    return out


def run(frames, params=None):
    back_end = BackEnd(params or Parameters())
    updates = [back_end.add(f) for f in frames]
    back_end.finish()
    return back_end, [u for u in updates if u is not None]


# --- keyframes ---------------------------------------------------------------------------------


def test_keyframe_is_taken_after_travel_or_turn():
    straight = drive((0.5, 0.0, 4.0))
    back_end, updates = run(frames_along(straight, scan=False))
    # 0.05 m per frame, one keyframe per 0.3 m, rounding may cost one frame
    steps = np.diff([k.stamp for k in back_end.keyframes]) // STEP
    assert set(steps) <= {6, 7}
    assert [u.keyframe for u in updates] == list(range(len(back_end.keyframes)))
    turning = drive((0.0, 0.5, 3.0))
    back_end, _ = run(frames_along(turning, scan=False))
    assert set(np.diff([k.stamp for k in back_end.keyframes]) // STEP) <= {5, 6}


def test_standing_robot_takes_one_keyframe():
    back_end, updates = run(frames_along(np.zeros((150, 3)), scan=False))
    assert len(back_end.keyframes) == len(updates) == 1
    stamps, poses = back_end.trajectory()
    assert len(stamps) == len(poses) == 150
    np.testing.assert_array_equal(poses, 0.0)


def test_keyframe_after_minimum_time_only_if_it_moved():
    crawl = np.zeros((130, 3))
    crawl[1:, 0] = 0.05
    back_end, _ = run(frames_along(crawl, scan=False))
    assert [int(k.stamp - FIRST) // STEP for k in back_end.keyframes] == [0, 100]


def test_empty_back_end_has_empty_products():
    back_end = BackEnd(Parameters())
    stamps, poses = back_end.trajectory()
    assert len(stamps) == len(poses) == len(back_end.reflectors()) == 0
    assert back_end.belief() is None
    assert back_end.occupancy_grid() is None
    back_end.finish()


# --- edges by equation -------------------------------------------------------------------------


def test_edge_has_the_covariance_of_the_relative_motion():
    path = drive((0.5, 0.4, 3.0))
    params = Parameters()
    back_end, _ = run(frames_along(path, scan=False, reflectors=False))
    a, b = back_end.keyframes[1:3]
    i, j = ((k.stamp - FIRST) // STEP for k in (a, b))
    # composition of the steps, each in the axes of the one before
    P = np.zeros((3, 3))
    T = np.zeros(3)
    for k in range(i, j):
        delta = se2.between(path[k], path[k + 1])
        J_a, J_b = se2.compose_jacobians(T, delta)
        P = J_a @ P @ J_a.T + J_b @ motion_cov(delta) @ J_b.T
        T = se2.compose(T, delta)
    np.testing.assert_allclose(back_end.graph.edges.measured[1], T, atol=1e-12)
    expected = relative_information(T, P + np.diag(params.back_end.edge_variance_floor))
    np.testing.assert_allclose(back_end.graph.edges.information[1], expected, rtol=1e-9)


def test_sum_mode_is_equation_14_in_the_axes_of_the_first_pose():
    params = Parameters(back_end=BackEndParameters(edge_covariance='sum'))
    path = drive((0.5, 0.4, 3.0), start=(1.0, 2.0, 2.0))
    cov = np.diag([4e-4, 1e-4, 2e-5])
    frames = [
        replace(f, cov_local=(1 + k) * cov)
        for k, f in enumerate(frames_along(path, scan=False, reflectors=False))
    ]
    back_end, _ = run(frames, params)
    a, b = back_end.keyframes[1:3]
    R = np.eye(3)
    R[:2, :2] = se2.rotation(-a.T_local[2])
    total = R @ (a.cov_local + b.cov_local) @ R.T
    expected = relative_information(back_end.graph.edges.measured[1], total)
    # 1e-9 is added against a singular sum
    np.testing.assert_allclose(back_end.graph.edges.information[1], expected, rtol=1e-3)


@pytest.mark.parametrize('mode', ['relative', 'sum'])
def test_noisy_drive_is_mapped_in_either_mode(mode):
    params = Parameters(back_end=BackEndParameters(edge_covariance=mode))
    back_end = whole(observations(ROOM, CURVE, rng=np.random.default_rng(0)), params)
    distance, turn = errors(back_end.trajectory()[1], CURVE)
    assert distance.max() < 0.04
    assert turn.max() < 0.02
    gap = np.linalg.norm(back_end.reflectors().points[:, None] - ROOM.reflectors, axis=-1)
    assert gap.shape == (6, 6)
    assert gap.min(axis=1).max() < 0.03


# --- noiseless and invariant -------------------------------------------------------------------


@pytest.mark.parametrize(
    # exact measurements agree to rounding; a fifth of a cell where the grid has a say
    ('scan', 'reflectors', 'tolerance'),
    [(False, False, 1e-9), (False, True, 1e-6), (True, False, 0.01), (True, True, 0.01)],
)
def test_noiseless_drive_gives_an_exact_map(scan, reflectors, tolerance):
    back_end = whole(observations(ROOM, CURVE, scan=scan, reflectors=reflectors))
    stamps, poses = back_end.trajectory()
    np.testing.assert_array_equal(stamps, FIRST + STEP * np.arange(len(CURVE)))
    distance, turn = errors(poses, CURVE)
    assert distance.max() < tolerance
    assert turn.max() < tolerance
    found = back_end.reflectors()
    assert len(found) == (len(ROOM.reflectors) if reflectors else 0)
    if reflectors:
        np.testing.assert_allclose(found.points, ROOM.reflectors, atol=tolerance)
        assert (np.linalg.eigvalsh(found.cov) > 0.0).all()
    grid = back_end.occupancy_grid()
    assert (grid is not None) == scan


def test_moving_the_start_pose_moves_the_map():
    start = np.array([-4.0, 9.0, -2.2])
    observed = observations(ROOM, CURVE, scan=False, rng=np.random.default_rng(1))
    a = whole(observed)
    b = whole(observed, Parameters(node=Node(map_start_pose=tuple(start))))
    distance, turn = errors(b.trajectory()[1], se2.compose(start, a.trajectory()[1]))
    # both stop iterating at a relative fall of the cost of 1e-5
    assert max(distance.max(), turn.max()) < 1e-4
    moved = se2.transform(start, a.reflectors().points)
    np.testing.assert_allclose(b.reflectors().points, moved, atol=1e-4)
    R = se2.rotation(start[2])
    np.testing.assert_allclose(b.reflectors().cov, R @ a.reflectors().cov @ R.T, atol=1e-7)


def test_permuting_detections_changes_nothing():
    rng = np.random.default_rng(2)
    frames = frames_along(CURVE, scan=False, rng=rng)
    shuffled = []
    for f in frames:
        d, k = f.observation.detections, rng.permutation(len(f.landmarks))
        d = replace(d, points=d.points[k], cov=d.cov[k], ids=d.ids[k])
        o = replace(f.observation, detections=d)
        shuffled.append(replace(f, observation=o, landmarks=f.landmarks[k]))
    a, b = run(frames)[0], run(shuffled)[0]
    np.testing.assert_allclose(a.trajectory()[1], b.trajectory()[1], atol=1e-8)
    np.testing.assert_allclose(a.reflectors().points, b.reflectors().points, atol=1e-8)
    np.testing.assert_array_equal(a.reflectors().keys, b.reflectors().keys)


def test_two_runs_are_bit_identical():
    observed = observations(ROOM, CURVE, rng=np.random.default_rng(3))
    a, b = whole(observed), whole(observed)
    assert a.trajectory()[1].tobytes() == b.trajectory()[1].tobytes()
    for f in dataclasses.fields(a.reflectors()):
        x, y = getattr(a.reflectors(), f.name), getattr(b.reflectors(), f.name)
        assert x.tobytes() == y.tobytes()


# --- reflectors --------------------------------------------------------------------------------


def test_ghost_reflector_is_never_mapped():
    rng = np.random.default_rng(4)
    observed = []
    for o in observations(ROOM, CURVE, scan=False, rng=rng):
        points = np.vstack([o.detections.points, rng.uniform(-8.0, 8.0, (1, 2))])
        observed.append(replace(o, detections=detections_of(points, o.stamp)))
    found = whole(observed).reflectors()
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors[None], axis=-1)
    assert len(found) == len(ROOM.reflectors)
    assert gap.min(axis=1).max() < 0.05


def test_duplicates_are_merged_and_their_name_goes_on():
    rng = np.random.default_rng(5)
    n, half = len(ROOM.reflectors), len(CURVE) // 2
    # in the second half the front end took reflector 2 for a new one, 99
    second = np.where(np.arange(n) == 2, 99, np.arange(n))
    frames = frames_along(
        CURVE, scan=False, rng=rng, landmarks=lambda k: np.arange(n) if k < half else second
    )
    # a keyframe that saw it under both names would prove two: none did here
    back_end, _ = run([f for f in frames if abs(f.stamp - FIRST - half * STEP) > 6 * STEP])
    found = back_end.reflectors()
    np.testing.assert_array_equal(found.keys, np.arange(n))
    assert back_end.reflector_graph.resolve(99) == 2
    belief = back_end.belief()
    assert belief.aliases == {99: 2}
    assert np.linalg.norm(found.points[2] - ROOM.reflectors[2]) < 0.03
    assert found.sightings[2] == found.sightings[1]


def test_neighbours_seen_together_are_never_merged():
    twins = replace(ROOM, reflectors=np.array([[2.0, 2.5], [2.15, 2.5], [-1.5, 0.0]]))
    back_end, _ = run(frames_along(CURVE, twins, scan=False, rng=np.random.default_rng(6)))
    assert len(back_end.reflectors()) == 3


def test_reflectors_keep_the_id_and_the_diameter_that_some_detection_told():
    frames = frames_along(CURVE, scan=False, ids=True)
    changed = []
    for k, f in enumerate(frames):
        d = f.observation.detections
        ids = d.ids if k % 4 == 1 else np.full(len(d), ANONYMOUS)
        diameters = np.where(k % 4 == 2, 0.01 * d.ids, np.nan)
        o = replace(f.observation, detections=replace(d, ids=ids, diameters=diameters))
        changed.append(replace(f, observation=o, landmarks=d.ids - 100))
    found = run(changed)[0].reflectors()
    np.testing.assert_array_equal(found.ids, found.keys + 100)
    np.testing.assert_allclose(found.diameters, 0.01 * found.ids)


def test_one_outlier_of_a_known_reflector_does_not_bend_the_map():
    frames = frames_along(CURVE, scan=False)
    k = 40
    d = frames[k].observation.detections
    points = d.points.copy()
    points[1] += [2.0, -1.0]
    o = replace(frames[k].observation, detections=replace(d, points=points))
    frames[k] = replace(frames[k], observation=o)
    back_end, _ = run(frames)
    # a Cauchy loss lets a far outlier pull by 1/residual: a fraction of one detection's 2 cm
    assert errors(back_end.trajectory()[1], CURVE)[0].max() < 0.005
    np.testing.assert_allclose(back_end.reflectors().points, ROOM.reflectors, atol=0.005)


def test_belief_is_the_newest_keyframe_and_the_map_with_joint_covariance():
    back_end, _ = run(frames_along(CURVE, scan=False, rng=np.random.default_rng(7)))
    for _ in range(5):  # the linear models are those of the optimum then, not of near it
        back_end.solver.start_over()
        back_end.solver.solve()
    belief, found = back_end.belief(), back_end.reflectors()
    last = back_end.keyframes[-1]
    np.testing.assert_array_equal(belief.T_map_base, back_end.graph.poses[last.index])
    np.testing.assert_array_equal(belief.keys, found.keys)
    np.testing.assert_array_equal(belief.points, found.points)
    for k in range(len(found)):
        block = belief.cov[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k]
        np.testing.assert_allclose(block, found.cov[k], rtol=1e-6)
    assert np.linalg.eigvalsh(belief.cov).min() > 0.0
    assert belief.aliases == {}


# --- scans and closures ------------------------------------------------------------------------


def test_scan_that_the_front_end_could_not_place_is_not_mapped():
    frames = frames_along(CURVE[:40], reflectors=False)
    back_end, _ = run([replace(f, scan_used=False, scan_score=0.1) for f in frames])
    assert back_end.keyframes[0].points is not None
    assert all(k.points is None for k in back_end.keyframes[1:])


def drifted(path):
    """The path as odometry of a bent axle has it: it turns to one side."""
    out = [path[0]]
    for k in range(len(path) - 1):
        step = se2.between(path[k], path[k + 1])
        step[2] += 5e-4
        out.append(se2.compose(out[-1], step))
    return np.array(out)


@pytest.mark.parametrize('enabled', [True, False])
def test_loop_closure_closes_a_drifted_loop(enabled):
    params = Parameters(
        back_end=BackEndParameters(submap_size=8, minimum_travel_distance=0.5),
        loop_closure=LoopClosure(
            enabled=enabled, max_distance=2.5, search_window=1.5, search_angle=0.3
        ),
    )
    local = drifted(LAP)
    before = errors(local, LAP)[0][-1]
    assert before > 0.35
    back_end, updates = run(frames_along(LAP, BLOCK, local, reflectors=False), params)
    closures = [c for u in updates for c in u.closures]
    distance, turn = errors(back_end.trajectory()[1], LAP)
    # the record of one that waited and entered later stands for both
    last = {(c.i, c.j): c for c in closures}
    assert {(c.i, c.j): c for c in back_end.loop_closer.records} == last
    assert len(back_end.loop_closer.records) == len(last)
    if not enabled:
        assert closures == []
        assert distance[-1] > 0.5 * before
        return
    accepted = [c for c in closures if c.accepted]
    assert accepted
    assert all(c.score >= params.loop_closure.min_score for c in accepted)
    # what is accepted is true: to a cell, plus the drift inside the submap itself
    stamps = [k.stamp for k in back_end.keyframes]
    for c in accepted:
        i, j = ((stamps[k] - FIRST) // STEP for k in (c.i, c.j))
        edge = back_end.graph.edges.measured[c.edge]
        e, w = errors(edge[None], se2.between(LAP[i], LAP[j])[None])
        assert e[0] < 0.05
        assert w[0] < 0.03
    assert distance[-1] < 0.2 * before
    assert turn[-1] < 0.04
    # the correction is spread over the lap
    assert distance.max() < 0.5 * before


# --- what is collected between keyframes -------------------------------------------------------


def test_sighting_fuses_detections_by_their_information():
    rng = np.random.default_rng(8)
    s = Sighting()
    A, b = [], []
    for _ in range(3):
        L = rng.standard_normal((2, 2)) + 2.0 * np.eye(2)
        z = rng.standard_normal(2)
        s.add(z, L @ L.T)
        A.append(np.linalg.inv(L))
        b.append(np.linalg.inv(L) @ z)
    best = np.linalg.lstsq(np.vstack(A), np.concatenate(b), rcond=None)[0]
    np.testing.assert_allclose(s.z, best)
    np.testing.assert_allclose(s.information, np.vstack(A).T @ np.vstack(A))
    assert s.count == 3


def test_interval_moves_detections_into_the_frame_of_the_keyframe():
    path = drive((0.5, 0.8, 0.5), start=(1.0, 1.0, 3.0))
    interval = Interval(path[0])
    for k, pose in enumerate(path):
        d = seen_at(ROOM, pose, FIRST)
        delta = se2.between(path[k - 1], pose) if k else np.zeros(3)
        f = frame_of(Observation(FIRST, Motion(delta, 1e-6 * EYE), detections=d), pose)
        interval.add_motion(f)
        interval.add_detections(f)
    expected = se2.transform(se2.inverse(path[0]), ROOM.reflectors)
    for key, (sighting,) in interval.sightings.items():
        np.testing.assert_allclose(sighting.z, expected[key], atol=1e-9)
        assert sighting.count == len(path)
    np.testing.assert_allclose(interval.motion.delta, se2.between(path[0], path[-1]), atol=1e-12)


def test_outlier_between_keyframes_is_kept_apart():
    interval = Interval(np.zeros(3))
    for k in range(4):
        at = [[3.0, 0.0]] if k != 2 else [[4.0, 1.0]]
        o = Observation(FIRST, Motion(np.zeros(3), 1e-8 * EYE), detections=detections_of(at, 0))
        f = frame_of(o, np.zeros(3))
        interval.add_motion(f)
        interval.add_detections(f)
    counts = [g.count for g in interval.sightings[0]]
    assert counts == [3, 1]


@pytest.mark.parametrize('open_', [True, False])
def test_loop_is_closed_only_by_a_scan_that_holds_its_place(open_):
    """A corridor looks the same from everywhere in it, until it has an end."""
    graph = Graph()
    pose = np.array([0.3, 0.1, 0.05])
    keys = [
        Keyframe(graph.add_pose(p), FIRST, p, EYE, None, np.zeros(2), FIRST)
        for p in (np.zeros(3), pose)
    ]
    along = np.arange(-6.0, 6.0, 0.04)
    sides = [np.column_stack([along, np.full(len(along), y)]) for y in (-1.0, 1.2)]
    across = np.arange(-1.0, 1.2, 0.04)
    end = np.column_stack([np.full(len(across), 4.0), across])
    walls = np.concatenate(sides if open_ else [*sides, end])
    m = KeyframeSubmap(keys[0], Submap())
    for _ in range(5):
        m.submap.insert(se2.transform(se2.inverse(m.T_anchor_grid), walls), np.zeros(2))
    m.submap.complete()
    (candidate,) = candidates(graph, keys[1], [m], LoopClosure())
    seen = se2.transform(se2.inverse(pose), walls)
    found = ClosureMatcher(Parameters()).match(candidate, keys[1], seen).result
    if open_:
        assert found.why == 'the scan does not constrain one direction'
    else:
        at = se2.compose(m.T_anchor_grid, found.T_grid_key)
        np.testing.assert_allclose(at, pose, atol=0.03)


def test_submaps_end_where_the_motion_after_them_is_not_known():
    """After a gap whose end matches nothing, a submap of both sides would bind them wrongly."""
    path = drive((0.6, 0.0, 6.0), (0.5, 0.3, 6.0))
    frames = frames_along(path)
    gap, lost = len(frames) // 2, np.diag([0.2, 0.7, 0.3]) ** 2

    def widened(frame, cov):
        """The error of the gap, carried along the way since then."""
        J, _ = se2.compose_jacobians(path[gap], se2.between(path[gap], frame.T_local_base))
        return replace(frame, cov_local=frame.cov_local + J @ cov @ J.T)

    def starts(cov):
        after = [widened(f, cov) for f in frames[gap:]]
        back_end = BackEnd(Parameters())
        for frame in (*frames[:gap], *after):
            back_end.add(frame)
        first = next(k for k in back_end.keyframes if k.stamp >= frames[gap].stamp)
        edges = back_end.graph.edges
        i, j = edges.nodes[edges.kinds == EDGE_KINDS[EdgeKind.SCAN]].T
        crossing = bool(((i < first.index) & (j >= first.index)).any())
        return len(back_end.scan_graph.finished), crossing

    known, across = starts(1e-6 * EYE)
    assert across
    apart, across = starts(lost)
    assert not across
    assert apart > known


@pytest.mark.parametrize('spoiled', ['pose', 'point'])
def test_no_submap_spans_a_pose_or_a_point_that_is_wrong(spoiled):
    """A pose 1e6 m away that calls itself sure would make a grid of gigabytes."""
    frames = frames_along(drive((0.6, 0.0, 12.0)))
    half, away = len(frames) // 2, np.array([1e6, -1e6, 0.0])
    for k, frame in enumerate(frames[half:], half):
        if spoiled == 'pose':
            frames[k] = replace(frame, T_local_base=frame.T_local_base + away)
        elif k < half + 20:
            points = np.vstack([frame.observation.points, [9e3, 0.0]])
            frames[k] = replace(frame, observation=replace(frame.observation, points=points))
    params = Parameters(back_end=BackEndParameters(keyframes_per_place=0))  # of all submaps
    back_end, _ = run(frames, params)
    before = len(back_end.scan_graph.finished)
    back_end.scan_graph.finish_active()
    sizes = [m.submap.values.size for m in back_end.scan_graph.finished]
    assert len(sizes) > before > 0  # others begin behind it
    assert 0 < min(sizes) <= max(sizes) < 1_000_000
    assert back_end.keyframes[-1].stamp > frames[half + 20].stamp


@pytest.mark.parametrize('size', [10, 40])
def test_error_that_keyframes_of_a_submap_share_does_not_average_out(size):
    p = BackEndParameters(submap_size=size, keyframes_per_place=0)
    floor = np.array(p.scan_edge_variance_floor)
    closures = LoopClosure(enabled=False)
    parameters = Parameters(back_end=p, loop_closure=closures)
    back_end, _ = run(frames_along(LAP, BLOCK, scan=True), parameters)
    anchors = np.array([m.anchor.index for m in back_end.scan_graph.finished])
    back_end.solver.solve()
    covs = _RelativeCovariance(back_end.solver, anchors).covs(anchors[:-1], anchors[1:])
    assert len(covs) >= 2
    # an edge to each of the two submaps; the odometry beside them is worth less
    heading = covs[:, 2, 2] / floor[2]
    assert ((heading > 1.0) & (heading < 2.2)).all()


def test_where_reflectors_are_seen_the_edges_hold_the_keyframes_of_a_submap():
    floor = np.array(BackEndParameters().scan_edge_variance_floor)

    def last_edge(reflectors):
        graph = run(frames_along(CURVE, scan=True, reflectors=reflectors))[0].graph
        scans = np.flatnonzero(graph.edges.kinds == EDGE_KINDS[EdgeKind.SCAN])
        return np.linalg.inv(graph.edges.information[scans[-1]])[2, 2] / floor[2]

    assert last_edge(reflectors=True) < 5.0  # its own variance besides
    assert last_edge(reflectors=False) > 15.0


def test_edge_of_a_scan_that_leaves_a_direction_open_enters_the_graph():
    graph, floor = Graph(), np.array(Parameters().back_end.scan_edge_variance_floor)
    for pose in (np.zeros(3), np.array([1.0, 0.0, 0.2])):
        graph.add_pose(pose)
    rng = np.random.default_rng(0)
    for k in range(300):
        # a corridor in any direction: nothing is known along it, much across it
        axis = rng.standard_normal(3)
        information = 10.0 ** rng.uniform(0.0, 7.0) * np.outer(axis, axis)
        T_grid_key = rng.uniform(-3.0, 3.0, 3)
        delta, weak = edge_of_match(TURN, T_grid_key, information, floor)
        assert graph.add_edge(EdgeKind.SCAN, 0, 1, delta, weak) == k


def test_robot_that_is_found_again_has_the_error_of_what_is_mapped_there():
    """It is lost at the end of a long way, and found at its middle, by 1 cm and .6 degrees."""
    path = drive((0.5, 0.0, 30.0))
    frames = frames_along(path, scan=False, reflectors=False)
    middle = len(path) // 2
    found = replace(frames[-1], T_local_base=path[middle], jumped=True)
    back_end, updates = run([*frames[:-1], found])
    there = int(np.argmin(np.abs(back_end.graph.poses[:-1, 0] - path[middle, 0])))
    error = back_end.solver.joint([there])
    assert error[1, 1] > 0.01**2
    assert updates[-1].optimized
    np.testing.assert_allclose(updates[-1].known.cov_map, error + 1e-4 * EYE, rtol=0.2)


# --- a robot that was found by a search --------------------------------------------------------


def led_astray(off, sigma):
    """A lap with a gap on its way, where odometry errs by ``off`` and says ``sigma``."""
    frames, gap = frames_along(LAP, BLOCK), len(LAP) // 2
    astray = se2.compose(se2.compose(LAP[gap], np.array(off)), se2.between(LAP[gap], LAP[gap:]))
    wide = np.diag(np.square(sigma))
    for k, T in enumerate(astray, gap):
        o = frames[k].observation
        if k == gap:
            delta = se2.between(LAP[k - 1], T)
            o = replace(o, motion=Motion(delta, wide))
        cov = frames[k].cov_local + wide
        frames[k] = replace(frames[k], observation=o, T_local_base=T, cov_local=cov)
    return frames, gap


def off_the_path(back_end):
    return np.linalg.norm(back_end.trajectory()[1][: len(LAP), :2] - LAP[:, :2], axis=1)


def found_at(back_end, frame, pose):
    """Closures of a frame that a search has found at a pose."""
    found = FoundPose(frame.T_local_base, pose, 100.0)
    update = back_end.add(replace(frame, stamp=frame.stamp + STEP), found)
    assert update.optimized is any(c.accepted for c in update.closures)  # at once
    return update.closures


@pytest.mark.parametrize(
    ('off', 'sigma', 'enters'),
    [((1.5, -1.0, 0.4), (1.5, 1.5, 0.4), True), ((4.0, 3.0, 1.0), (0.3, 0.3, 0.1), False)],
)
def test_way_since_a_gap_is_bent_to_where_the_robot_was_found(off, sigma, enters):
    """What was mapped since the gap moves with it; odometry that is far more certain stays."""
    p = Parameters(loop_closure=LoopClosure(enabled=False))
    frames, gap = led_astray(off, sigma)
    back_end = BackEnd(p)
    for frame in frames:
        back_end.add(frame)
    back_end.optimize()
    before = off_the_path(back_end)
    assert before[gap:].min() > 0.5
    closures = found_at(back_end, frames[-1], LAP[-1])
    assert [c.accepted for c in closures] == [enters]
    after = off_the_path(back_end)
    if enters:
        assert after.max() < 0.1
        found = se2.compose(back_end.T_map_local, frames[-1].T_local_base)
        np.testing.assert_allclose(found, LAP[-1], atol=0.05)
    else:
        np.testing.assert_allclose(after, before, atol=1e-3)
        assert 'pending' in closures[0].why


def test_robot_is_not_found_at_a_pose_where_its_scan_does_not_fit():
    frames, _ = led_astray((1.5, -1.0, 0.4), (1.5, 1.5, 0.4))
    back_end = BackEnd(Parameters(loop_closure=LoopClosure(enabled=False)))
    for frame in frames:
        back_end.add(frame)
    back_end.optimize()
    before = off_the_path(back_end)
    turned = se2.compose(LAP[-1], np.array([0.0, 0.0, np.pi]))
    assert found_at(back_end, frames[-1], turned) == ()
    np.testing.assert_allclose(off_the_path(back_end), before, atol=0.05)


def found_without_a_scan():
    """A back end that waits for a scan where the robot was found, and its newest frame."""
    frames, _ = led_astray((1.5, -1.0, 0.4), (1.5, 1.5, 0.4))
    back_end = BackEnd(Parameters())
    for frame in frames:
        back_end.add(frame)
    found = FoundPose(frames[-1].T_local_base, LAP[-1], 100.0)
    later = replace(frames[-1], stamp=frames[-1].stamp + STEP, scan_used=False)
    assert back_end.add(later, found) is None
    return back_end, later


def test_robot_that_was_found_becomes_a_keyframe_as_soon_as_a_scan_matches():
    back_end, later = found_without_a_scan()
    unsure = replace(later, stamp=later.stamp + STEP, scan_used=True, unconfirmed=True)
    assert back_end.add(unsure) is None
    assert back_end.add(replace(later, stamp=unsure.stamp + STEP, scan_used=True)) is not None
    assert back_end.add(replace(later, stamp=unsure.stamp + 2 * STEP, scan_used=True)) is None


def test_where_a_robot_was_found_is_forgotten_once_it_jumps():
    back_end, later = found_without_a_scan()
    assert back_end.add(replace(later, stamp=later.stamp + STEP, jumped=True)) is not None
    assert back_end.add(replace(later, stamp=later.stamp + 2 * STEP, scan_used=True)) is None
