# SPDX-License-Identifier: Apache-2.0
"""deformable_slam beside a simulated carrier over DDS, and what it does with single messages."""

from __future__ import annotations

import dataclasses
import math
from itertools import islice, pairwise

import numpy as np
import pytest
from rclpy.qos import QoSProfile

from rlml_lab.carrier.carrier import simulate_carrier
from rlml_lab.carrier.carrier_messages import CarrierMessages, build_velocity, read_features
from rlml_lab.carrier.carrier_parameters import Carrier, CarrierParameters
from rlml_lab.deformable import study_deformable_node as study
from rlml_lab.deformable.scoring import chi2_bounds
from rlml_slam.deformable.window import CarrierVelocity
from rlml_slam.errors import InputError
from rlml_slam.nodes.deformable_slam import DeformableSlamNode
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_rclpy as make

SECOND = 1_000_000_000
SECONDS = 12
DEEP = QoSProfile(depth=2000)
TOPICS = {
    'pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'features': 'sensor_msgs/msg/PointCloud2',
    'markers': 'visualization_msgs/msg/MarkerArray',
    'cmd_vel_suggested': 'geometry_msgs/msg/Twist',
}


def arguments(**values):
    return ['--ros-args', *(a for k, v in values.items() for a in ('-p', f'{k}:={v}'))]


def by_stamp(messages):
    return {decode.stamp(m, ''): m for m in messages}


@pytest.mark.parametrize(('kind', 'ids'), [('train', True), ('conveyor', False)])
def test_processes_follow_a_carrier_within_their_covariances(kind, ids):
    """Simulator and node over DDS, as ``rlml-lab study deformable --node`` judges them."""
    heard = []
    drive = study.run_node(kind, SECONDS / 60.0, 0, ids, 4.0, heard.append)
    # one answer per detections, at most a few of which were lost by best effort
    assert drive.asked == 10 * SECONDS + 1
    assert 0.95 * drive.asked < drive.answered <= drive.asked
    assert heard[-1] > 0.95
    assert len(drive.pose) > 0.9 * drive.asked
    assert len(drive.features) > 4 * len(drive.pose)
    # the mean over a run varies less than one sample, whose 99.9 % bounds these are
    summary = study.summarize({kind: [drive]})
    found = dict(study.claims(summary))
    assert found[f'{kind}: NEES of the pose is consistent'], summary[kind]
    assert found[f'{kind}: NEES of the features is consistent'], summary[kind]
    assert found[f'{kind}: memory grows by less than 4 MB']
    assert np.percentile(drive.pose, 99) < chi2_bounds(3, 1, 0.9999)[1]


@pytest.mark.parametrize(
    ('node', 'name', 'value'),
    [
        ('deformable_slam', 'deformable.suggest', 'loudly'),
        ('rlml_lab.carrier.carrier_simulator', 'rate', -1.0),
    ],
)
def test_wrong_parameter_is_one_line_and_exit_code_1(start, node, name, value):
    code, out = start(node, *arguments(**{name: value})).finish()
    assert code == 1
    lines = [line for line in out.splitlines() if line]
    assert len(lines) == 1, out
    assert f'{name.split(".")[-1]} = ' in lines[0]


# --- in this process ------------------------------------------------------------------------


def messages(count, **settings):
    """(topic, message) of a simulated drive."""
    convertible = CarrierMessages(make, CarrierParameters())
    for step, after in islice(pairwise(simulate_carrier(Carrier(**settings), 0)), count):
        yield from convertible(step, after)


def feed(node, count=30, skip=(), **settings):
    for topic, msg in messages(count, **settings):
        if topic in skip:
            continue
        if topic == 'carrier_velocity':
            node.velocity.accept(msg)
        elif topic in ('odom', 'reflectors'):
            node.sensors.add(topic, msg)


def start_node(live, **values):
    noise = {k.replace('.', '__'): v for k, v in study.noise_parameters().items()}
    node = live.start(DeformableSlamNode, **noise, **values)
    node.sensors.stop_waiting()
    return node


def test_answers_are_published_at_the_rate_and_stamps_of_the_detections(live):
    topics = ('pose', 'features', 'markers')
    for topic in topics:
        live.listen(topic, TOPICS[topic], DEEP)
    node = start_node(live)
    live.spin_until(lambda: all(node.count_subscribers(topic) == 1 for topic in topics))
    feed(node, 30)
    newest = node.slam.estimate.stamp
    live.spin_until(lambda: all(live.heard[topic] for topic in topics))
    live.drain()
    stamps = list(by_stamp(live.heard['pose']))
    assert set(np.diff(stamps)) == {SECOND // 10}
    assert stamps[-1] == newest == max(by_stamp(live.heard['features']))
    got, estimate = decode.pose_estimate(live.heard['pose'][-1]), node.slam.estimate
    np.testing.assert_allclose(got.pose, estimate.pose, atol=1e-12)
    np.testing.assert_allclose(got.cov, estimate.cov, atol=1e-12)
    found = read_features(live.heard['features'][-1])
    # coordinates travel as float32
    np.testing.assert_allclose(found.points, estimate.features.points, atol=1e-5)
    np.testing.assert_allclose(found.cov, estimate.features.cov, rtol=1e-5, atol=1e-9)
    assert found.ids.tolist() == estimate.features.ids.tolist()
    names = [m.ns for m in live.heard['markers'][-1].markers]
    assert names.count('ellipses') == len(found.keys) == 6


def test_suggestions_are_off_by_default(live):
    node = start_node(live)
    assert node.count_publishers('cmd_vel_suggested') == 0


@pytest.mark.parametrize('drive', ['omnidirectional', 'differential'])
def test_suggestions_keep_up_with_the_carrier(live, drive):
    live.listen('cmd_vel_suggested', TOPICS['cmd_vel_suggested'], DEEP)
    node = start_node(live, deformable__suggest=drive, reflector__max_range=4.0)
    live.spin_until(lambda: node.count_subscribers('cmd_vel_suggested') == 1)
    feed(node, 20)
    live.spin_until(lambda: len(live.heard['cmd_vel_suggested']) > 10)
    twist = live.heard['cmd_vel_suggested'][-1]
    # within plan_offset, 0.5 m/s, of the carrier's velocity; an arc is a little longer
    assert np.hypot(twist.linear.x - 1.0, twist.linear.y) < 0.8
    assert (twist.linear.y == 0.0) or drive == 'omnidirectional'


def diagnosis(live):
    def stamped():
        return [m for m in live.heard['/diagnostics'] if m.header.stamp.sec]

    live.spin_until(stamped, what='no diagnostics')
    return stamped()[0].status[0]


def test_diagnostics_tell_what_is_missing(live):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', DEEP)
    node = start_node(live)
    feed(node, 30, skip=('carrier_velocity',))
    status = diagnosis(live)
    assert status.level == b'\x01'
    assert 'no carrier_velocity yet' in status.message
    assert 'features' in {v.key for v in status.values}


def test_diagnostics_are_ok_where_nothing_is_missing(live):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', DEEP)
    node = start_node(live)
    live.spin_until(lambda: node.count_subscribers('/diagnostics') == 1)
    feed(node, 30)
    node.health.publish()
    status = diagnosis(live)
    assert (status.level, status.message) == (b'\x00', 'OK')
    values = {v.key: v.value for v in status.values}
    assert values['features'] == '6'
    assert 0.0 < float(values['CPU time of an update, p99 [ms]']) < 100.0


def test_velocity_in_the_robots_axes_is_turned_into_the_maps(live):
    node = start_node(live)
    start = np.array([0.0, 0.0, math.pi / 2])
    node.start_at(encode.pose_with_covariance(make, SECOND, 'map', start, np.zeros((3, 3))))
    ahead = CarrierVelocity(np.array([1.0, 0.0]), 0.2)
    node.velocity.accept(build_velocity(make, SECOND, 'base_link', ahead))
    node.velocity.accept(build_velocity(make, 2 * SECOND, 'map', ahead))
    history = node.slam._velocities
    for begin, expected in ((SECOND, [0.0, 1.0]), (2 * SECOND, [1.0, 0.0])):
        mean = history.mean(begin, begin + SECOND).in_map(math.pi / 2)
        np.testing.assert_allclose(mean.linear, expected, atol=1e-12)


@pytest.mark.parametrize(
    ('axes', 'linear'), [('wagon', [1.0, 0.0]), ('map', [np.nan, 0.0]), ('map', [0.0, np.inf])]
)
def test_velocity_that_cannot_be_believed_changes_nothing(live, axes, linear):
    node = start_node(live)
    velocity = CarrierVelocity(np.array(linear))
    node.velocity.accept(build_velocity(make, SECOND, axes, velocity))
    assert node.slam._velocities.age(2 * SECOND) is None


def test_initial_pose_begins_anew_there(live):
    node = start_node(live)
    feed(node, 10)
    there = np.array([5.0, -2.0, 1.0])
    node.start_at(encode.pose_with_covariance(make, SECOND, 'map', there, 0.04 * np.eye(3)))
    feed_more = [m for topic, m in messages(11) if topic in ('odom', 'reflectors')][-2:]
    for topic, msg in zip(('odom', 'reflectors'), feed_more, strict=True):
        node.sensors.add(topic, msg)
    with pytest.raises(InputError, match="frame_id is 'odom' instead"):
        node.start_at(encode.pose_with_covariance(make, SECOND, 'odom', -there, 0.04 * np.eye(3)))
    # the next observation is the first of the new beginning: its motion is not used
    np.testing.assert_allclose(node.slam.estimate.pose, there, atol=1e-9)
    np.testing.assert_allclose(np.diag(node.slam.estimate.cov), 0.04, rtol=0.01)


def test_clock_that_jumps_back_begins_anew(live):
    node = start_node(live, tf_buffer_duration=1.0)
    feed(node, 40)
    feed(node, 30)
    assert node.slam.estimate.stamp == SECOND + 29 * SECOND // 10
    assert len(node.slam.estimate.features.keys) == 6


def test_empty_detections_move_the_carrier_on(live):
    node = start_node(live)
    feed(node, 20)
    before = node.slam.estimate
    empty = []
    for topic, msg in islice(messages(25), 20 * 5, None):
        if topic == 'reflectors':
            seen = decode.detections(msg, decode.Reflector())
            none = np.zeros(0)
            msg = encode.detections(make, dataclasses.replace(
                seen, points=np.zeros((0, 2)), cov=np.zeros((0, 2, 2)), diameters=none,
                ids=none.astype(np.int64),
            ))  # fmt: skip
        if topic == 'carrier_velocity':
            node.velocity.accept(msg)
        elif topic in ('odom', 'reflectors'):
            node.sensors.add(topic, msg)
            empty.append(topic)
    after = node.slam.estimate
    assert after.stamp == before.stamp + SECOND // 2
    shift = after.features.points.mean(0) - before.features.points.mean(0)
    # 1 m/s for half a second; sway and speed change it by a tenth
    np.testing.assert_allclose(shift, [0.5, 0.0], atol=0.1)
    assert np.all(np.trace(after.features.cov, axis1=1, axis2=2)
                  > np.trace(before.features.cov, axis1=1, axis2=2))  # fmt: skip
