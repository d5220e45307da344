# SPDX-License-Identifier: Apache-2.0
import argparse
import filecmp
import json

import numpy as np
import pytest

from rlml_slam.cli import simulate
from rlml_slam.errors import BagError, FileFormatError, ParameterError
from rlml_slam.params import Reflector, SimulatorParameters, from_mapping
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Detections, Imu, Odometry, Scan

SMALL = ['--duration', '3', '--set', 'laser.beams=90', '--set', 'markers.ids=true']


def command(*arguments):
    parser = argparse.ArgumentParser()
    simulate.add_parser(parser.add_subparsers())
    args = parser.parse_args(['simulate', *map(str, arguments)])
    return args.run(args)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_bag_holds_what_the_simulation_says(tmp_path, capsys, storage):
    bag = tmp_path / 'bag'
    assert command('room', bag, '--format', storage, '--seed', 3, *SMALL, '--json') == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary['messages']['scan'] == 30
    assert summary['duration_s'] == pytest.approx(3.0)
    parameters = from_mapping(
        {'duration': 3.0, 'laser.beams': 90, 'markers.ids': True}, SimulatorParameters
    )
    simulation = Simulation(load_world('room'), parameters, seed=3)
    with BagReader(bag) as reader:
        messages = list(reader.messages())
    sensed = [m for m in messages if m[1] not in ('/tf_static', '/ground_truth_reflectors')]
    events = list(simulation)
    assert len(sensed) == len(events)
    for (time, topic, msg), event in zip(sensed, events, strict=True):
        true = event.message
        assert time == event.time
        if isinstance(true, Odometry):
            assert topic == '/odom'
            np.testing.assert_allclose(decode.odometry(msg).pose, true.pose, atol=1e-12)
        elif isinstance(true, Imu):
            assert decode.imu(msg) == true
        elif isinstance(true, Scan):
            read = decode.scan(msg)
            np.testing.assert_array_equal(read.ranges, true.ranges)
            np.testing.assert_array_equal(read.intensities, true.intensities)
            assert (read.stamp, read.frame_id) == (true.stamp, 'laser')
        elif isinstance(true, Detections):
            read = decode.detections(msg, Reflector())
            np.testing.assert_allclose(read.points, true.points, rtol=1e-6)  # float32
            np.testing.assert_allclose(read.cov, true.cov, rtol=1e-4, atol=1e-9)
            np.testing.assert_array_equal(read.ids, true.ids)
            np.testing.assert_allclose(read.diameters, true.diameters, rtol=1e-6)
        else:
            assert isinstance(true, GroundTruth)
            assert topic == '/ground_truth'
            np.testing.assert_allclose(decode.odometry(msg).pose, true.T_map_base, atol=1e-12)


def test_the_bag_tells_where_the_laser_and_the_reflectors_are(tmp_path):
    command('room', tmp_path / 'bag', *SMALL)
    with BagReader(tmp_path / 'bag') as reader:
        latched = {topic: msg for _, topic, msg in reader.messages() if topic != '/scan'}
    (T,) = decode.transforms(latched['/tf_static'])
    assert (T.parent, T.child) == ('base_link', 'laser')
    np.testing.assert_allclose(T.t, [0.2, 0.0, 0.0])
    known = decode.detections(latched['/ground_truth_reflectors'], Reflector())
    world = load_world('room')
    assert known.frame_id == 'map'
    np.testing.assert_allclose(known.points + world.start[:2], world.reflectors.points, atol=1e-5)
    np.testing.assert_array_equal(known.ids, world.reflectors.ids)


@pytest.mark.parametrize(('storage', 'suffix'), [('mcap', '.mcap'), ('sqlite3', '.db3')])
def test_the_same_arguments_give_the_same_bytes(tmp_path, storage, suffix):
    for name in ('a', 'b'):
        command('hall', tmp_path / name / 'bag', '--format', storage, *SMALL)
    assert (tmp_path / 'a/bag' / f'bag{suffix}').is_file()
    assert filecmp.cmp(tmp_path / f'a/bag/bag{suffix}', tmp_path / f'b/bag/bag{suffix}', False)


def test_odometry_carries_the_twist_of_its_steps(tmp_path):
    command(
        'room',
        tmp_path / 'bag',
        *SMALL,
        '--set',
        'wheels.speed_noise_floor=0',
        '--set',
        'wheels.speed_noise=0',
    )
    with BagReader(tmp_path / 'bag') as reader:
        twists = [decode.twist(m.twist)[0] for _, _, m in reader.messages(['/odom'])]
    assert twists[0] == 0.0
    # 1 s of standing, then 0.8 m/s^2 up to 1 m/s
    np.testing.assert_allclose(twists[-20:], 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ('arguments', 'error', 'match'),
    [
        (['nowhere', 'bag'], FileFormatError, 'no such world'),
        (['room', 'bag', '--set', 'laser.beam=3'], ParameterError, r"'laser.beam'.*laser.beams"),
        (['room', 'bag', '--set', 'laser.beams=1'], ParameterError, r'laser.beams = 1 is outside'),
        (['room', 'bag', '--set', 'laser.beams'], ParameterError, 'is not NAME=VALUE'),
        (['room', 'bag', '--set', 'world={'], ParameterError, 'is not YAML'),
        (['room', 'bag', '--set', 'repeat=true'], ParameterError, 'needs --duration'),
        (['room', 'bag', '--config', 'absent.yaml'], FileFormatError, 'absent.yaml: cannot'),
        (['room', '.', '--duration', '1'], BagError, 'exists already'),
    ],
)
def test_a_wrong_argument_is_one_line_and_no_bag(tmp_path, monkeypatch, arguments, error, match):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=match):
        command(*arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_parameter_file_is_read_and_options_win(tmp_path, capsys):
    file = tmp_path / 'sim.yaml'
    file.write_text('/**:\n  ros__parameters:\n    duration: 9.0\n    laser: {beams: 45}\n')
    command('room', tmp_path / 'bag', '--config', file, '--duration', 1)
    assert '10 scan' in capsys.readouterr().out
    with BagReader(tmp_path / 'bag') as reader:
        assert {len(m.ranges) for _, _, m in reader.messages(['/scan'])} == {45}
