# SPDX-License-Identifier: Apache-2.0
"""What the recorder hears becomes a run."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import numpy as np
import pytest
from made_runs import reflectors
from numpy.testing import assert_allclose, assert_array_equal

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import Odometry, Path  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402

from rlml_slam.cli.support.recorder import Recorder  # noqa: E402
from rlml_slam.maps.occupancy import OccupancyGrid  # noqa: E402
from rlml_slam.motion import STILL  # noqa: E402
from rlml_slam.ros.codecs import encode  # noqa: E402
from rlml_slam.ros.codecs.frame_messages import build_points, build_record  # noqa: E402
from rlml_slam.ros.codecs.message_types import make_rclpy as make  # noqa: E402
from rlml_slam.ros.codecs.reflector_clouds import (  # noqa: E402
    build_associated,
    build_reflector_map,
)
from rlml_slam.ros.codecs.serialized_path import serialized_path  # noqa: E402
from rlml_slam.ros.codecs.update_message import build_update  # noqa: E402
from rlml_slam.ros.sensors import LATCHED  # noqa: E402
from rlml_slam.slam.back_end.back_end import Update  # noqa: E402
from rlml_slam.slam.closures.loop_closure import Closure  # noqa: E402
from rlml_slam.slam.conversation import SessionFrame  # noqa: E402
from rlml_slam.types import Detections, Frame, Health, Level, Observation, Scan  # noqa: E402

SECOND = 1_000_000_000


@pytest.fixture
def recorder(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rclpy.init(args=[], domain_id=10 + os.getpid() % 90)
    node = Recorder()
    yield node
    node.destroy_node()
    rclpy.utilities.try_shutdown()


def pose(k, x):
    cov = np.diag([1e-4, 1e-4, 1e-6])
    return encode.pose_with_covariance(make, k * SECOND, 'map', np.array([x, 0.0, 0.1]), cov)


def truth(k, x):
    frames, none = ('map', 'base_link'), np.zeros((3, 3))
    return encode.odometry(make, k * SECOND, frames, np.array([x, 0.0, 0.1]), none)


def scan(k):
    ranges = np.ones(10, np.float32)
    none = np.zeros(0, np.float32)
    s = Scan(k * SECOND + 7, 'laser', 0.0, 0.1, 0.0, 0.1, 30.0, ranges, none)
    return serialize_message(encode.laser_scan(make, s))


def record(of):
    """The message of a frame."""
    return build_record(make, SessionFrame(1, of), 'local')


def frame(k, level, wall_ms):
    observation = Observation(k * SECOND, STILL)
    place, cov, none = np.zeros(3), np.eye(3), np.zeros(0, np.int64)
    return Frame(
        k * SECOND, observation, place, cov, place, cov, none, none, Health(level), wall_ms=wall_ms
    )


def test_poses_and_truth_become_errors(recorder):
    for k in range(1, 5):
        recorder.on_truth(truth(k, 0.5 * k))
        recorder.on_pose(pose(k, 0.5 * k + 0.02))
    assert recorder.distance == pytest.approx(1.5)
    assert recorder.error() == pytest.approx(0.02)
    assert 'error 2.0 cm' in recorder.note()
    run = recorder.run('drive')
    assert_array_equal(run.frames.stamps, [k * SECOND for k in range(1, 5)])
    assert run.truth.is_map
    assert_allclose(run.truth.trajectory.poses[:, 0], [0.5, 1.0, 1.5, 2.0])


def test_scan_is_paired_with_its_pose_by_stamp(recorder):
    recorder.on_sensor(scan(3))
    assert recorder.sensed == 1
    answer = pose(3, 0.0)
    recorder.on_pose(answer)
    assert recorder.latency_ms == []  # 7 ns off: another stamp
    answer.header.stamp.nanosec = 7
    recorder.on_pose(answer)
    assert len(recorder.latency_ms) == 1


def test_points_whose_stamp_no_clock_has_are_of_no_pose(recorder):
    for stamp in (SECOND, 2 * SECOND):
        msg = build_points(make, stamp, 'base_link', np.ones((3, 2)))
        msg.header.stamp.nanosec += SECOND * (stamp == SECOND)
        recorder.on_points(serialize_message(msg))
    assert list(recorder.frames.scans.stamps) == [2 * SECOND]


def test_scans_outside_the_last_trajectory_have_their_live_poses(recorder):
    for k in range(1, 6):
        recorder.on_pose(pose(k, 10.0 * k))
    stamps = [2 * SECOND, 3 * SECOND]
    path = serialized_path(1, 'map', np.array(stamps), np.array([[2.0, 0, 0], [3.0, 0, 0]]))
    recorder.map.use_path(deserialize_message(path, Path))
    t = recorder.trajectory()
    assert_array_equal(t.stamps, SECOND * np.arange(1, 6))
    assert_allclose(t.poses[:, 0], [10.0, 2.0, 3.0, 40.0, 50.0])


def test_products_of_the_back_end_are_kept(recorder):
    cells = np.array([[-1, 0, 100], [0, 0, 0]], dtype=np.int8)
    grid = OccupancyGrid(0.0333333, (-1.0, 2.0), cells)
    recorder.map.use_grid(encode.occupancy_grid(make, 1, 'map', grid))
    known = reflectors([[1.0, 2.0], [3.0, 4.0]])
    recorder.on_reflectors(build_reflector_map(make, 1, 'map', known))
    points = np.array([[1.0, 2.0]])
    true = Detections(
        SECOND, 'map', points, np.zeros((1, 2, 2)), np.array([7]), np.array([np.nan])
    )
    recorder.on_true_reflectors(encode.detections(make, true))
    recorder.on_truth(truth(1, 0.0))
    run = recorder.run('drive')
    assert_array_equal(run.grid.cells, cells)
    assert (run.grid.resolution, run.grid.origin) == (0.0333333, (-1.0, 2.0))
    assert_allclose(run.reflectors.points, known.points)
    assert_array_equal(run.truth.reflector_ids, [7])


def test_health_and_inputs_are_those_of_the_diagnostics(recorder):
    figures = {'frames': 3, 'scan used': 12, 'scan late': 1, 'odom used': 40}
    bad = Health(Level.DEGRADED, ('saw 0 of 4', 'no odometry'))
    recorder.on_diagnostics(encode.diagnostics(make, 2 * SECOND, 'front_end', bad, figures))
    recorder.on_diagnostics(encode.diagnostics(make, 3 * SECOND, 'front_end', Health(), figures))
    for k, level in ((1, Level.OK), (2, Level.DEGRADED), (3, Level.OK)):
        recorder.on_pose(pose(k, 0.0))
        recorder.on_frame(record(frame(k, level, wall_ms=0.5 * k)))
    run = recorder.run('drive')
    assert run.frames.levels == [0, 1, 0]
    assert run.frames.reasons == [(), ('saw 0 of 4', 'no odometry'), ()]
    assert run.frames.wall_ms == [0.5, 1.0, 1.5]
    assert run.inputs == {
        'scan': {'used': 12, 'late': 1, 'invalid': 0},
        'odom': {'used': 40, 'late': 0, 'invalid': 0},
    }


def test_recorder_waits_for_poses_and_for_the_map(recorder):
    now = time.monotonic()
    recorder.on_sensor(scan(10))
    assert not recorder.has_caught_up(now)
    answer = pose(10, 0.0)
    answer.header.stamp.nanosec = 7
    recorder.on_pose(answer)
    assert not recorder.has_caught_up(now)
    for stamp, done in ((9 * SECOND, False), (10 * SECOND + 7, True)):
        path = serialized_path(stamp, 'map', np.array([stamp]), np.zeros((1, 3)))
        recorder.map.take('trajectory', path)
        recorder.on_diagnostics(encode.diagnostics(make, stamp - 1, 'front_end', Health(), {}))
        assert not recorder.has_caught_up(now)
        recorder.on_diagnostics(encode.diagnostics(make, stamp, 'front_end', Health(), {}))
        assert recorder.has_caught_up(now) is done
        assert recorder.has_caught_up(now - 60.0)


def test_every_keyframe_tells_its_cost_and_its_closures(recorder):
    def closure(edge):
        return Closure(0, 1, np.zeros(3), 0.6, edge, '')

    closures = (closure(-1), closure(5), closure(-1))
    for k, update in enumerate(
        (Update(0, np.zeros(3), False, (), 2.0), Update(1, np.zeros(3), True, closures, 7.5))
    ):
        place = np.array([1.0, 2.0])
        recorder.on_update(build_update(make, (k + 1) * SECOND, 'map', place, update))
    run = recorder.run('drive')
    assert_array_equal(run.back_end_ms, [2.0, 7.5])
    assert run.rejected == 2
    assert '2 keyframes, 1 closures' in recorder.note()


def test_frames_and_their_detections_in_either_order_are_there_to_be_audited(recorder):
    for k in range(1, 6):
        z = np.array([[2.0 + k, 1.0], [4.0, 0.5]])
        none = np.full(2, np.nan)
        d = Detections(k * SECOND, 'base_link', z, np.tile(1e-4 * np.eye(2), (2, 1, 1)),
                       np.full(2, -1), none)  # fmt: skip
        f = frame(k, Level.OK, 0.0)
        f = replace(
            f, T_map_base=np.array([0.5 * k, 0.0, 0.0]),
            observation=replace(f.observation, detections=d),
            landmarks=np.zeros(2, np.int64), statuses=np.zeros(2, np.int64),
        )  # fmt: skip
        recorder.on_pose(pose(k, 0.5 * k))
        associated = build_associated(make, f, 'base_link')
        if k % 2:
            recorder.on_frame(record(f))
            recorder.on_associated(associated)
        else:
            recorder.on_associated(associated)
            recorder.on_frame(record(f))
    log = recorder.run('drive').frames.sightings
    seen = log.sightings(np.zeros(0, np.int64), np.zeros((0, 3)))
    assert_allclose(seen.poses[:, 0], [0.5, 1.0, 1.5, 2.0, 2.5])
    assert_array_equal(seen.scan, np.repeat(np.arange(5), 2))
    assert_allclose(seen.points[::2, 0], [3.0, 4.0, 5.0, 6.0, 7.0])


def test_message_that_cannot_be_used_ends_no_run(recorder):
    bad = truth(1, 0.0)
    bad.pose.pose.position.x = float('nan')
    published = recorder.create_publisher(Odometry, 'ground_truth', 10)
    mapped = recorder.create_publisher(Path, 'trajectory', LATCHED)
    deadline = time.monotonic() + 20.0
    while not (published.get_subscription_count() and mapped.get_subscription_count()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    stampless = Path(poses=[PoseStamped()])
    stampless.poses[0].header.stamp.sec = -1
    mapped.publish(stampless)
    published.publish(bad)
    published.publish(truth(2, 1.0))
    while not (recorder.true and recorder.map.newest):
        assert time.monotonic() < deadline
        rclpy.spin_once(recorder, timeout_sec=0.1)
    assert list(recorder.true) == [2 * SECOND]
    recorder.on_pose(pose(2, 1.0))
    run = recorder.run('drive')
    assert list(run.frames.stamps) == [2 * SECOND]
    assert recorder.message_guard.refused == {'ground_truth': 1, 'trajectory': 1}
