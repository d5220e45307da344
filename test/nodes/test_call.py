# SPDX-License-Identifier: Apache-2.0
"""``rlml call`` against a running back end."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from live import DOMAIN, overrides

from rlml_slam.cli import call
from rlml_slam.cli.main import main
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.back_end.map_folder import MapFolder
from rlml_slam.types import Reflectors

CALL = """
import sys
from rlml_slam.cli.main import main

def words():  # which the command reads first, where it can be interrupted
    print('ready', flush=True)
    yield from sys.argv[1:]

sys.exit(main(words()))
"""


@pytest.fixture
def command(live, monkeypatch, capsys):
    """Runs a command line beside the nodes; its exit code, and what it prints."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))

    def run(*words):
        with ThreadPoolExecutor(1) as pool:
            code = pool.submit(main, ['call', *words])
            live.spin_until(code.done, timeout=30.0)
        said = capsys.readouterr()
        return code.result(), said.out, said.err

    return run


def test_services_answer_in_words_and_refuse_in_words(live, command, tmp_path):
    n = 3
    found = Reflectors(
        np.arange(n), np.arange(2.0 * n).reshape(n, 2), np.tile(1e-4 * np.eye(2), (n, 1, 1)),
        np.full(n, -1), np.full(n, 9), np.full(n, np.nan),
    )  # fmt: skip
    MapFolder(str(tmp_path)).save('hall', SavedMap(found))
    values = {'mode': 'localization', 'map_file_name': 'hall', 'map_directory': str(tmp_path)}
    live.start(BackEndNode, **values)
    assert command('pause_new_measurements', 'on') == (0, 'paused\n', '')
    assert command('load_map', 'hall') == (0, 'hall: loaded\n', '')
    code, out, err = command('load_map', 'nowhere')
    assert (code, out) == (1, '')
    assert 'load_map: ' in err
    assert 'there is no nowhere.rlml and no nowhere.csv' in err
    code, out, err = command('load_map', '')
    assert (code, out) == (1, '')
    assert 'load_map: map_url is empty' in err
    code, out, err = command('load_map', '../hall')
    assert (code, out) == (1, '')
    assert "load_map: map '../hall' is not inside of map_directory" in err
    code, out, err = command('save_map')
    assert (code, out) == (1, '')
    assert 'nothing to save' in err


@pytest.mark.parametrize(
    ('words', 'why'),
    [
        (['load_map'], 'load_map needs an argument'),
        (['reset', 'hall'], 'reset takes no argument'),
        (['set', 'health.input_timeout'], "'health.input_timeout' is no NAME=VALUE"),
        (['set_localization_mode', 'yes'], "'yes' is neither on nor off"),
        (['initialpose', '1,2'], "'1,2' is no x,y,angle [m, degrees]"),
        (['initialpose', '-1,2'], "'-1,2' is no x,y,angle [m, degrees]"),
        (['initialpose', '-.5,nan,3'], "'-.5,nan,3' is no x,y,angle [m, degrees]"),
        (['initialpose', '1,nan,3'], "'1,nan,3' is no x,y,angle [m, degrees]"),
    ],
)
def test_wrong_argument_is_one_line(words, why, capsys):
    assert main(['call', *words]) == 1
    assert why in capsys.readouterr().err


def test_absent_node_is_reported_with_those_that_are_there(live, command, tmp_path):
    live.start(BackEndNode, map_directory=str(tmp_path))
    code, out, err = command('save_map', '--node', '/nobody')
    assert (code, out) == (1, '')
    assert '/nobody: no such node; the service save_map is of /back_end' in err


def test_pose_is_given_to_the_front_end(live, command, monkeypatch):
    other = FrontEndNode(context=live.context, namespace='r2', parameter_overrides=overrides())
    session, given = live.add(other).control.session, []
    monkeypatch.setattr(session, 'start_at', lambda *of: given.append(of) or of[1])
    code, out, _ = command('initialpose', '1.5,-2,90', '--node', '/r2/front_end')
    assert (code, out) == (0, '/r2/initialpose: x = 1.5 m, y = -2 m, 90 degrees: sent\n')
    live.spin_until(lambda: given)
    ((_, pose, cov),) = given
    np.testing.assert_allclose(pose, [1.5, -2.0, np.pi / 2])
    np.testing.assert_allclose(cov, call.RVIZ)


@pytest.mark.parametrize(
    ('words', 'what'),
    [
        (['call', 'reset', '--node', 'a b'], 'a b'),
        (['check', '--seconds', '0.5', '--namespace', 'a b'], 'a b'),
        (['closures', '--node', 'a-b'], 'a-b'),
    ],
)
def test_name_that_ros_does_not_allow_is_one_line(words, what, monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    assert main(words) == 1
    said = capsys.readouterr().err
    assert what in said
    assert said.count('\n') == 1


def test_domain_that_is_none_is_named(monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', 'abc')
    assert main(['call', 'reset']) == 1
    assert "ROS_DOMAIN_ID = 'abc'" in capsys.readouterr().err


def test_pose_for_nobody_is_refused(live, command, monkeypatch):
    monkeypatch.setattr(call, 'PATIENCE', 0.5)
    code, out, err = command('initialpose', '0,0,0')
    assert (code, out) == (1, '')
    assert '/initialpose: nobody listens' in err


def test_node_that_dds_finds_late_is_called_all_the_same(live, command, tmp_path, monkeypatch):
    """Others are seen before it."""
    live.start(FrontEndNode)
    spin, late = live.spin_until, []

    def spin_until(done, timeout):
        end = time.monotonic() + 3.0
        spin(lambda: done() or time.monotonic() > end, timeout=10.0)
        late.append(live.start(BackEndNode, map_directory=str(tmp_path)))
        spin(done, timeout)

    monkeypatch.setattr(live, 'spin_until', spin_until)
    code, _, err = command('save_map', '--node', 'back_end')
    assert code == 1
    assert 'nothing to save' in err or 'there is no map yet' in err


IMPORTING = """
import signal, sys, weakref
from rlml_slam.cli.main import main

class Finder:
    @staticmethod
    def find_spec(name, *_):
        if name in ('rclpy', 'rlml_slam.cli.call'):
            there = set()
            ref = weakref.ref(there, lambda _: signal.raise_signal(signal.SIGINT))
            del there
            sys.meta_path.remove(Finder)

sys.meta_path.insert(0, Finder)
sys.exit(main(['call', 'save_map']))
"""


@pytest.mark.parametrize('while_it_imports', ['rclpy', 'rlml_slam.cli.call'])
def test_interrupt_that_strikes_in_an_import_is_one_all_the_same(while_it_imports):
    """Where Python ignores it, as in a callback, or C code makes another error of it."""
    script = IMPORTING.replace("('rclpy', 'rlml_slam.cli.call')", f'({while_it_imports!r},)')
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, timeout=20.0)
    assert done.returncode == 130, done.stderr
    assert done.stderr == b'rlml: interrupted\n'


@pytest.mark.parametrize('delay', [0.0, 0.4, 1.5])
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_call_in_one_line(number, delay, monkeypatch):
    """Of a call that waits for a node which is not there."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    argv = [sys.executable, '-c', CALL, 'call', 'save_map', '--node', '/absent']
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as p:
        assert p.stdout.readline() == 'ready\n'
        time.sleep(delay)
        p.send_signal(number)
        _, err = p.communicate(timeout=30.0)
    assert 'Traceback' not in err, err
    assert p.returncode in (130, -number), err


def test_map_is_saved_under_another_name(live, command, tmp_path):
    node = live.start(BackEndNode, map_directory=str(tmp_path))
    code, out, err = command('save_map', '../outside')
    assert (code, out) == (1, '')
    assert 'is not inside of map_directory' in err
    code, out, err = command('save_map', 'second')
    assert 'there is no map yet' in err
    assert node.params.node.map_file_name == 'map'  # a refused service changes nothing


def test_parameter_is_set_while_the_node_runs(live, command):
    node = live.start(FrontEndNode)
    to = ('--node', '/front_end')
    code, out, _ = command('set', 'health.input_timeout=3', *to)  # a whole number is a number
    assert (code, out) == (0, 'health.input_timeout: 1.0 -> 3\n')
    assert node.params.health.input_timeout == 3.0
    assert command('set', 'health.input_timeout=2e0', *to)[0] == 0
    assert command('set', 'health.input_timeout=3.0', *to)[0] == 0
    for words, why in (
        ('health.input_timeout=-1', 'health.input_timeout'),
        ('health.input_timeout=long', "'long' is no value of it"),
        ('health.input_timeout=@1', "'@1' is no value of it"),
        ('health.input_timeout={a: 1}', 'is no value of it'),
        ('use_scan=@1', 'is no value of it'),
        ('scan_topic=/other', 'scan_topic'),
        ('nosuchparameter=1', "/front_end has no parameter 'nosuchparameter'"),
    ):
        code, out, err = command('set', words, *to)
        assert (code, out) == (1, '')
        assert why in err
    assert node.params.health.input_timeout == 3.0
