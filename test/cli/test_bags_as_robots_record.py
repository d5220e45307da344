# SPDX-License-Identifier: Apache-2.0
"""A bag of scans with intensities, /tf and /tf_static alone just works."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlml_slam.cli.main import main
from rlml_slam.evaluation.metrics import metrics
from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.sensing.mirror import mirrored_scan
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.types import Odometry, Scan

SECOND = 1_000_000_000
R2000 = Path(__file__).resolve().parents[3] / 'shared/data/reflector-r2000/r2000_locate0.bag'
MOUNT = np.array([0.3, 0.0, 0.1])
FOOT = np.array([0.0, 0.1, 0.0])
ROOM = ('--seed', '1', '--set', 'wheels.rate=20', '--set', 'gyro.rate=25')


def write(path, tf, scans=20, topics=('/scan', '/tf'), storage='mcap'):
    """A short bag: ``tf`` makes the transforms of the k-th tenth of a second."""
    with BagWriter(path, storage) as bag:
        bag.add_topic(topics[0], 'sensor_msgs/msg/LaserScan')
        bag.add_topic(topics[1], 'tf2_msgs/msg/TFMessage')
        for k in range(scans):
            stamp = (k + 10) * SECOND // 10
            bag.write(topics[1], encode.tf_message(make_bag, tf(stamp, k)), stamp)
            ranges = np.full(90, 2.0, np.float32)
            scan = Scan(stamp, 'laser', -1.0, 0.02, 0.0, 0.1, 10.0, ranges, 0.0 * ranges)
            bag.write(topics[0], encode.laser_scan(make_bag, scan), stamp)
    return path


def transforms(*edges):
    """The same chain at every instant; a pose None is that of the drive."""

    def of(stamp, k):
        drive = np.array([0.05 * k, 0.0, 0.01 * k])
        return [
            encode.transform(make_bag, stamp, (parent, child), drive if T is None else T)
            for parent, child, T in edges
        ]

    return of


class Target:
    def __init__(self):
        self.poses, self.places = [], {}

    def set_sensor_pose(self, frame_id, T):
        self.places[frame_id] = T

    def add_transform(self, sample):
        self.poses.append(sample)
        return []

    def add_scan(self, scan):
        return []


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize(
    ('edges', 'frames'),
    [
        ([('odom', 'base_link', None), ('base_link', 'laser', MOUNT)], ('odom', 'base_link')),
        (
            [('odom', 'base_footprint', None), ('base_footprint', 'base_link', FOOT),
             ('base_link', 'laser', MOUNT)],
            ('odom', 'base_link'),
        ),
        ([('/odom', '/base_link', None), ('/base_link', '/laser', MOUNT)], ('odom', 'base_link')),
        (
            [('odom', 'base_footprint', None), ('base_footprint', 'laser', MOUNT)],
            ('odom', 'base_footprint'),
        ),
        (
            [('r1/odom', 'r1/base_link', None), ('r1/base_link', 'laser', MOUNT),
             ('map', 'r1/odom', FOOT)],
            ('r1/odom', 'r1/base_link'),
        ),
        (
            [('odom_combined', 'base_link', None), ('base_link', 'laser', MOUNT)],
            ('odom_combined', 'base_link'),
        ),
    ],
    ids=['plain', 'footprint', 'slashes', 'no base_link', 'namespace', 'another odom'],
)  # fmt: skip
def test_frames_of_the_recording_are_found(tmp_path, edges, frames, storage):
    path = write(tmp_path / 'bag', transforms(*edges), storage=storage)
    with BagReader(path) as bag:
        inputs = BagInputs(bag, Parameters())
        n = inputs.params.node
        assert (n.odom_frame, n.base_frame) == frames
        assert inputs.has_odometry_on_tf
        assert inputs.sources()['odom'] == f'/tf, {frames[0]} to {frames[1]}'
        target = Target()
        feed = SensorInput(inputs.params, target, InputCounts())
        feed.use_extrinsics(inputs.extrinsics)
        for _, stream, message in inputs:
            feed.add(stream, message)
    assert len(target.poses) == 20
    step = target.poses[-1].pose - target.poses[0].pose
    assert isinstance(target.poses[0], Odometry)
    assert step[2] == pytest.approx(0.19)
    np.testing.assert_allclose(target.places['laser'], MOUNT, atol=1e-9)


def test_topics_by_other_names_are_found_by_their_type(tmp_path):
    edges = [('odom', 'base_link', None), ('base_link', 'laser', MOUNT)]
    topics = ('/sick/front', '/robot/tf')
    path = write(tmp_path / 'bag', transforms(*edges), topics=topics)
    with BagReader(path) as bag:
        inputs = BagInputs(bag, Parameters())
    assert inputs.sources() == {
        'scan': '/sick/front', 'odom': '/robot/tf, odom to base_link'
    }  # fmt: skip


def test_odometry_of_the_topic_can_be_asked_for(tmp_path):
    edges = [('odom', 'base_link', None), ('base_link', 'laser', MOUNT)]
    path = write(tmp_path / 'bag', transforms(*edges))
    p = Parameters()
    with BagReader(path) as bag:
        inputs = BagInputs(bag, replace(p, node=replace(p.node, odom_source='topic')))
    assert not inputs.has_odometry_on_tf


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp('room')
    main(['simulate', 'room', str(folder / 'topics'), *ROOM])
    main(['simulate', 'room', str(folder / 'tf'), *ROOM, '--tf-only'])
    return folder


@pytest.fixture(scope='module')
def with_topics(recorded):
    """The figures of the drive with topics, without the IMU, which /tf does not have."""
    p = Parameters()
    return metrics(replay(recorded / 'topics', replace(p, node=replace(p.node, use_imu=False))))


def test_trajectory_and_reflectors_are_as_with_the_topics(recorded, with_topics):
    """Without the IMU, which such a bag does not have.

    A laser of 1440 beams measures a reflector at least as well as the simulated detector, 2 cm and
    3 mrad. One of 360 beams, 17 mrad apart, does not, whatever is done with them.
    """
    topics = with_topics
    run = replay(recorded / 'tf', Parameters())
    alone = metrics(run)
    assert alone['health']['OK'] == 1.0
    for error in ('live_ate_rmse_m', 'ate_rmse_m', 'reflector_rmse_m'):
        assert alone[error] <= 1.05 * topics[error], error
    assert alone['reflectors_found'] == topics['reflectors_found'] == alone['reflectors_true']
    assert alone['reflectors_spurious'] == alone['reflectors_twice'] == 0
    assert run.topics['odom'] == '/tf, odom to base_link'
    assert run.topics['reflectors'].startswith('intensities of the scans: ')
    assert 'as bright as anything diffuse' in run.topics['reflectors']


def levels(bright):
    """Four levels, of which 0 is everything diffuse: 8192 to 24576."""
    return 8192.0 * np.clip(np.floor(np.log2(np.maximum(bright / 3000.0, 0.5))), 0.0, 3.0)


def bytes_of(bright):
    """0 to 255, compressed and saturated by most reflectors."""
    return np.clip(np.round(60.0 * np.sqrt(bright / 1000.0)), 0.0, 255.0)


def as_recorded(source, target, brightness):
    """The bag as a robot records it.

    The laser hangs and base_footprint is between odom and base_link; odometry comes at 10 Hz, 60
    ms after its stamps; another localization, an arm and wheels are on /tf; several nodes publish
    /tf_static, late and again.
    """
    kept = []
    with BagReader(source) as bag:
        start, count = bag.start, 0
        for time, topic, msg in bag.messages():
            if topic == '/tf':
                count += 1
                if count % 2:
                    stamp = decode.stamp(msg.transforms[0], '')
                    msg.transforms[0].child_frame_id = 'base_footprint'
                    other = [
                        encode.transform(
                            make_bag, stamp, frames, np.array([0.2, 0.1, 0.01 * count])
                        )
                        for frames in (('map', 'odom'), ('base_link', 'arm'))
                    ]
                    kept.append((time + 60_000_000, topic, msg))
                    kept.append((time + 60_000_001, topic, encode.tf_message(make_bag, other)))
            elif topic == '/tf_static':
                place = msg.transforms[0]
                r = place.transform.rotation
                r.x, r.y, r.z, r.w = 1.0, 0.0, 0.0, 0.0
                foot = encode.transform(
                    make_bag, start, ('base_footprint', 'base_link'), np.zeros(3)
                )
                for k in range(6):
                    one = encode.tf_message(make_bag, [(place, foot)[k % 2]])
                    kept.append((time + (k + 2) * SECOND, topic, one))
            elif topic == '/scan':
                scan = mirrored_scan(decode.scan(msg))
                bright = brightness(scan.intensities.astype(np.float64)).astype(np.float32)
                scan = replace(scan, intensities=bright)
                kept.append((time, topic, encode.laser_scan(make_bag, scan)))
            else:
                kept.append((time, topic, msg))
        kinds = {t.name: t.msgtype for t in bag.topics.values()}
    with BagWriter(target, 'sqlite3') as bag:
        for topic, kind in kinds.items():
            bag.add_topic(topic, kind, latched=topic == '/tf_static')
        for time, topic, msg in sorted(kept, key=lambda item: item[0]):
            bag.write(topic, msg, time)
    return target


@pytest.mark.parametrize(
    ('brightness', 'said', 'proposed'),
    [
        (levels, 'nothing else has an intensity', 'detector.intensity_floor: 8192.0'),
        (bytes_of, 'as bright as anything diffuse', 'detector.threshold: curve'),
    ],
    ids=['levels', 'bytes'],
)
def test_a_recording_with_all_that_robots_have(
    recorded, with_topics, tmp_path, capsys, brightness, said, proposed
):
    bag = as_recorded(recorded / 'tf', tmp_path / 'bag', brightness)
    run = replay(bag, Parameters())
    figures = metrics(run)
    assert said in run.topics['reflectors']
    assert run.topics['odom'] == '/tf, odom to base_link'
    assert figures['health']['OK'] == 1.0
    assert figures['reflectors_found'] == figures['reflectors_true']
    assert figures['reflectors_spurious'] == figures['reflectors_twice'] == 0
    # at a few levels of brightness the middle of a spot is that of its beams, not of its light
    assert figures['live_ate_rmse_m'] < 1.5 * with_topics['live_ate_rmse_m']
    assert main(['doctor', str(bag)]) == 0
    words = capsys.readouterr().out
    assert said in words
    assert 'Nothing has to be set' in words
    assert proposed in words


def test_reflectors_are_found_without_odometry_as_well(recorded):
    """Of the motion during a sweep is only known how fast a robot may be.

    It is not taken out of the detections: at 1 m/s and 0.1 s it is 10 cm for the last beams.
    """
    p = Parameters()
    figures = metrics(replay(recorded / 'tf', replace(p, node=replace(p.node, use_odom=False))))
    assert figures['reflectors_found'] == figures['reflectors_true']
    assert figures['reflectors_spurious'] == 0
    assert figures['reflector_rmse_m'] < 0.06


@pytest.mark.skipif(not R2000.exists(), reason='the shared data are not here')
def test_eight_reflectors_of_a_real_laser_at_rest():
    """R2000, 3.4 s, no odometry; against the author's list of their faces."""
    run = replay(R2000, Parameters())
    assert '7.5 times' in run.topics['reflectors']
    listed = np.array(
        [[1.263, -0.663], [1.995, -0.466], [2.495, -0.059], [2.555, 0.694], [2.206, 1.033],
         [1.202, 0.932], [0.684, 0.841], [-0.155, 1.171]]
    )  # fmt: skip
    centres = run.reflectors.points
    radius = 0.5 * run.reflectors.diameters[:, None]
    faces = centres * (1.0 - radius / np.linalg.norm(centres, axis=-1, keepdims=True))
    off = np.linalg.norm(faces[:, None] - listed, axis=-1)
    assert off.shape == (8, 8)
    assert sorted(off.argmin(axis=1)) == list(range(8))
    assert off.min(axis=1).max() < 0.02
    assert np.abs(run.frames.poses).max() < 0.003  # it is at rest


def test_doctor_finds_them_as_well(recorded, capsys):
    assert main(['doctor', str(recorded / 'tf'), '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['reflectors_mean'] > 2.0
    assert figures['margin'] > 5.0
    assert 'as bright as anything diffuse' in figures['found_by']
