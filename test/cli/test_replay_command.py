# SPDX-License-Identifier: Apache-2.0
"""``rlml replay`` over the sample bags and over damaged and useless ones."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import rlml_slam
from rlml_slam import se2
from rlml_slam.cli.main import main
from rlml_slam.cli.replay import load_known
from rlml_slam.datasets.tum import Trajectory, read_tum, write_tum
from rlml_slam.evaluation.run_record import FrameLog, Run
from rlml_slam.maps import occupancy
from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.recordings.products import fates, refused, sources
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Health, Imu, Level, Reflectors, Scan

BAGS = Path(__file__).resolve().parents[2] / 'bags'
SECOND = 1_000_000_000


@pytest.fixture
def mapped(room_run):
    """The results of one replay of the room."""
    return room_run / 'run'


def test_two_replays_are_byte_identical_but_for_times(mapped, room_again):
    """The second one has no report, and all other files."""
    again = room_again / 'run'
    names = {p.name for p in again.iterdir()}
    assert {p.name for p in mapped.iterdir()} == names | {'report.html'}
    assert {'trajectory.tum', 'front_end.tum', 'map.pgm', 'map.yaml', 'reflectors.csv'} < names
    assert 'report.html' not in names
    for name in names - {'metrics.json'}:
        assert (mapped / name).read_bytes() == (again / name).read_bytes(), name
    figures = [json.loads((folder / 'metrics.json').read_text()) for folder in (mapped, again)]
    assert figures[0].keys() == figures[1].keys()
    assert figures[0]['ate_rmse_m'] == figures[1]['ate_rmse_m']


def test_summary_names_the_report_where_there_is_one(tmp_path, capsys):
    write_scans(tmp_path / 'bag', [k * SECOND // 10 for k in range(10, 20)])
    arguments = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out')]
    assert main([*arguments, '--no-report']) == 0
    assert capsys.readouterr().out.endswith(f'\nresults: {tmp_path / "out"}\n')
    assert not (tmp_path / 'out' / 'report.html').exists()
    assert main(arguments) == 0
    assert capsys.readouterr().out.endswith(f'\nreport: {tmp_path / "out" / "report.html"}\n')
    assert (tmp_path / 'out' / 'report.html').exists()


def test_room_is_mapped(mapped):
    f = json.loads((mapped / 'metrics.json').read_text())
    assert f['alignment'] == 'none'
    # a room of a few metres, 2 cm range noise; the bound is a few times what is reached
    assert f['live_ate_rmse_m'] < 0.03
    assert f['heading_rmse_deg'] < 0.3
    assert f['reflectors_found'] == f['reflectors_true']
    assert f['reflectors_spurious'] == 0
    assert f['inputs']['scan']['invalid'] == 0
    assert f['topics']['scan'] == '/scan'
    assert len(read_tum(mapped / 'trajectory.tum')) == f['scans']


def test_bag_is_localized_in_the_map_that_another_replay_made(mapped, tmp_path):
    """The robot starts elsewhere than assumed, and the map comes out as it went in."""
    start = tmp_path / 'start.yaml'
    start.write_text('/**:\n  ros__parameters:\n    map_start_pose: [4.0, 3.0, 1.0]\n')
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out'), '--no-report']
    arguments += ['--map', str(mapped), '--config', str(start)]
    assert main(arguments) == 0
    f = json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    assert f['keyframes'] == 0
    assert f['health']['OK'] > 0.95
    assert not (tmp_path / 'out' / 'closures.csv').exists()
    for name in ('map.pgm', 'map.yaml', 'reflectors.csv'):
        assert (tmp_path / 'out' / name).read_bytes() == (mapped / name).read_bytes()
    found = read_tum(tmp_path / 'out' / 'trajectory.tum')
    mapped = read_tum(mapped / 'trajectory.tum')
    error = se2.between(mapped.poses, found.poses)[10:]
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.04
    assert np.abs(error[:, 2]).max() < 0.02


def test_map_of_a_folder_is_the_one_from_which_a_closure_was_revoked(mapped, tmp_path, capsys):
    """Its grid, its reflectors and its closures are in other files as well, which are older."""
    shutil.copytree(mapped, tmp_path / 'run')
    assert main(['closures', str(tmp_path / 'run' / 'map.rlml'), '--revoke', '0']) == 0
    revoked = map_file.saved_map(map_file.load(tmp_path / 'run' / 'map.rlml'))
    assert load_known(tmp_path / 'run').id == revoked.id
    capsys.readouterr()
    assert main(['closures', str(tmp_path / 'run')]) == 0
    assert ' 1 revoked' in capsys.readouterr().out


def test_folder_without_a_map_is_refused(tmp_path, capsys):
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out')]
    assert main([*arguments, '--map', str(tmp_path)]) == 1
    assert 'neither reflectors.csv nor map.csv' in capsys.readouterr().err


def test_empty_map_is_refused(tmp_path, capsys):
    rlml_slam.save_map(rlml_slam.Slam().map(), tmp_path / 'nothing')
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out')]
    assert main([*arguments, '--map', str(tmp_path / 'nothing')]) == 1
    assert 'nothing: the map is empty' in capsys.readouterr().err


def test_map_and_survey_of_a_node_are_not_used_and_named(tmp_path, capsys):
    config = tmp_path / 'c.yaml'
    config.write_text(
        '/**:\n  ros__parameters:\n    continue_map: true\n    back_end: {survey: plant.csv}\n'
    )
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main([*arguments, '--config', str(config)]) == 0
    said = capsys.readouterr().err
    assert 'back_end.survey is for the nodes, and is not used: give --survey FILE' in said
    assert 'continue_map is for the nodes, and is not used: give --continue MAP' in said


def test_given_truth_is_aligned(mapped, tmp_path, capsys):
    path = read_tum(mapped / 'trajectory.tum')
    moved = Trajectory(path.stamps, path.poses + np.array([1.0, 2.0, 0.0]))
    write_tum(tmp_path / 'truth.tum', moved)
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out'), '--json']
    arguments += ['--no-report', '--truth', str(tmp_path / 'truth.tum')]
    assert main(arguments) == 0
    f = json.loads(capsys.readouterr().out)
    assert f['alignment'] == 'se2'
    assert f['ate_rmse_m'] < 1e-6


@pytest.mark.parametrize('stamps', [[5e12, 6e12], [2e9, 6e12]])
def test_truth_that_says_nothing_of_the_bag_is_a_problem(stamps, tmp_path, capsys):
    """Of another time, or of one pose, to which any path can be aligned without an error."""
    write_tum(tmp_path / 't.tum', Trajectory(np.array(stamps, dtype=np.int64), np.zeros((2, 3))))
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main([*arguments, '--truth', str(tmp_path / 't.tum')]) == 1
    said = capsys.readouterr()
    assert said.err.endswith('t.tum: no errors: it has nothing at the stamps of this bag\n')
    assert 'RMSE, aligned' not in said.out


def test_summary_says_which_topic_was_taken(tmp_path, capsys):
    config = tmp_path / 'c.yaml'
    config.write_text('/**:\n  ros__parameters:\n    scan_topic: front/scan\n')
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main([*arguments, '--config', str(config)]) == 0
    (row,) = re.findall(r'input scan +(.*)', capsys.readouterr().out)
    # not the one that was asked for, but the only scans there are
    assert row.endswith('used (/scan)')


def test_summary_says_that_no_transform_has_the_place_of_the_laser(tmp_path, capsys):
    write_scans(tmp_path / 'bag', [k * SECOND // 10 for k in range(10, 20)])
    arguments = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main(arguments) == 0
    note = "no transform from base_link to 'laser': laser_pose is used: [0.0, 0.0, 0.0]"
    (row,) = re.findall(r'input scan +(.*)', capsys.readouterr().out)
    assert row == f'10 used (/scan; {note})'
    f = json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    assert (f['topics']['scan'], f['problem']) == (f'/scan; {note}', '')
    # as a node says of it
    assert f['health']['DEGRADED'] == 1.0
    assert f['health_reasons']["no transform to 'laser': it is taken to sit at base_frame"] == 1.0


def test_summary_has_the_most_frequent_reasons_of_bad_health(tmp_path, capsys):
    write_scans(tmp_path / 'bag', [k * SECOND // 10 for k in range(10, 50)])
    assert main(['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out')]) == 0
    out = capsys.readouterr().out
    assert re.search(r"health +100.0% DEGRADED\n +100.0% no transform to 'laser'.*\n", out)
    assert re.search(r'\n +\d+\.\d% no odometry\n', out)


def test_reasons_that_differ_in_numbers_are_one():
    log, pose, cov = FrameLog(), np.zeros(3), np.eye(3)
    for k in range(8):
        reasons = (f'position sigma is 0.{k} m',) if k > 1 else ()
        log.add_pose(k, pose, cov, Health(Level(k > 1), (*reasons, *['b'] * (k == 3))))
    run = Run('', log, log.trajectory(), Reflectors(*(np.zeros(0),) * 6))
    assert run.health_reasons() == [('position sigma is 0.7 m', 0.75), ('b', 0.125)]


def seen_in_room(stamp, pose):
    """All around, in a room of 6 x 5 m."""
    step = np.pi / 90.0
    angles = -np.pi + step * np.arange(180)
    c, s = np.cos(angles + pose[2]), np.sin(angles + pose[2])
    ranges = np.minimum(
        (3.0 - np.sign(c) * pose[0]) / np.maximum(np.abs(c), 1e-9),
        (2.5 - np.sign(s) * pose[1]) / np.maximum(np.abs(s), 1e-9),
    )
    none = np.zeros(0, np.float32)
    frame = 'base_link'
    return Scan(stamp, frame, -np.pi, step, 0.0, 0.1, 30.0, ranges.astype(np.float32), none)


def write_drive(path, odometry, imu=lambda pose: None, seconds=30.0):
    """A bag of a robot that drives in circles in a room; odometry of pose ``odometry(pose)``."""
    with BagWriter(path) as bag:
        for k in range(40, int(40 * seconds)):
            t, turn = k * SECOND // 40, 0.5 * (k / 40.0 - 1.0)
            pose = np.array([0.5 * np.sin(turn), 0.5 - 0.5 * np.cos(turn), turn])
            msg = encode.odometry(make_bag, t, ('odom', 'base_link'), odometry(pose), np.eye(3))
            bag.write('/odom', msg, t)
            if (rate := imu(pose)) is not None:
                bag.write('/imu', encode.imu(make_bag, Imu(t, rate), 'base_link', 0.01), t)
            if k % 4 == 1:
                bag.write('/scan', encode.laser_scan(make_bag, seen_in_room(t, pose)), t)


def test_odometry_in_millimetres_is_a_problem(tmp_path, capsys):
    write_drive(tmp_path / 'bag', lambda pose: pose * [1000.0, 1000.0, 1.0])
    arguments = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert re.search(r'messages with odometry were not used; the first: .* in metres', said)


def test_imu_in_degrees_per_second_is_named(tmp_path, capsys):
    write_drive(tmp_path / 'bag', lambda pose: pose, lambda pose: np.degrees(0.5))
    arguments = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main(arguments) == 0
    row = re.search(r'input imu +(.*)', capsys.readouterr().out)
    assert row is not None
    assert 'not used, as it is in degrees per second' in row[1]


@pytest.mark.parametrize(
    ('ahead', 'why'), [(3600, 'ahead of all other stamps'), (-3600, 'is late by')]
)
def test_scans_of_another_clock_are_a_problem(ahead, why, tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(7200 * 40, 7200 * 40 + 800):
            t, frames = k * SECOND // 40, ('odom', 'base_link')
            pose = np.array([1e-3 * k, 0.0, 0.0])
            bag.write('/odom', encode.odometry(make_bag, t, frames, pose, np.eye(3)), t)
            if k % 4 == 1:
                bag.write('/scan', encode.laser_scan(make_bag, made_scan(t + ahead * SECOND)), t)
    arguments = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main(arguments) == 1
    said = re.search(
        r'(\d+) of (\d+) scans were not used; the first: (.*)', capsys.readouterr().err
    )
    assert said is not None
    assert int(said[1]) > 0.7 * int(said[2])
    assert why in said[3]


def test_odometry_and_imu_of_which_none_can_be_used_are_explained(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(20, 60):
            t, frames = k * SECOND // 10, ('map', 'base_link')
            bag.write('/odom', encode.odometry(make_bag, t, frames, np.zeros(3), np.eye(3)), t)
            imu = encode.imu(make_bag, Imu(t, 0.0), 'base_link', 0.01)
            imu.angular_velocity_covariance[0] = -1.0
            bag.write('/imu', imu, t)
            bag.write('/scan', encode.laser_scan(make_bag, made_scan(t)), t)
    arguments = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main(arguments) == 1
    said = capsys.readouterr()
    assert re.search(r'input imu .*; none is used: imu: angular_velocity is marked', said.out)
    why = '40 of 40 messages with odometry were not used; the first: odom: header.frame_id is'
    assert why in said.err


def test_only_a_large_share_of_late_scans_is_a_problem():
    inputs = InputCounts()
    for k in range(100):
        inputs.count('scan', 'used')
        inputs.count('scan', 'waited_out')
        inputs.count('odom', 'late', 'odom is late')
        if k % 2:
            inputs.count('scan', 'late', f'scan {k} is late')
    assert refused(inputs) == ''
    for _ in range(50):
        inputs.count('scan', 'future', 'scan is ahead')
    assert refused(inputs) == '100 of 200 scans were not used; the first: scan 1 is late'


def test_both_topics_of_reflectors_are_told():
    topics = {'scan': '/front', 'reflectors': '/cloud', 'reflector_poses': '/poses'}
    found = sources(topics, ['/rear'])
    assert found == {'scan': '/front, /rear', 'reflectors': '/cloud, /poses'}
    assert sources({'odom': '/odom'}, ['/rear']) == {'odom': '/odom', 'scan': '/rear'}


def test_configuration_is_used(tmp_path, capsys):
    config = tmp_path / 'c.yaml'
    config.write_text('/**:\n  ros__parameters:\n    use_scan: false\n')
    arguments = ['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out'), '--no-report']
    assert main([*arguments, '--config', str(config)]) == 0
    assert 'scan' not in json.loads((tmp_path / 'out' / 'metrics.json').read_text())['inputs']
    config.write_text('/**:\n  ros__parameters:\n    use_scam: false\n')
    assert main([*arguments, '--config', str(config)]) == 1
    assert "unknown parameter 'use_scam'" in capsys.readouterr().err


def test_odometry_is_left_out_where_it_is_withheld(tmp_path, capsys):
    out = tmp_path / 'out'
    arguments = ['replay', str(BAGS / 'room'), '--out', str(out), '--no-report']
    assert main([*arguments, '--no-odometry', '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert 'odom' not in figures['inputs']
    assert figures['inputs']['scan']['used'] > 0
    # the walls of the room hold the pose without any odometry
    assert figures['live_ate_rmse_m'] < 0.1


def test_no_such_bag_is_one_line(tmp_path, capsys):
    assert main(['replay', str(tmp_path / 'missing'), '--out', str(tmp_path / 'out')]) == 1
    assert capsys.readouterr().err.endswith('missing: no such bag\n')


def made_scan(stamp):
    """Half of a room of 4 x 3 m, seen from its middle."""
    angles = -1.57 + 0.035 * np.arange(90)
    ranges = np.minimum(2.0 / np.abs(np.cos(angles)), 1.5 / np.abs(np.sin(angles) + 1e-9))
    none = np.zeros(0, np.float32)
    return Scan(stamp, 'laser', -1.57, 0.035, 0.0, 0.1, 30.0, ranges.astype(np.float32), none)


def write_scans(path, stamps):
    with BagWriter(path) as bag:
        for k, stamp in enumerate(stamps):
            bag.write('/scan', encode.laser_scan(make_bag, made_scan(stamp)), (k + 1) * SECOND)


def test_bag_without_anything_usable_says_why(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        pose = np.zeros(3)
        message = encode.odometry(make_bag, SECOND, ('odom', 'base_link'), pose, np.eye(3))
        bag.write('/odom', message, SECOND)
    assert main(['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out')]) == 1
    assert 'no scan and no reflectors in the bag' in capsys.readouterr().err


def test_clock_that_jumps_back_gives_what_came_before(tmp_path, capsys):
    first = [(100 + k) * SECOND for k in range(20)]
    write_scans(tmp_path / 'bag', first + [k * SECOND for k in range(1, 20)])
    assert (
        main(['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--no-report']) == 1
    )
    assert 'jumped back' in capsys.readouterr().err
    assert len(read_tum(tmp_path / 'out' / 'trajectory.tum')) == 20
    assert 'jumped back' in json.loads((tmp_path / 'out' / 'metrics.json').read_text())['problem']


def test_damaged_bag_gives_what_came_before(tmp_path, monkeypatch, capsys):
    from rlml_slam.errors import BagError
    from rlml_slam.ros.bags.bag import BagReader

    sound = BagReader.messages

    def damaged(self, topics=None, **more):
        for k, message in enumerate(sound(self, topics, **more)):
            if k == 600:
                raise BagError(f'{self.path}: damaged after {k} messages: cut')
            yield message

    monkeypatch.setattr(BagReader, 'messages', damaged)
    assert main(['replay', str(BAGS / 'room'), '--out', str(tmp_path / 'out')]) == 1
    err = capsys.readouterr().err
    assert 'damaged after 600 messages: cut; the results hold what came before' in err
    assert len(read_tum(tmp_path / 'out' / 'trajectory.tum')) > 50
    assert 'damaged' in (tmp_path / 'out' / 'report.html').read_text()


@pytest.mark.parametrize('system', ['rlml', 'ekf'])
def test_grid_too_large_to_be_drawn_costs_only_itself(system, tmp_path, monkeypatch, capsys):
    # the room has more cells than this, as one with an outlier kilometres away has in truth
    monkeypatch.setattr(occupancy, 'MAX_CELLS', 1000)
    arguments = ['--system', system, '--out', str(tmp_path / 'out')]
    assert main(['replay', str(BAGS / 'room'), *arguments]) == 1
    said = r'map of \d+ x \d+ cells is too large to be drawn; the results hold everything else'
    assert re.search(said, capsys.readouterr().err)
    f = json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    assert re.search(said, f['problem'])
    assert f['reflectors_found'] == f['reflectors_true']
    assert len(read_tum(tmp_path / 'out' / 'trajectory.tum')) == f['scans']
    assert {p.name for p in (tmp_path / 'out').iterdir()} >= {'map.pgm', 'report.html'}


def test_file_cut_short_fails_in_one_line(tmp_path, capsys):
    shutil.copytree(BAGS / 'room', tmp_path / 'bag')
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    file.write_bytes(file.read_bytes()[:100_000])
    assert main(['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out')]) == 1
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert str(tmp_path / 'bag') in err


def test_reflectors_alone_are_enough(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(30):
            stamp = (k + 1) * SECOND // 10
            points = np.array([[2.0, 1.0], [3.0, -1.0], [-1.0, 2.0]])
            seen = Detections(
                stamp, 'base_link', points, np.broadcast_to(4e-4 * np.eye(2), (3, 2, 2)),
                np.full(3, -1), np.full(3, np.nan),
            )  # fmt: skip
            bag.write('/reflectors', encode.detections(make_bag, seen), stamp)
    run = replay(tmp_path / 'bag', Parameters())
    assert len(run.reflectors) == 3
    assert run.grid is None
    assert np.abs(run.trajectory.poses).max() < 0.02


def test_fates_name_what_could_not_be_read():
    counts = {'scan': {'used': 5, 'waited_out': 1}, 'reflectors': {'used': 2}}
    topics = {'scan': '/scan', 'reflector_poses': '/poses', 'imu': '/imu'}
    assert fates(counts, {'/scan': 2, '/poses': 1}, topics) == {
        'scan': {'used': 5, 'late': 0, 'invalid': 2, 'waited_out': 1},
        'reflectors': {'used': 2, 'late': 0, 'invalid': 1},
        'imu': {'used': 0, 'late': 0, 'invalid': 0},
    }
