# SPDX-License-Identifier: Apache-2.0
"""``rlml demo``: three processes over DDS, and what becomes of their deaths."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from made_bags import beginning

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

from rlml_slam.cli.demo import route_length
from rlml_slam.cli.main import main
from rlml_slam.cli.support.live_session import node
from rlml_slam.datasets.tum import read_tum
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.slam.store import map_file

ROOT = Path(__file__).resolve().parents[2]
# a room of 6 x 4 m with a post in it, crossed once
WORLD = """
description: a small room, crossed once
start: [1.0, 1.0, 0.0]
route: [[1.0, 1.0], [4.0, 1.0]]
walls:
  - {points: [[0, 0], [6, 0], [6, 4], [0, 4]], closed: true}
boxes:
  - {at: [3.0, 3.0], size: [0.5, 0.5]}
reflectors:
  - {at: [0.5, 3.5], diameter: 0.1}
  - {at: [5.5, 3.4], diameter: 0.1}
  - {at: [5.6, 0.4], diameter: 0.1}
"""


@pytest.fixture
def world(tmp_path):
    path = tmp_path / 'small.yaml'
    path.write_text(WORLD)
    return path


def command(world, out, *more):
    return ['demo', '--world', str(world), '--out', str(out), *more]


def test_demo_drives_maps_and_reports(world, tmp_path):
    done = subprocess.run(
        [sys.executable, '-m', 'rlml_slam', *command(world, tmp_path / 'out', '--json')],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    f = json.loads(done.stdout)
    # about 3 s of driving and 6 s of standing, ten scans a second
    assert 50 < f['scans'] <= f['scans_published']
    assert f['reflectors_found'] == 3
    # wide: a busy machine may lose messages, which costs accuracy
    assert f['ate_rmse_m'] < 0.1
    assert f['latency_ms']['median'] > 0.0
    # as in a replay: one figure per scan and per keyframe
    assert 0.0 < f['front_end_ms']['median'] <= f['front_end_ms']['max']
    assert 0.0 < f['back_end_ms']['median'] <= f['back_end_ms']['max']
    assert len(read_tum(tmp_path / 'out' / 'trajectory.tum')) == f['scans']
    assert (tmp_path / 'out' / 'report.html').stat().st_size > 50_000
    # the whole map, as a replay has it: of no more than was mapped
    stored = map_file.load(tmp_path / 'out' / 'map.rlml')
    assert len(map_file.saved_map(stored).reflectors) == 3
    states = (tmp_path / 'out' / 'reflector_states.csv').read_text().splitlines()
    assert len(states) == 4


def test_bag_over_dds_ends_where_its_replay_does(tmp_path, capsys):
    """At twice the recording's pace, to be quick; every message of a small bag gets through."""
    bag = str(beginning(ROOT / 'bags' / 'room', tmp_path / 'room', 15.0))
    live, replayed = tmp_path / 'live', tmp_path / 'replayed'
    mcap = tmp_path / 'live.mcap'
    args = ['live', bag, '--out', str(live), '--rate', '2', '--mcap', str(mcap), '--json']
    assert main(args) == 0
    f = json.loads(capsys.readouterr().out)
    assert main(['replay', bag, '--out', str(replayed), '--json', '--no-report']) == 0
    capsys.readouterr()
    assert f['scans'] == f['scans_published']
    paths = [str(folder / 'trajectory.tum') for folder in (live, replayed)]
    assert main(['evaluate', 'ate', *paths, '--json']) == 0
    assert json.loads(capsys.readouterr().out)['last_m'] < 0.02
    with BagReader(mcap) as heard, BagReader(bag) as source:
        counts = {t.name: t.count for t in heard.topics.values()}
        assert counts['/scan'] == source.topics['/scan'].count
        assert list(heard.serialized(['/scan'])) != []
        assert sum(1 for _ in heard.messages()) == heard.count()  # each can be read
        assert not heard.skipped
    assert counts['/pose'] == f['scans']
    assert min(counts[t] for t in ('/map', '/graph', '/front_end/health', '/odom')) > 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interrupt_ends_all_processes(world, tmp_path, number):
    out = tmp_path / 'out'
    demo = subprocess.Popen(
        [sys.executable, '-m', 'rlml_slam', *command(world, out)],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 60.0
    # the log of the last process is there before the process itself
    while len(list(out.glob('log/*.log'))) < 3:
        assert time.monotonic() < deadline
        assert demo.poll() is None
        os.sched_yield()
    demo.send_signal(number)
    _, err = demo.communicate(timeout=30.0)
    assert demo.returncode == 130
    assert err.endswith('rlml: interrupted\n')
    running = subprocess.run(['ps', '-ww', '-eo', 'args'], capture_output=True, text=True).stdout
    assert str(world) not in running


def test_dead_process_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        'rlml_slam.cli.support.live_session.node',
        lambda name, values, config=None: ['rlml_slam.nodes.no_such_node'],
    )
    assert main(['demo', '--out', str(tmp_path / 'out')]) == 1
    err = capsys.readouterr().err
    assert 'ended with exit code 1' in err
    assert 'No module named rlml_slam.nodes.no_such_node' in err


@pytest.mark.parametrize(
    ('arguments', 'why'),
    [
        (['--world', 'no_such_world'], 'no_such_world'),
        (['--rate', '-1'], 'rate = -1.0 is outside'),
    ],
)
def test_wrong_argument_is_one_line(tmp_path, capsys, arguments, why):
    assert main(['demo', '--out', str(tmp_path / 'out'), *arguments]) == 1
    err = capsys.readouterr().err
    assert why in err
    assert err.count('\n') == 1


def test_parameters_become_ros_arguments():
    assert node('simulator', {'rate': 2.0, 'laser_pose': [0.2, 0.0]}) == [
        'rlml_slam.nodes.simulator', '--ros-args', '--log-level', 'warn',
        '-p', 'rate:=2.0', '-p', 'laser_pose:=[0.2, 0.0]',
    ]  # fmt: skip


def test_route_length_is_that_of_its_legs():
    from rlml_slam.simulation.world_file import parse_world

    assert route_length(parse_world(WORLD, 'small')) == pytest.approx(3.0)
