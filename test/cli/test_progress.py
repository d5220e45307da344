# SPDX-License-Identifier: Apache-2.0
"""Progress: lines where there is no terminal, silence where it is asked for."""

from __future__ import annotations

import pytest

from rlml_slam.cli.support import progress
from rlml_slam.cli.support.progress import Progress


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, 'monotonic', lambda: now[0])
    return now


def test_lines_come_now_and_then(clock, capsys):
    with Progress('replay', 200.0) as p:
        for k in range(101):
            clock[0] += 0.25
            p.update(2.0 * k, f'{k} x real time')
    out, err = capsys.readouterr()
    assert out == ''
    assert err.splitlines() == ['replay: 39 % 39 x real time', 'replay: 79 % 79 x real time']


def test_quiet_is_silent(clock, capsys):
    with Progress('replay', 1.0, quiet=True) as p:
        clock[0] += 60.0
        p.update(0.5)
    assert capsys.readouterr() == ('', '')


def test_terminal_gets_a_bar_on_standard_error(monkeypatch, capsys):
    monkeypatch.setattr(progress.sys.stderr, 'isatty', lambda: True, raising=False)
    with Progress('replay', 10.0) as p:
        p.update(5.0, 'half')
        p.update(20.0, 'more than all')
    assert capsys.readouterr().out == ''
