# SPDX-License-Identifier: Apache-2.0
"""The reflector_detector node: in this process and as a process of its own."""

from __future__ import annotations

from array import array

import numpy as np
import pytest
from live import room

from rlml_slam.nodes.reflector_detector import ReflectorDetectorNode
from rlml_slam.params import Reflector
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.point_cloud import read_cloud
from rlml_slam.types import ANONYMOUS, Health, Level

CLOUD = 'sensor_msgs/msg/PointCloud2'
FIELDS = ('x', 'y', 'id', 'sigma_range', 'sigma_bearing', 'diameter', 'intensity')


def use(node, items):
    """Give the node the messages; the scans and the simulated detections by stamp."""
    scans, markers = [], {}
    for stream, msg in items:
        if stream == 'reflectors':
            seen = decode.detections(msg, Reflector())
            markers[seen.stamp] = seen
            continue
        node.sensors.add(stream, msg)
        if stream == 'scan':
            scans.append(msg)
    return scans, markers


@pytest.fixture
def node(live):
    live.listen('reflectors', CLOUD)
    node = live.start(ReflectorDetectorNode, detector__flat_width=0.12)
    node.sensors.stop_waiting()
    live.spin_until(lambda: node.count_subscribers('reflectors') == 1)
    return node


def test_every_scan_gets_its_cloud_with_its_stamp_and_frame(live, node):
    scans, markers = use(node, room(seconds=6.0))
    live.spin_until(lambda: len(live.heard['reflectors']) >= len(scans) - 3)
    stamps = {decode.stamp(s, 'scan') for s in scans}
    near = total = 0
    for msg in live.heard['reflectors']:
        assert decode.stamp(msg, 'reflectors') in stamps
        assert msg.header.frame_id == scans[0].header.frame_id
        assert read_cloud(msg).dtype.names == FIELDS
        seen = decode.detections(msg, Reflector())
        assert (seen.ids == ANONYMOUS).all()
        marked = markers.get(seen.stamp)
        if marked is None or not len(seen):
            continue
        # the simulated detections have 2 cm and 3 mrad of noise, and now and then a ghost
        apart = np.linalg.norm(seen.points[:, None] - marked.points, axis=-1).min(axis=1)
        near += int((apart < 0.1).sum())
        total += len(seen)
    assert total > 50
    assert near >= 0.8 * total


def test_diagnostics_count_what_was_found_and_rejected(live, node):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    use(node, room(seconds=2.0))
    live.spin_until(lambda: len(live.heard['/diagnostics']) >= 1)
    (status,) = live.heard['/diagnostics'][0].status
    values = {v.key: v.value for v in status.values}
    assert status.level == b'\x00'
    assert int(values['scans']) >= 15
    assert int(values['reflectors']) > 0
    assert int(values['scan used']) == int(values['scans'])


def test_a_scan_without_intensities_is_told_and_gets_no_cloud(live, node):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    for stream, msg in room(seconds=2.0):
        if stream == 'scan':
            msg.intensities = []
        if stream != 'reflectors':
            node.sensors.add(stream, msg)
    live.spin_until(lambda: len(live.heard['/diagnostics']) >= 1)
    status = live.heard['/diagnostics'][0].status[0]
    assert status.level == b'\x01'
    assert status.message == 'scans have no intensities'
    live.drain()
    assert not live.heard['reflectors']


def test_a_scan_with_no_reflector_gets_an_empty_cloud(live, node):
    for stream, msg in room(seconds=2.0):
        if stream == 'scan':
            msg.intensities = [0.01 + 0.001 * (k % 3) for k in range(len(msg.ranges))]  # dark
        if stream != 'reflectors':
            node.sensors.add(stream, msg)
    live.spin_until(lambda: live.heard['reflectors'])
    assert all(m.width == 0 for m in live.heard['reflectors'])


def spoiled(msg, kind):
    """A scan whose intensities show nothing."""
    n = len(msg.ranges)
    if kind == 'no range':
        msg.ranges = [np.nan] * n
    elif kind == 'one value':
        # what did not return has another one
        msg.ranges[: n // 2] = array('f', [np.inf] * (n // 2))
        msg.intensities = [0.0] * (n // 2) + [47.0] * (n - n // 2)
    else:
        msg.intensities = [] if kind == 'none' else [float(kind)] * n


@pytest.mark.parametrize(
    ('kind', 'reason'),
    [
        ('none', 'scans have no intensities'),
        ('0', 'all beams of a scan have the intensity 0'),
        ('nan', 'no beam has a valid range and intensity'),
        ('no range', 'no beam has a valid range and intensity'),
        ('one value', 'all beams of a scan have the intensity 47'),
    ],
)
def test_intensities_that_vanish_are_named_and_get_no_cloud(live, node, kind, reason):
    live.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    items = [(stream, msg) for stream, msg in room(seconds=4.0) if stream != 'reflectors']
    for stream, msg in items[: len(items) // 2]:
        node.sensors.add(stream, msg)
    assert node.health.health() == Health()
    node.health.publish()
    before = node.health.counts['scans']
    live.drain()
    sent = len(live.heard['reflectors'])
    for stream, msg in items[len(items) // 2 :]:
        if stream == 'scan':
            spoiled(msg, kind)
        node.sensors.add(stream, msg)
    assert node.health.health() == Health(Level.DEGRADED, (reason,))
    live.drain()
    late = [m for m in live.heard['reflectors'][sent:] if m.width == 0]
    assert len(live.heard['reflectors']) - sent <= 2, len(late)  # scans that waited
    assert node.health.counts['scans without intensities'] >= 15
    assert node.health.counts['scans'] > before


def test_the_process_detects_what_it_hears_and_ends_cleanly(live, start):
    live.listen('reflectors', CLOUD)
    process = start('reflector_detector', '--ros-args', '-p', 'detector.flat_width:=0.12')
    live.spin_until(lambda: live.ear.count_publishers('reflectors') == 1, timeout=60.0)
    simulator = start(
        'simulator', '--ros-args', '-p', 'world:=room', '-p', 'markers.enabled:=false',
        '-p', 'duration:=4.0', '-p', 'wait_for_subscribers:=1',
    )  # fmt: skip
    live.spin_until(lambda: len(live.heard['reflectors']) >= 10, timeout=60.0)
    assert any(m.width > 0 for m in live.heard['reflectors'])
    assert simulator.finish()[0] == 0
    process.interrupt()
    code, out = process.finish()
    assert code == 0, out


def test_a_wrong_parameter_is_one_line_and_exit_code_1(start):
    process = start('reflector_detector', '--ros-args', '-p', 'detector.threshold:=magic')
    code, out = process.finish()
    assert code == 1
    assert 'detector.threshold' in out
    assert 'Traceback' not in out
