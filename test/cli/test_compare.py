# SPDX-License-Identifier: Apache-2.0
"""Two runs of one recording, and two localizations in one bag: how far apart they are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_runs import made_run

from rlml_slam import se2
from rlml_slam.cli.main import main
from rlml_slam.datasets.tum import Trajectory, write_tum
from rlml_slam.errors import FileFormatError
from rlml_slam.evaluation.run_folder import health_table, read_health
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import Parameters, from_mapping, read_yaml
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.report.outputs import write_outputs
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag

ROOT = Path(__file__).resolve().parents[2]
HALL = ROOT / 'bags' / 'hall'
SHARED = ROOT.parent / 'shared' / 'data' / 'slam-benchmark'
SECOND = 1_000_000_000
APART = np.array([12.0, -3.0, 0.8])  # of the two maps


def drive(t):
    return np.array([0.5 * t, np.sin(0.2 * t), 0.1 * np.sin(0.3 * t)])


@pytest.fixture
def both(tmp_path):
    """AMCL's map to odom at 10 Hz, dated ahead by a second, and our poses 4 cm beside its."""
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(1500):
            stamp, t = 10 * SECOND + k * SECOND // 50, k / 50.0
            tf = [encode.transform(make_bag, stamp, ('odom', 'base_link'), drive(t))]
            if k % 5 == 0:
                ahead = stamp + SECOND
                tf.append(encode.transform(make_bag, ahead, ('map', 'odom'), APART))
            bag.write('/tf', encode.tf_message(make_bag, tf), stamp)
            if k % 5 == 3:
                ours = drive(t) + np.array([0.0, 0.04 * (-1) ** k, 0.0])
                msg = encode.pose_with_covariance(make_bag, stamp, 'map', ours, np.eye(3))
                bag.write('/shadow/pose', msg, stamp)
                msg = encode.pose_with_covariance(
                    make_bag, stamp, 'map', se2.compose(APART, drive(t)), np.eye(3)
                )
                bag.write('/amcl_pose', msg, stamp)
    return str(tmp_path / 'bag')


@pytest.mark.parametrize('other', ['/tf', '/amcl_pose'])
def test_paths_in_two_maps_are_fitted_and_compared(both, capsys, other):
    assert main(['compare', both, '--other', other, '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['b'] == '/shadow/pose'
    path = figures['paths']['published live']
    assert path['rmse_m'] == pytest.approx(0.04, abs=0.002)
    assert path['matched'] > 230


def test_in_one_map_nothing_is_fitted(both, capsys):
    assert main(['compare', both, '--same-map']) == 0
    said = capsys.readouterr().out
    assert 'B: /shadow/pose' in said
    assert 'fitted' not in said
    assert float(said.split('rms ')[1].split(' ')[0]) > 1000.0  # cm


def test_a_topic_that_is_not_there_is_named(both, capsys):
    assert main(['compare', both, '--other', '/odom_pose']) == 2
    assert 'no topic /odom_pose; it has /amcl_pose' in capsys.readouterr().err


def test_limits_hold_for_two_localizations_only_where_they_are_given(both, capsys):
    assert main(['compare', both, '--limit', 'path_m=0.5']) == 0
    assert main(['compare', both, '--limit', 'path_m=0.01']) == 1
    assert 'different: largest distance of the paths' in capsys.readouterr().out


@pytest.mark.parametrize('limit', ['path=1', 'path_m', 'path_m=-1', 'path_m=nan'])
def test_limit_that_cannot_be_used_is_an_error(both, capsys, limit):
    assert main(['compare', both, '--limit', limit]) == 2
    assert f'--limit {limit}' in capsys.readouterr().err


# --- two runs ------------------------------------------------------------------------------------


def replayed(bag, out, **parameters):
    """The folder of a replay."""
    config = out.with_suffix('.yaml')
    given = ''.join(f'    {k.replace("__", ".")}: {v}\n' for k, v in parameters.items())
    config.write_text(f'/**:\n  ros__parameters:\n{given or "    {}"}\n')
    result = replay(bag, from_mapping(read_yaml(config, Parameters), Parameters))
    write_outputs(result, out, report=False)
    return str(out)


def moved_laser(bag, out, seconds=1e9, x=0.0):
    """The beginning of a bag, in which the laser sits ``x`` [m] farther ahead."""
    with BagReader(bag) as source, BagWriter(out) as written:
        for topic in source.topics.values():
            written.add_topic(topic.name, topic.msgtype, source.is_latched(topic.name))
        for time, topic, message in source.messages():
            if time > source.start + seconds * SECOND:
                break
            if topic == '/tf_static':
                for t in message.transforms:
                    t.transform.translation.x += x
            written.write(topic, message, time)
    return out


def recording(name, folder):
    """The beginning of a public log, or the sample bag."""
    if name == 'hall':
        return HALL, 1e9
    log = SHARED / name / f'{name}.rebuilt.log.xz'
    if not log.exists():
        pytest.skip('the recordings of ../shared are not here')
    assert main(['convert', 'carmen', str(log), str(folder / 'bag')]) == 0
    return folder / 'bag', 250.0 if name == 'intel' else 200.0


@pytest.fixture(scope='module', params=['hall', 'fr079', 'intel'])
def runs(request, tmp_path_factory):
    """One recording four times: twice the same, the laser 2 cm off, and half the range."""
    folder = tmp_path_factory.mktemp(request.param)
    source, seconds = recording(request.param, folder)
    bag = moved_laser(source, folder / 'as_it_is', seconds)
    off = moved_laser(source, folder / 'off', seconds, 0.02)
    return {
        'a': replayed(bag, folder / 'a'),
        'same': replayed(bag, folder / 'same'),
        'laser': replayed(off, folder / 'laser'),
        'range': replayed(bag, folder / 'range', submap__max_laser_range=15.0),
    }


def test_equal_runs_do_not_differ(runs, capsys):
    assert main(['compare', runs['a'], runs['same'], '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert not found['different']
    assert found['parting'] == found['settings'] == []
    assert {f['verdict'] for f in found['figures'].values()} <= {'same', 'no limit'}


def test_laser_that_sits_elsewhere_is_found_and_measured(runs, capsys):
    assert main(['compare', runs['a'], runs['laser'], '--json']) == 1
    found = json.loads(capsys.readouterr().out)
    assert found['mounting']['certain']
    shift = found['mounting']['shift']
    # where the odometry is trusted, it hides a part of the shift
    assert 0.4 * 0.02 < shift[0] < 1.2 * 0.02
    assert abs(shift[1]) < 0.3 * shift[0]
    assert found['figures']['path_m']['b'] > 0.01


def test_half_the_range_is_found_and_named(runs, capsys):
    assert main(['compare', runs['a'], runs['range'], '--json']) == 1
    found = json.loads(capsys.readouterr().out)
    assert found['settings'] == [{'name': 'submap.max_laser_range', 'a': 'default', 'b': '15.0'}]
    assert not found['mounting']['certain']
    assert found['figures']['path_m']['verdict'] == 'differs'
    times = [p['time_s'] for p in found['parting']]
    assert times == sorted(times)
    assert found['parting'][0]['health'][0].startswith(('OK', 'DEGRADED'))


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Two runs, one of which is 3 cm beside the other and LOST where it was DEGRADED."""
    folder = tmp_path_factory.mktemp('made')
    for name, off in (('a', 0.0), ('b', 0.03)):
        run = made_run((off, 0.0, 0.0))
        if off:
            run.frames.levels = [2 if level else 0 for level in run.frames.levels]
        write_outputs(run, folder / name, report=False)
    return folder


def test_health_and_error_are_compared(made, capsys):
    assert main(['compare', str(made / 'a'), str(made / 'b'), '--json']) == 1
    found = json.loads(capsys.readouterr().out)['figures']
    assert found['live_ate_rmse_m']['verdict'] == found['lost_share']['verdict'] == 'worse'
    assert found['degraded_share']['verdict'] == 'better'
    assert found['levels'] == {
        'a': 0.0, 'b': pytest.approx(10 / 60), 'verdict': 'differs', 'limit': 0.0
    }  # fmt: skip
    assert found['ate_rmse_m']['verdict'] == 'same'


def test_limits_decide_about_the_exit_code(made):
    wide = ('path_m=0.1', 'levels=1', 'degraded_share=1', 'lost_share=1', 'live_ate_rmse_m=1')
    options = [o for limit in (*wide, 'nees_mean=100') for o in ('--limit', limit)]
    assert main(['compare', str(made / 'a'), str(made / 'b'), *options]) == 0
    assert main(['compare', str(made / 'a'), str(made / 'b'), *options[2:]]) == 1
    assert main(['compare', str(made / 'a'), str(made / 'a'), '--limit', 'wall_s=0']) == 0


def test_page_has_pictures_tables_and_the_verdict(made, tmp_path, capsys):
    out = tmp_path / 'out'
    assert main(['compare', str(made / 'a'), str(made / 'b'), '--out', str(out)]) == 1
    said = capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir()) == [
        'comparison.html', 'comparison.json', 'distance.png', 'paths.png'
    ]  # fmt: skip
    page = (out / 'comparison.html').read_text()
    assert page.count('data:image/png') == 2
    for text in (
        'different: largest distance of the paths',
        'Where they part',
        'scans with another health',
    ):
        assert text in page
    assert 'apart by 1 cm: first at 0.0 s' in said
    assert json.loads((out / 'comparison.json').read_text())['different']


def test_run_is_compared_with_a_trajectory_and_with_amcl_in_a_bag(both, tmp_path, capsys):
    """Of another system in another map: fitted, and no limit holds unless it is given."""
    stamps = np.array([10 * SECOND + k * SECOND // 10 for k in range(290)])
    path = Trajectory(stamps, np.array([drive((t - 10 * SECOND) / SECOND) for t in stamps]))
    write_tum(tmp_path / 'other.tum', path)
    run = made_run()
    run.trajectory, run.truth = path, None
    run.frames = FrameLog()
    for stamp, pose in zip(path.stamps, path.poses, strict=True):
        run.frames.add_pose(int(stamp), pose, np.eye(3))
    write_outputs(run, tmp_path / 'run', report=False)
    for other in (str(tmp_path / 'other.tum'), both):
        assert main(['compare', other, str(tmp_path / 'run'), '--json']) == 0
        found = json.loads(capsys.readouterr().out)
        assert found['fitted']
        assert found['paths']['published live']['max_m'] < 0.002
    assert main(['compare', both, both]) == 2
    assert 'replayed first' in capsys.readouterr().err


def test_file_that_is_not_there_is_named(both, capsys):
    assert main(['compare', both, 'nowhere']) == 2
    assert 'compare: nowhere: no such file or folder' in capsys.readouterr().err


def test_what_is_no_run_is_named(tmp_path, capsys):
    assert main(['compare', str(tmp_path), str(tmp_path)]) == 2
    assert 'not the folder of a replay' in capsys.readouterr().err
    (tmp_path / 'metrics.json').write_text('{')
    assert main(['compare', str(tmp_path), str(tmp_path)]) == 2
    assert 'metrics.json: cannot be read' in capsys.readouterr().err


def test_health_table_is_read_as_written(tmp_path):
    frames = made_run().frames
    frames.reasons[0] = ('said "x", and', 'y')
    (tmp_path / 'health.csv').write_text(health_table(frames))
    log = read_health(tmp_path / 'health.csv')
    assert log.stamps.tolist() == frames.stamps
    assert log.levels.tolist() == frames.levels
    assert log.reasons[0] == "said 'x', and; y"
    (tmp_path / 'health.csv').write_text(health_table(frames) + '5.0,WRONG,0,0,0,0,0,\n')
    with pytest.raises(FileFormatError, match=r'health\.csv:62'):
        read_health(tmp_path / 'health.csv')


def test_parting_is_in_the_map_of_the_first_run(tmp_path, capsys):
    t = np.arange(0.0, 40.0, 0.1)
    here = np.column_stack([0.5 * t, 0.2 * np.sin(t), 0.1 * np.sin(t)])
    bump = np.column_stack([0.0 * t, 1.5 * np.exp(-(((t - 20.0) / 0.5) ** 2)), 0.0 * t])
    stamps = np.round(t * 1e9).astype(np.int64) + 10**9
    write_tum(tmp_path / 'a.tum', Trajectory(stamps, here))
    there = se2.compose(np.array([100.0, 50.0, np.pi / 2]), here + bump)
    write_tum(tmp_path / 'b.tum', Trajectory(stamps, there))
    main(['compare', str(tmp_path / 'a.tum'), str(tmp_path / 'b.tum'), '--json'])
    last = json.loads(capsys.readouterr().out)['parting'][-1]
    assert abs(last['x_m'] - 10.0) < 1.0
    assert abs(last['y_m']) < 2.0
