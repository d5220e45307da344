# SPDX-License-Identifier: Apache-2.0
"""Puts test/ on the import path, so that every test finds differences.py; what many files read."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from rlml_slam.cli.main import main

ROOM = Path(__file__).resolve().parents[1] / 'bags' / 'room'

# A shell starts what runs in the background with interrupts ignored, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


def _replay(folder, *options):
    mcap = str(folder / 'run.mcap')
    assert main(['replay', str(ROOM), '--out', str(folder / 'run'), '--mcap', mcap, *options]) == 0
    return folder


@pytest.fixture(scope='session')
def room_run(tmp_path_factory):
    """A replay of the sample bag as the command writes it: run/ and run.mcap, to be read only."""
    return _replay(tmp_path_factory.mktemp('room_run'))


@pytest.fixture(scope='session')
def room_again(tmp_path_factory):
    """Another one, without a report."""
    return _replay(tmp_path_factory.mktemp('room_again'), '--no-report')
