# SPDX-License-Identifier: Apache-2.0
"""Children live and die with their parent."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from rlml_slam.cli.support import processes as module
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.cli.support.usage import Usage, summary, usage
from rlml_slam.errors import RlmlError

SLEEPER = 'import time\nprint("ready", flush=True)\ntime.sleep(600)\n'
STUBBORN = 'import signal, time\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n' + SLEEPER
FAILING = 'import sys\nprint("some words")\nsys.exit("the last words")\n'


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Starts programs as ``python -m``; all are ended afterwards."""
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    with Processes(tmp_path / 'log', {'DEMO': '7'}) as processes:

        def start(name, program):
            (tmp_path / f'{name}.py').write_text(program)
            processes.start(name, [name])
            return processes

        yield start


def wait(predicate, timeout=20.0):
    deadline = time.monotonic() + timeout
    while not predicate():
        assert time.monotonic() < deadline
        os.sched_yield()


def test_dead_child_is_reported_with_its_last_words(start):
    children = start('failing', FAILING)
    with pytest.raises(RlmlError, match=r'(?s)failing ended with exit code 1:.*the last words'):
        wait(lambda: children.has_ended('failing'))


def test_child_that_ends_too_early_is_reported(start):
    children = start('quick', 'print("done")')
    wait(lambda: children.has_ended('quick'))
    with pytest.raises(RlmlError, match=r'(?s)quick ended too early:.*done'):
        children.check('quick')


def interrupted(children):
    """Starts two children and is interrupted while they run."""
    with children:
        for name in ('sleeper', 'stubborn'):
            children.start(name, [name])
        # the stubborn one has to be so far that it ignores the signal
        wait(lambda: 'ready' in children.last_words('stubborn'))
        assert not children.has_ended('sleeper')
        raise KeyboardInterrupt


def test_no_child_outlives_the_block(tmp_path, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    monkeypatch.setattr(module, 'GRACE', 0.5)
    for name, program in (('sleeper', SLEEPER), ('stubborn', STUBBORN)):
        (tmp_path / f'{name}.py').write_text(program)
    children = Processes(tmp_path / 'log', {})
    with pytest.raises(KeyboardInterrupt):
        interrupted(children)
    for child in children._children.values():
        assert child.poll() is not None


def test_children_get_the_environment(start):
    children = start('env', 'import os; print(os.environ["DEMO"])')
    wait(lambda: children.has_ended('env'))
    assert children.last_words('env').strip() == '7'


def test_memory_of_a_running_child_is_known(start):
    children = start('sleeper', SLEEPER)
    wait(lambda: 'ready' in children.last_words('sleeper'))
    used = children.usage('sleeper')
    assert 1.0 < used.rss_mb <= used.peak_rss_mb < 500.0
    assert 0.0 <= used.cpu_s < 60.0


def test_load_is_the_slope_of_what_was_sampled():
    samples = [Usage(t, 10.0 + 0.3 * t, 100.0 + 0.5 * t, 150.0) for t in np.arange(20.0)]
    assert summary(samples) == {
        'cpu_share': 0.3, 'peak_rss_mb': 150.0, 'rss_growth_mb_per_min': 30.0
    }  # fmt: skip
    assert summary(samples[:1])['cpu_share'] is None
    assert usage(-1, 0.0) is None


@pytest.fixture
def reserved(monkeypatch):
    """Domains that are free again after the test."""
    held = []
    monkeypatch.setattr(module, '_RESERVED', held)
    yield held
    for domain in held:
        domain.close()


def test_taken_domain_is_not_free(reserved):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        # the first domain whose port can be had here
        domain = next(d for d in range(1, 102) if module._is_free(7400 + 250 * d))
        taken.bind(('', 7400 + 250 * domain))
        assert not module._is_free(7400 + 250 * domain)
        for _ in range(30):
            assert free_domain() != domain
            reserved.pop().close()


@pytest.mark.skipif(sys.platform != 'linux', reason='domains are reserved on Linux only')
def test_two_processes_never_have_one_domain(reserved, monkeypatch):
    # two of the same list: by chance alone, they would have one in common
    monkeypatch.setattr(module.random, 'SystemRandom', lambda: random.Random(0))
    held = {free_domain() for _ in range(5)}
    assert len(held) == 5
    ask = (
        'import random\n'
        'random.SystemRandom = lambda: random.Random(0)\n'
        'from rlml_slam.cli.support.processes import free_domain\n'
        'print(*(free_domain() for _ in range(5)), flush=True)\n'
        'input()'
    )
    others = [
        subprocess.Popen(
            [sys.executable, '-c', ask], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    theirs = [int(d) for other in others for d in other.stdout.readline().split()]
    for other in others:
        other.communicate('end\n', timeout=60)
    assert len(set(theirs)) == 10
    assert not held & set(theirs)
