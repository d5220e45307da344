# SPDX-License-Identifier: Apache-2.0
"""The front end node: what it hears, what it says, and what it does with bad input."""

from __future__ import annotations

import copy
import dataclasses
import re
import time
from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from live import LATCHED, room

from rlml_slam import se2
from rlml_slam.errors import InputError, ParameterError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.correction_message import build_correction
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_associated
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.sensing.synchronization.synchronizer import CONFIRM
from rlml_slam.slam.conversation import Correct
from rlml_slam.types import Health, Level, Status

SECOND = 1_000_000_000


def feed(node, seconds, change=lambda stream, msg: msg):
    """Give the sample bag to the node; ``change`` may alter or drop (None) a message."""
    sent = []
    for stream, msg in room(seconds=seconds):
        changed = change(stream, msg)
        if changed is not None:
            node.sensors.add(stream, changed)
            sent.append((stream, changed))
    return sent


def stamps(sent, stream):
    return [decode.stamp(m, stream) for s, m in sent if s == stream]


@pytest.fixture
def node(live):
    for topic, kind in (
        ('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped'),
        ('/front_end/odometry', 'nav_msgs/msg/Odometry'),
        ('reflectors/associated', 'sensor_msgs/msg/PointCloud2'),
        ('reflectors/statuses', 'visualization_msgs/msg/MarkerArray'),
        ('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray'),
    ):
        live.listen(topic, kind)
    node = live.start(FrontEndNode)
    node.sensors.stop_waiting()
    live.spin_until(lambda: node.count_subscribers('pose') == 1)
    return node


def used(node, stream, what='used'):
    return node.sensors.synchronizer.inputs.totals().get(stream, {}).get(what, 0)


def test_each_scan_gets_a_pose_with_its_own_stamp(live, node):
    sent = feed(node, 3.0)
    live.drain()
    got = [decode.stamp(m, '') for m in live.heard['pose']]
    want = stamps(sent, 'scan')
    assert got == want[: len(got)]
    # the last scan may still wait for odometry
    assert len(want) - 1 <= len(got) <= len(want)
    assert [decode.stamp(m, '') for m in live.heard['/front_end/odometry']] == got


def test_local_pose_moves_on_without_jumps_and_with_its_twist(live, node):
    feed(node, 6.0)
    live.drain()
    local = live.heard['/front_end/odometry']
    assert {m.header.frame_id for m in local} == {'rlml_local'}
    assert {m.child_frame_id for m in local} == {'base_link'}
    poses = np.array([decode.planar_pose(m.pose.pose, '') for m in local])
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    speeds = np.array([np.hypot(m.twist.twist.linear.x, m.twist.twist.linear.y) for m in local])
    # 10 Hz scans; an arc is longer than its chord by less than 1 % at these turn rates
    np.testing.assert_allclose(speeds[1:] * 0.1, steps, rtol=0.01, atol=1e-6)
    assert steps.max() < 0.15


def test_detections_are_told_what_became_of_them(live, node):
    feed(node, 3.0)
    live.drain()
    last = read_associated(live.heard['reflectors/associated'][-1])
    assert last.detections.frame_id == 'base_link'
    assert (last.statuses == Status.USED).sum() >= 2
    assert (last.landmarks[last.statuses == Status.USED] >= 0).all()
    drawn = live.heard['reflectors/statuses'][-1].markers
    green = next(m for m in drawn if m.ns == 'used')
    assert len(green.points) == (last.statuses == Status.USED).sum()
    heard = [read_associated(m).statuses for m in live.heard['reflectors/associated']]
    live.heard['/diagnostics'].clear()
    node.health.publish()
    live.spin_until(lambda: live.heard['/diagnostics'])
    shown = {v.key: v.value for v in live.heard['/diagnostics'][0].status[0].values}
    for status in Status:
        count = int((np.concatenate(heard) == status).sum())
        assert shown[f'detections {status.name.lower()}'] == str(count)


def correction(node, T_map_local, cov=None, session=None):
    """Of the newest frame, as the back end sends it."""
    session = node.control.session.session if session is None else session
    return build_correction(make, Correct(session, node.last.stamp, T_map_local, cov), 'map')


def test_correction_moves_the_map_pose_only(live, node):
    feed(node, 2.0)
    T_map_local = np.array([1.0, -2.0, 0.5])
    node.control.on_correction(correction(node, T_map_local, np.eye(3)))
    frame = node.front_end.process(node.last.observation)
    np.testing.assert_allclose(
        frame.T_map_base, se2.compose(T_map_local, frame.T_local_base), atol=1e-12
    )


def test_correction_says_how_well_its_frame_is_known_in_the_map(live, node):
    feed(node, 2.0)
    cov = np.diag([0.04, 0.01, 0.02])
    node.control.on_correction(correction(node, np.zeros(3), cov))
    _, cov_map = node.front_end.in_map(node.last.T_local_base, node.last.cov_local)
    np.testing.assert_allclose(cov_map, cov, atol=1e-12)


@pytest.mark.parametrize('again', [lambda c: c.restart(), lambda c: c.start_at(start_at_five())])
def test_correction_of_an_old_session_means_nothing(live, node, again):
    feed(node, 2.0)
    stamp, observation = node.last.stamp, node.last.observation
    late = correction(node, np.array([1.0, -2.0, 0.5]), np.eye(3))
    again(node.control)
    node.control.on_correction(late)
    session = node.control.session
    # not even where a frame of the new session has the same stamp
    for later in (stamp + SECOND, stamp):
        frame = session.process(dataclasses.replace(observation, stamp=later)).frame
        np.testing.assert_array_equal(frame.T_map_base, frame.T_local_base)
        node.control.on_correction(late)


def start_at_five():
    pose = np.array([5.0, 6.0, 1.0])
    return encode.pose_with_covariance(make, 0, 'map', pose, 0.01 * np.eye(3))


def test_initialpose_begins_anew_there(live, node):
    feed(node, 2.0)
    start = np.array([5.0, 6.0, 1.0])
    node.control.start_at(
        encode.pose_with_covariance(make, 99 * SECOND, 'map', start, 0.01 * np.eye(3))
    )
    np.testing.assert_allclose(node.front_end.state.pose, start)


def test_initialpose_without_stamp_is_of_now_and_of_another_frame_is_none(live, node):
    feed(node, 2.0)
    start, cov = np.array([5.0, 6.0, 1.0]), 0.01 * np.eye(3)
    with pytest.raises(InputError, match="frame_id is 'odom' instead"):
        node.control.start_at(encode.pose_with_covariance(make, SECOND, 'odom', start, cov))
    assert node.front_end.state.pose[0] < 2.0
    node.control.start_at(encode.pose_with_covariance(make, 0, 'map', start, cov))
    np.testing.assert_allclose(node.front_end.state.pose, start)


def test_initialpose_of_an_earlier_frame_is_moved_on_to_now(live, node):
    feed(node, 2.0)
    live.drain()
    then = live.heard['/front_end/odometry'][-5]
    moved = se2.between(decode.planar_pose(then.pose.pose, ''), node.last.T_local_base)
    assert moved[0] > 0.1
    start, stamp = np.array([5.0, 6.0, 1.0]), decode.stamp(then, '')
    node.control.start_at(encode.pose_with_covariance(make, stamp, 'map', start, 0.01 * np.eye(3)))
    np.testing.assert_allclose(node.front_end.state.pose, se2.compose(start, moved), atol=1e-9)


def test_diagnostics_tell_health_and_inputs(live, node):
    live.drain()
    live.heard['/diagnostics'].clear()
    # nothing is spun in between, so that the first one heard is not of the node's timer
    feed(node, 3.0)
    node.health.publish()
    live.spin_until(lambda: live.heard['/diagnostics'])
    status = live.heard['/diagnostics'][0].status[0]
    assert status.name == 'front_end'
    assert status.level == bytes([0])
    assert {v.key: v.value for v in status.values}['scan used'] == str(used(node, 'scan'))


def test_silence_is_told(live, node):
    node.health.publish()
    live.spin_until(lambda: live.heard['/diagnostics'])
    assert 'no input yet' in live.heard['/diagnostics'][0].status[0].message


@pytest.mark.parametrize(
    ('before', 'then'), [(Level.OK, Level.DEGRADED), (Level.LOST, Level.LOST)]
)
def test_silence_makes_health_no_better(live, node, before, then):
    feed(node, 2.0)
    node.health.update(dataclasses.replace(node.last, health=Health(before, ('why',))))
    node.health.publish()
    live.drain()
    live.heard['/diagnostics'].clear()
    node.health.publish()
    live.spin_until(lambda: live.heard['/diagnostics'])
    status = live.heard['/diagnostics'][0].status[0]
    assert status.level == bytes([then])
    assert 'why' in status.message
    assert 'no new scan' in status.message


# --- bad input ------------------------------------------------------------------------------


def test_ranges_that_are_no_ranges_cost_only_themselves(live, node):
    bad = np.array([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e30], dtype=np.float32)

    def spoil(stream, msg):
        if stream == 'scan':
            ranges = np.array(msg.ranges)
            ranges[::7] = np.resize(bad, len(ranges[::7]))
            msg.ranges = ranges.tolist()
        return msg

    sent = feed(node, 3.0, spoil)
    assert used(node, 'scan') >= len(stamps(sent, 'scan')) - 1
    assert np.isfinite(node.last.T_local_base).all()
    assert node.last.health.reasons == ()


def test_empty_scan_is_counted_and_the_next_is_used(live, node):
    seen = []

    def spoil(stream, msg):
        if stream == 'scan':
            seen.append(msg)
            if len(seen) == 5:
                msg.ranges, msg.intensities = [], []
        return msg

    sent = feed(node, 3.0, spoil)
    assert used(node, 'scan', 'invalid') == 1
    # the detections of that instant still give a pose
    assert len(live_frames(live)) >= len(stamps(sent, 'scan')) - 1


def live_frames(live):
    live.drain()
    return live.heard['pose']


def test_wrong_frame_is_counted_and_named(live, node):
    def spoil(stream, msg):
        if stream == 'scan' and decode.stamp(msg, '') > 3 * SECOND:
            msg.header.frame_id = 'camera'
        return msg

    feed(node, 3.0, spoil)
    assert used(node, 'scan', 'invalid') > 5
    assert "scan in frame 'camera'" in node.sensors.synchronizer.inputs.last_error


def test_burst_of_old_messages_beside_new_ones_does_not_restart_the_front_end(live, node):
    feed(node, 6.0)
    index = {stream: k for k, (stream, _) in enumerate(node.sensors._queues)}
    burst: dict[int, list] = {}
    for stream, msg in room(['/scan', '/odom', '/imu'], seconds=7.0):
        since = decode.stamp(msg, '') / SECOND - 1.0
        if 1.0 < since < 4.0 or 6.0 < since < 7.0:
            burst.setdefault(index[stream], []).append((stream, msg))
    session = node.control.session.session
    node.sensors._take(burst)
    assert node.control.session.session == session
    assert used(node, 'scan', 'late') > 20
    assert node.sensors.synchronizer.delay._poses  # the poses of the node get there
    assert node.last.stamp / SECOND - 1.0 > 6.5


def test_first_refusal_of_a_stream_is_told_on_the_console(live, node, monkeypatch):
    said = []
    monkeypatch.setattr(node.sensors, '_logger', SimpleNamespace(warning=said.append, info=print))
    for stream, msg in room(['/scan', '/odom'], seconds=1.0):
        if stream == 'scan':
            msg.ranges = msg.intensities = array('f')
        node.sensors.add(stream, msg)
    (text,) = said
    assert re.fullmatch(r'scan: not used: scan at \d+ ns: it is empty', text)


def test_each_reason_of_a_stream_is_on_the_console_once(live, node, monkeypatch):
    said = []
    monkeypatch.setattr(node.sensors, '_logger', SimpleNamespace(warning=said.append, info=print))
    for k, (_, msg) in enumerate(room(['/scan'], seconds=3.0)):
        if k % 3 == 0:
            msg.ranges = msg.intensities = array('f')
        elif k % 3 == 1:
            msg.header.stamp.sec = msg.header.stamp.nanosec = 0
        else:
            msg.angle_increment = 0.0
        node.sensors.add('scan', msg)
    reasons = [re.sub(r'\d+', '#', text) for text in said]
    assert len(set(reasons)) == len(reasons) == 3, said
    for k in range(1000):  # reasons without end
        node.sensors._count_invalid('scan', 'x' * k)
    assert len(said) == 100


def test_what_never_came_is_told_once(live, node, monkeypatch):
    said = []
    monkeypatch.setattr(node.sensors, '_logger', SimpleNamespace(warning=said.append, info=print))
    node.sensors.flush_if_silent()
    assert said == []
    (index,) = (k for k, (stream, _) in enumerate(node.sensors._queues) if stream == 'scan')
    _, scan = next(iter(room(['/scan'], seconds=2.0)))
    node.sensors.receive(index, scan)
    now = time.monotonic()
    monkeypatch.setattr(time, 'monotonic', lambda: now + 6.0)
    node.sensors.flush_if_silent()
    node.sensors.flush_if_silent()
    assert said == ['waiting for odom on /odom']


def test_missing_odometry_does_not_stop_the_poses(live, node):
    sent = feed(node, 4.0, lambda stream, msg: None if stream == 'odom' else msg)
    # the first second is the wait for odometry that may come
    assert len(live_frames(live)) >= len(stamps(sent, 'scan')) - 15


def test_missing_reflectors_and_imu_do_not_stop_the_poses(live, node):
    sent = feed(node, 3.0, lambda stream, msg: msg if stream in ('odom', 'scan') else None)
    assert len(live_frames(live)) >= len(stamps(sent, 'scan')) - 1


def test_duplicates_are_counted_once(live, node):
    for stream, msg in room(seconds=2.0):
        node.sensors.add(stream, msg)
        node.sensors.add(stream, msg)
    for stream in ('odom', 'imu', 'scan', 'reflectors'):
        assert used(node, stream, 'duplicate') >= used(node, stream) > 0
    poses = [decode.stamp(m, '') for m in live_frames(live)]
    assert len(set(poses)) == len(poses)


def test_late_and_future_messages_are_counted_and_harmless(live, node):
    sent = feed(node, 3.0)
    early = next(m for s, m in sent if s == 'scan')
    future = copy.deepcopy(early)
    future.header.stamp.sec += 1000
    before = node.last
    node.sensors.add('scan', early)
    node.sensors.add('scan', future)
    assert used(node, 'scan', 'late') == 1
    assert node.last is before
    # what comes next shows whether time did go on
    stream, last = next((s, m) for s, m in reversed(sent) if s == 'odom')
    for k in range(1, CONFIRM + 1):
        after = copy.deepcopy(last)
        after.header.stamp.nanosec = (last.header.stamp.nanosec + k * 10_000_000) % SECOND
        after.header.stamp.sec += (last.header.stamp.nanosec + k * 10_000_000) // SECOND
        node.sensors.add(stream, after)
    assert used(node, 'scan', 'future') == 1
    assert node.last.stamp < decode.stamp(future, 'scan')


@pytest.mark.parametrize('sec', [0, -5])
def test_stamps_that_are_not_positive_are_refused(live, node, sec):
    _, msg = next(room(['/scan']))
    msg.header.stamp.sec, msg.header.stamp.nanosec = sec, 0
    node.sensors.add('scan', msg)
    assert used(node, 'scan', 'invalid') == 1
    assert 'header.stamp' in node.sensors.synchronizer.inputs.last_error


def test_odometry_that_is_not_finite_is_refused(live, node):
    def spoil(stream, msg):
        if stream == 'odom' and decode.stamp(msg, '') % SECOND == 0:
            msg.pose.pose.position.x = float('nan')
        return msg

    feed(node, 3.0, spoil)
    assert used(node, 'odom', 'invalid') >= 2
    assert np.isfinite(node.last.T_local_base).all()


def test_clock_that_jumps_back_begins_anew(live, node):
    for _, msg in room(['/odom']):
        msg.header.stamp.sec += 100
        node.sensors.add('odom', msg)
    feed(node, 2.0)
    assert used(node, 'scan') >= 15
    assert decode.stamp(live_frames(live)[-1], '') < 5 * SECOND


@pytest.mark.parametrize('number', [0, 2**32, 2_147_483_647 * SECOND + 9])
def test_map_with_a_number_that_no_request_has_spoils_no_pose(live, node, number):
    feed(node, 2.0)
    before = node.last.stamp
    grid = OccupancyGrid(0.05, (0.0, 0.0), np.zeros((9, 9), dtype=np.int8))
    with pytest.raises(InputError, match='rlml/localization_grid: '):
        node.control.on_grid(encode.occupancy_grid(make, number, 'map', grid))
    none = make('sensor_msgs/msg/PointCloud2', header=encode.header(make, number, 'map'))
    with pytest.raises(InputError, match='rlml/localization_map: '):
        node.control.on_map(none)
    feed(node, 4.0)
    assert node.last.stamp > before
    assert not guard_of(node).refused


# --- the place of the laser -----------------------------------------------------------------


def test_scans_wait_for_the_place_of_the_laser(live):
    node = live.start(FrontEndNode, use_reflectors=False)
    node.sensors._waits = True  # as where there is tf2_msgs
    scans = [(s, m) for s, m in room(['/scan', '/odom'], seconds=2.0)]
    for stream, msg in scans[:10]:
        node.sensors.add(stream, msg)
    assert used(node, 'scan') == 0
    place = encode.transform(make, SECOND, ('base_link', 'laser'), np.array([0.3, 0.1, 0.0]))
    node.sensors.extrinsics.add(decode.transforms(place))
    for stream, msg in scans[10:]:
        node.sensors.add(stream, msg)
    n = len([1 for s, _ in scans if s == 'scan'])
    assert used(node, 'scan') >= n - 1
    np.testing.assert_allclose(node.last.observation.origin, [0.3, 0.1], atol=1e-6)


@pytest.mark.parametrize('nanosec', [0, SECOND])
def test_stamp_that_no_clock_has_ends_no_wait_for_the_place_of_the_laser(live, nanosec):
    node = live.start(FrontEndNode, use_reflectors=False)
    node.sensors._has_tf = node.sensors._waits = True
    scans = [m for _, m in room(['/scan'], seconds=1.0)]
    bad = copy.deepcopy(scans[0])
    bad.header.stamp.sec, bad.header.stamp.nanosec = 0, nanosec
    for msg in (bad, scans[0], bad, scans[1]):
        node.sensors.add('scan', msg)
    assert node.sensors._waits
    assert node.sensors.synchronizer.inputs.totals()['scan'] == {'invalid': 2}


@pytest.mark.skipif(
    rclpy_class('tf2_msgs/msg/TFMessage') is None, reason='tf2_msgs is not installed: make tf'
)
def test_tf_static_tells_the_place_of_the_laser(live):
    node = live.start(FrontEndNode)
    place = encode.transform(make, SECOND, ('base_link', 'laser'), np.array([0.3, 0.1, 0.0]))
    publisher = live.ear.create_publisher(
        rclpy_class('tf2_msgs/msg/TFMessage'), '/tf_static', LATCHED
    )
    publisher.publish(encode.tf_message(make, [place]))
    live.spin_until(lambda: node.sensors.extrinsics.pose('base_link', 'laser') is not None)
    np.testing.assert_allclose(node.sensors.extrinsics.pose('base_link', 'laser'), [0.3, 0.1, 0.0])


@pytest.mark.parametrize(('given', 'expected'), [([0.0, 0.0, 0.0], 1), ([0.2, 0.0, 0.0], 0)])
def test_place_of_the_laser_that_nobody_gave_makes_health_degraded(live, given, expected):
    node = live.start(FrontEndNode, laser_pose=given)
    node.sensors._has_tf = node.sensors._waits = True
    queues = {stream: k for k, (stream, _) in enumerate(node.sensors._queues)}
    for stream, msg in room(['/scan', '/odom'], seconds=4.0):
        node.sensors.receive(queues[stream], msg)
    assert used(node, 'scan') > 10
    node.health.publish()
    found = [p for p in node.problems() if "no transform to 'laser'" in p]
    assert len(found) == expected
    assert (node.health.health().level is Level.DEGRADED) == bool(expected)
    place = encode.transform(make, SECOND, ('base_link', 'laser'), np.array(given))
    node.sensors.extrinsics.add(decode.transforms(place))  # where it was taken to be
    for stream, msg in room(['/scan', '/odom'], seconds=4.5):
        if decode.stamp(msg, stream) > node.last.stamp:
            node.sensors.receive(queues[stream], msg)
    assert not any('no transform' in p for p in node.problems())


def test_place_that_was_assumed_is_no_problem_of_a_driver_that_names_another_frame(live):
    node = live.start(FrontEndNode)
    node.sensors._has_tf = node.sensors._waits = True
    queues = {stream: k for k, (stream, _) in enumerate(node.sensors._queues)}
    place = encode.transform(make, SECOND, ('base_link', 'mounted'), np.zeros(3))
    for n, (stream, msg) in enumerate(room(['/scan', '/odom'], seconds=6.0)):
        if n == 100:
            assert any('no transform' in p for p in node.problems())
            node.sensors.extrinsics.add(decode.transforms(place))
        if n >= 100 and stream == 'scan':
            msg.header.frame_id = 'mounted'
        node.sensors.receive(queues[stream], msg)
    assert not any('no transform' in p for p in node.problems())


def test_scan_in_an_unknown_frame_holds_up_nothing_and_never_gets_laser_pose(live):
    """Neither as the first message of all, nor later."""
    node = live.start(FrontEndNode, laser_pose=[5.0, 5.0, 0.0])
    node.sensors._has_tf = node.sensors._waits = True
    place = encode.transform(make, SECOND, ('base_link', 'laser'), np.array([0.3, 0.1, 0.0]))
    node.sensors.extrinsics.add(decode.transforms(place))
    waiting, scans = [], 0
    for stream, msg in room(['/scan', '/odom'], seconds=4.0):
        if stream == 'scan':
            other = copy.deepcopy(msg)
            other.header.frame_id = 'camera'
            node.sensors.add(stream, other)
            scans += 1
            waiting.append(scans - used(node, 'scan'))
        node.sensors.add(stream, msg)
    # a scan waits for the odometry behind it
    assert max(waiting) <= 3
    assert used(node, 'scan') >= scans - 1
    assert node.sensors.synchronizer.inputs.totals()['scan']['invalid'] == scans
    np.testing.assert_allclose(node.last.observation.origin, [0.3, 0.1], atol=1e-6)


def test_parameter_serves_where_nobody_tells_the_place_of_the_laser(live):
    node = live.start(FrontEndNode, laser_pose=[0.3, 0.1, 0.0])
    sent = feed(node, 4.0)
    assert used(node, 'scan') >= len(stamps(sent, 'scan')) - 1
    np.testing.assert_allclose(node.last.observation.origin, [0.3, 0.1])


@pytest.mark.parametrize(
    'place', [{}, {'laser_pose': [0.2, 0.0, 0.0]}, {'rotation': (0.6, 0.0, 0.0, 0.8)}]
)
def test_map_goes_on_where_the_place_of_the_laser_comes_late_and_is_no_other(live, place):
    """The same as ``laser_pose``, or not planar, which is refused; or with none at all."""
    given = {k: v for k, v in place.items() if k == 'laser_pose'}
    node = live.start(FrontEndNode, **given)
    node.sensors._has_tf = node.sensors._waits = True
    messages = list(room(seconds=6.0))
    for stream, msg in messages[: len(messages) // 2]:
        node.sensors.add(stream, msg)
    before = node.control.session.session
    late = encode.transform(make, SECOND, ('base_link', 'laser'), np.array([0.2, 0.0, 0.0]))
    if 'rotation' in place:
        r = late.transform.rotation
        r.x, r.y, r.z, r.w = place['rotation']
    if place:
        node.sensors.extrinsics.add(decode.transforms(late))
    for stream, msg in messages[len(messages) // 2 :]:
        node.sensors.add(stream, msg)
    assert node.control.session.session == before


def test_front_end_starts_again_where_the_place_of_the_laser_comes_late(live):
    node = live.start(FrontEndNode)
    node.sensors._has_tf = node.sensors._waits = True
    messages = list(room(seconds=6.0))
    place = encode.transform(make, SECOND, ('base_link', 'laser'), np.array([0.2, 0.0, 0.0]))
    for stream, msg in messages[: len(messages) // 2]:
        node.sensors.add(stream, msg)
    before = node.control.session.session
    np.testing.assert_allclose(node.last.observation.origin, [0.0, 0.0])
    node.sensors.extrinsics.add(decode.transforms(place))
    for stream, msg in messages[len(messages) // 2 :]:
        node.sensors.add(stream, msg)
    assert node.control.session.session != before
    np.testing.assert_allclose(node.last.observation.origin, [0.2, 0.0], atol=1e-6)
    sessions = node.control.session.session
    for stream, msg in messages[-2:]:
        node.sensors.add(stream, msg)
    assert node.control.session.session == sessions  # once


# --- parameters -----------------------------------------------------------------------------


def test_wrong_value_refuses_to_start(live):
    with pytest.raises(ParameterError, match=r'submap.resolution = -1.0 is outside \[0.01, 1\]'):
        live.start(FrontEndNode, submap__resolution=-1.0)


def test_topics_are_relative_and_named_by_parameters(live):
    node = live.start(FrontEndNode, scan_topic='front/scan')
    # the node of the test before may still be in the graph
    live.spin_until(
        lambda: node.count_subscribers('front/scan') == 1 and not node.count_subscribers('scan')
    )


def test_scans_do_not_overtake_odometry_after_a_pause(live, node):
    publishers = {}
    for stream, msg in room(seconds=4.0):
        if stream not in publishers:
            publishers[stream] = live.ear.create_publisher(type(msg), stream, 1000)
    live.spin_until(
        lambda: all(p.get_subscription_count() == 1 for p in publishers.values()),
        what='no connection to the node',
    )
    sent = 0
    for stream, msg in room(seconds=4.0):
        publishers[stream].publish(msg)
        sent += stream == 'scan'
    live.spin_until(lambda: used(node, 'scan') >= sent - 1)
    assert used(node, 'scan', 'waited_out') == used(node, 'scan', 'late') == 0
    assert node.last.observation.motion.known


@pytest.mark.parametrize(('second', 'expected'), [('laser', 1), ('rear', 0)])
def test_two_lidars_in_one_frame_are_a_problem(live, second, expected):
    node = live.start(FrontEndNode, scan_topics=['front', 'rear/scan'])
    node.sensors.stop_waiting()
    for stream, msg in room(['/scan'], seconds=1.0):
        assert stream == 'scan'
        node.sensors.receive(0, msg)
        other = copy.deepcopy(msg)
        other.header.frame_id = second
        node.sensors.receive(1, other)
    found = [p for p in node.problems() if "all in the frame 'laser'" in p]
    assert len(found) == expected
    assert not found or '/front and /rear/scan' in found[0]


def test_several_lidars_answer_each_on_their_own(live):
    """A second lidar looks backwards from the same place: its rays are the first one's, turned."""
    live.listen('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped')
    node = live.start(FrontEndNode, scan_topics=['front', 'rear/scan'], laser_pose=[0.2, 0.0, 0.0])
    node.sensors.stop_waiting()
    # the node of the test before may still be in the graph
    live.spin_until(
        lambda: [node.count_subscribers(t) for t in ('front', 'rear/scan', 'scan')] == [1, 1, 0]
    )
    place = encode.transform(make, SECOND, ('base_link', 'rear'), np.array([0.2, 0.0, np.pi]))
    node.sensors.extrinsics.add(decode.transforms(make_transforms(place)))
    live.spin_until(lambda: node.count_subscribers('pose') == 1)
    sent = []
    for stream, msg in room(seconds=4.0):
        node.sensors.add(stream, msg)
        if stream == 'scan':
            rear = copy.deepcopy(msg)
            rear.header.frame_id = 'rear'
            rear.angle_min -= np.pi
            rear.angle_max -= np.pi
            node.sensors.add('scan', rear)
            sent += [msg, rear]
    counts = node.sensors.synchronizer.inputs.totals()['scan']
    assert counts['used'] >= len(sent) - 2
    assert 'late' not in counts
    assert 'duplicate' not in counts
    poses = live_frames(live)
    assert len(poses) == counts['used']
    np.testing.assert_allclose(node.last.observation.origin, [0.2, 0.0], atol=1e-9)
    speeds = [m.twist.twist.linear.x for m in live.heard['/front_end/odometry']]
    assert np.max(np.abs(speeds), initial=0.0) < 2.0


def make_transforms(*transforms):
    """What /tf_static would carry, without tf2_msgs."""
    from types import SimpleNamespace

    return SimpleNamespace(transforms=list(transforms))


def test_bad_input_over_dds_is_counted_in_the_diagnostics(live, node):
    """Eight scans, one second apart in the bag, each with a fault of its own; the rest is used.

    One that has a wrong number of intensities is used without them.
    """

    def all_nan(msg):
        msg.ranges = [float('nan')] * len(msg.ranges)

    def empty(msg):
        msg.ranges, msg.intensities = [], []

    def short_intensities(msg):
        msg.intensities = [1.0]

    def another_frame(msg):
        msg.header.frame_id = 'camera'

    def no_geometry(msg):
        msg.angle_increment = float('nan')

    def no_stamp(msg):
        msg.header.stamp.sec, msg.header.stamp.nanosec = 0, 0

    def backward(msg):
        msg.header.stamp.sec -= 1

    def future(msg):
        msg.header.stamp.sec += 500

    faults = [
        all_nan, empty, short_intensities, another_frame, no_geometry, no_stamp, backward, future
    ]  # fmt: skip
    messages, scans = [], 0
    for stream, msg in room(seconds=9.0):
        if stream == 'scan':
            scans += 1
            if scans % 10 == 0:
                faults[scans // 10 - 1](msg)
        messages.append((stream, msg))
        if scans == 85:
            break
    publishers = {s: live.ear.create_publisher(type(m), s, 1000) for s, m in messages}
    live.spin_until(lambda: all(p.get_subscription_count() == 1 for p in publishers.values()))
    sent = 0
    for stream, msg in messages:
        publishers[stream].publish(msg)
        if stream == 'scan':
            sent += 1
            # best effort: what is sent faster than it is read may be lost. Every instant gives a
            # pose, by its detections where not by its scan, soon after it
            live.spin_until(lambda due=sent - 5: len(live.heard['pose']) >= due)
    figures = {}

    def answered():
        for m in live.heard['/diagnostics']:
            figures.update({v.key: v.value for v in m.status[0].values})
        return int(figures.get('scan used', 0)) >= scans - 7

    live.spin_until(answered)
    assert int(figures['scan invalid']) == 4
    assert int(figures['scan late']) == int(figures['scan future']) == 1
    assert int(figures['scan no_returns']) == 1
    assert 's ahead of all other stamps' in figures['last refused input']
    # whatever the scans were, the detections of their instants gave poses
    live.drain()
    assert len(live.heard['pose']) >= scans - 1
    poses = np.array([decode.planar_pose(m.pose.pose, '') for m in live.heard['pose']])
    assert np.isfinite(poses).all()
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.2


def test_unknown_parameter_is_told_and_harmless(live, monkeypatch):
    """One file may serve all nodes, so an unknown name is no error; a near one is suggested."""
    from rclpy.impl.rcutils_logger import RcutilsLogger

    said = []
    monkeypatch.setattr(RcutilsLogger, 'warning', lambda self, text, **_: said.append(text))
    live.start(FrontEndNode, scan_topik='x')
    assert any("unknown parameter 'scan_topik'" in s and "'scan_topic'" in s for s in said)


def test_pose_of_a_user_waits_for_no_scan_that_waits_as_well(live, node):
    """Where the machine is too slow, all sensors have the next scans by the time it is heard."""
    sent = feed(node, 2.0)
    talk = live.ear.create_publisher(rclpy_class('geometry_msgs/msg/PoseWithCovarianceStamped'),
                                     'initialpose', 10)  # fmt: skip
    live.spin_until(lambda: talk.get_subscription_count() == 1)
    last = stamps(sent, 'scan')[-1]
    talk.publish(encode.pose_with_covariance(make, last, 'map', np.ones(3), 1e-4 * np.eye(3)))
    before = node.control.session.session
    later = (item for item in room(seconds=20.0) if decode.stamp(item[1], item[0]) > last)
    for stream, msg in later:  # nothing is spun
        node.sensors.add(stream, msg)
        if stream == 'scan':
            time.sleep(0.05)
        if node.control.session.session != before:
            break
    assert node.control.session.session != before
    assert decode.stamp(msg, stream) < last + 15 * SECOND
