# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import (
    FIRST,
    ROOM,
    SECOND,
    STEP,
    TinyWorld,
    detections_of,
    drive,
    errors,
    messages,
    polygon,
)

from rlml_slam import se2
from rlml_slam.params import Node, Parameters
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Detections, Imu, Level, Odometry, Scan

HALL = TinyWorld(
    np.vstack(
        [polygon((-4, -4), (6, -4), (6.5, 6), (-3.5, 5.5)), polygon((5, 0), (6, 0), (5, 1))]
    ),
    np.array([[-3.8, -3.5], [5.5, -3.4], [5.9, 5.2], [-3.2, 5.1], [1.0, 5.5], [2.5, -3.8]]),
)
CURVE = drive((0.6, 0.0, 2.0), (0.6, 0.6, 3.0), (0.5, -0.7, 1.0))


def add(slam, message):
    if isinstance(message, Odometry):
        return slam.add_odometry(message)
    if isinstance(message, Imu):
        return slam.add_imu(message)
    if isinstance(message, Scan):
        return slam.add_scan(message)
    assert isinstance(message, Detections)
    return slam.add_detections(message)


def run(inputs, params=None):
    """All frames, and the system afterwards."""
    slam = Slam(params or Parameters())
    frames = [f for m in inputs for f in add(slam, m)]
    return frames + slam.finish(), slam


@pytest.mark.parametrize(
    # the solver stops at a relative fall of the cost of 1e-5; a fifth of a cell with scans
    ('scan', 'reflectors', 'odometry', 'tolerance'),
    [
        (False, True, True, 1e-4),
        (True, False, True, 0.01),
        (True, True, True, 0.01),
        (False, True, False, 0.03),
        (True, False, False, 0.03),
        (True, True, False, 0.03),
    ],
)
def test_noiseless_messages_of_any_inputs_give_an_exact_path(
    scan, reflectors, odometry, tolerance
):
    sent = messages(ROOM, CURVE, scan=scan, reflectors=reflectors, odometry=odometry)
    params = Parameters(node=Node(use_odom=odometry))
    frames, slam = run(sent, params)
    assert [f.stamp for f in frames] == [FIRST + k * STEP for k in range(len(CURVE))]
    live = np.array([f.T_map_base for f in frames])
    stamps, optimised = slam.trajectory()
    np.testing.assert_array_equal(stamps, [f.stamp for f in frames])
    for path in (live, optimised):
        distance, turn = errors(path, CURVE)
        assert distance.max() < tolerance
        assert turn.max() < tolerance
    assert len(slam.reflectors()) == (len(ROOM.reflectors) if reflectors else 0)
    assert (slam.occupancy_grid() is not None) == scan
    for stream, given in (('scan', scan), ('reflectors', reflectors)):
        assert slam.counts.get(stream, {}).get('used', 0) == given * len(CURVE)


def test_odometry_alone_makes_no_frames_and_no_harm():
    frames, slam = run(messages(ROOM, CURVE, scan=False, reflectors=False))
    assert frames == []
    assert len(slam.trajectory()[0]) == len(slam.reflectors()) == 0
    assert slam.occupancy_grid() is None


def test_two_runs_are_bit_identical():
    sent = messages(ROOM, CURVE, rng=np.random.default_rng(0))
    (a, s), (b, t) = run(sent), run(sent)
    assert all(
        x.T_map_base.tobytes() == y.T_map_base.tobytes()
        and x.cov_map.tobytes() == y.cov_map.tobytes()
        for x, y in zip(a, b, strict=True)
    )
    assert s.trajectory()[1].tobytes() == t.trajectory()[1].tobytes()
    assert s.reflectors().points.tobytes() == t.reflectors().points.tobytes()
    assert s.occupancy_grid().cells.tobytes() == t.occupancy_grid().cells.tobytes()


def test_messages_may_overtake_each_other():
    rng = np.random.default_rng(1)
    sent = messages(ROOM, CURVE[:25], rng=rng)
    # scans and detections up to 80 ms late, odometry in time
    delay = [rng.uniform(0.0, 0.08) * SECOND * (not isinstance(m, Odometry)) for m in sent]
    order = np.argsort([m.stamp + d for m, d in zip(sent, delay, strict=True)], kind='stable')
    a, b = run(sent)[0], run([sent[k] for k in order])[0]
    assert [f.stamp for f in a] == [f.stamp for f in b]
    np.testing.assert_array_equal([f.T_map_base for f in a], [f.T_map_base for f in b])


def test_moving_the_start_pose_moves_the_result():
    start = (2.0, 1.0, -2.0)
    sent = messages(ROOM, CURVE, scan=False, rng=np.random.default_rng(2))
    _, a = run(sent)
    _, b = run(sent, Parameters(node=Node(map_start_pose=start)))
    distance, turn = errors(b.trajectory()[1], se2.compose(np.array(start), a.trajectory()[1]))
    # the solver stops at a relative fall of the cost of 1e-5
    assert max(distance.max(), turn.max()) < 1e-4


@pytest.mark.parametrize('scan', [False, True])
def test_reflectors_are_known_again_after_a_pause_of_everything(scan):
    """Five seconds, in which the robot goes on for metres: nothing tells where it went."""
    path = drive((0.8, 0.0, 2.0), (0.8, 0.5, 25.0), start=(0.0, -1.2, 0.0))
    sent = messages(HALL, path, scan=scan, rng=np.random.default_rng(5))
    begin = FIRST + 15 * SECOND
    sent = [m for m in sent if not begin < m.stamp < begin + 5 * SECOND]
    _, slam = run(sent, Parameters(node=Node(map_start_pose=tuple(path[0]))))
    assert len(slam.reflectors()) == len(HALL.reflectors)
    stamps, poses = slam.trajectory()
    distance, _ = errors(poses, path[(stamps - FIRST) // STEP])
    # but for the one frame that was extrapolated when the pause began
    assert np.sort(distance)[-2] < 0.1


def test_ghosts_and_broken_messages_leave_no_trace_in_the_map():
    rng = np.random.default_rng(3)
    sent = []
    for k, m in enumerate(messages(ROOM, CURVE, scan=False, rng=rng)):
        if isinstance(m, Detections):
            points = np.vstack([m.points, rng.uniform(-8.0, 8.0, (1, 2))])
            m = detections_of(points, m.stamp, frame=m.frame_id)
        sent.append(m)
        if k % 7 == 0:
            bad = np.array([[np.nan, 1.0]])
            sent.append(detections_of(bad, m.stamp + 1, frame='laser'))
            sent.append(Odometry(m.stamp + 1, np.array([np.inf, 0.0, 0.0])))
            sent.append(Imu(m.stamp + 1, float('nan')))
    frames, slam = run(sent)
    found = slam.reflectors().points
    gap = np.linalg.norm(found[:, None] - ROOM.reflectors, axis=-1)
    assert len(found) == len(ROOM.reflectors)
    assert gap.min(axis=1).max() < 0.05
    for stream in ('odom', 'imu', 'reflectors'):
        assert slam.counts[stream]['invalid'] > 0
    assert all(f.health.level is Level.OK for f in frames)


@pytest.mark.parametrize('scan', [False, True])
@pytest.mark.parametrize('odometry', [False, True])
def test_detections_in_the_sensor_itself_leave_no_trace(scan, odometry):
    """So does a driver tell of a reflector that it did not see; a place to stand gives it time."""
    path = np.vstack([np.tile(CURVE[0], (15, 1)), CURVE])
    sent = messages(ROOM, path, scan=scan, odometry=odometry, rng=np.random.default_rng(6))
    for k, m in enumerate(sent):
        if isinstance(m, Detections):
            sent[k] = detections_of(np.vstack([m.points, [[0.0, 0.0]]]), m.stamp, frame='laser')
    _, slam = run(sent, Parameters(node=Node(use_odom=odometry)))
    assert len(slam.reflectors()) == len(ROOM.reflectors)
    assert slam.counts['reflectors']['points_out_of_range'] == len(path)


def test_ids_are_used_where_detections_tell_them():
    sent = messages(ROOM, CURVE, scan=False, rng=np.random.default_rng(4), ids=True)
    frames, slam = run(sent)
    ids = slam.front_end.reflectors().ids
    np.testing.assert_array_equal(np.sort(ids), 100 + np.arange(len(ROOM.reflectors)))
    order = ids - 100
    gap = slam.front_end.reflectors().points - ROOM.reflectors[order]
    assert np.linalg.norm(gap, axis=1).max() < 0.05
    assert all(f.health.level is Level.OK for f in frames)


def test_sensor_pose_is_taken_into_account():
    T_base_laser = np.array([0.3, -0.1, 0.8])
    sent = []
    for m in messages(ROOM, CURVE, scan=False):
        if isinstance(m, Detections):
            points = se2.transform(se2.inverse(T_base_laser), m.points)
            m = replace(m, points=points)
        sent.append(m)
    slam = Slam(Parameters())
    slam.set_sensor_pose('laser', T_base_laser)
    frames = [f for m in sent for f in add(slam, m)] + slam.finish()
    assert errors(np.array([f.T_map_base for f in frames]), CURVE)[0].max() < 1e-4
    np.testing.assert_allclose(slam.reflectors().points, ROOM.reflectors, atol=1e-4)


def test_front_end_goes_on_from_the_newest_correction():
    sent = messages(ROOM, CURVE, scan=False, rng=np.random.default_rng(5))
    slam = Slam(Parameters())
    checked = 0
    for m in sent:
        for f in add(slam, m):
            optimised = slam.updates and slam.updates[-1].optimized
            if optimised and f.stamp > slam.back_end.keyframes[-1].stamp:
                T = se2.compose(slam.updates[-1].T_map_local, f.T_local_base)
                np.testing.assert_allclose(f.T_map_base, T, atol=1e-12)
                checked += 1
    assert checked > 3


def test_map_can_be_asked_for_on_the_way():
    slam = Slam(Parameters())
    for m in messages(ROOM, CURVE[:30], reflectors=False):
        add(slam, m)
    grid = slam.map().grid
    assert grid is not None
    assert (grid.cells == 100).sum() > 50
    assert len(slam.finish()) == 0
    assert len(slam.trajectory()[0]) == 30
