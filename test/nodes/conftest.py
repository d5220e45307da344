# SPDX-License-Identifier: Apache-2.0
"""Node tests run where ROS 2 is installed, in a domain of their own on this machine."""

from __future__ import annotations

import importlib.util

import pytest

if importlib.util.find_spec('rclpy') is None:
    collect_ignore_glob = ['test_*.py']


@pytest.fixture
def live(monkeypatch, tmp_path):
    """A ROS context that hears nothing but the test, in a folder of its own for its maps."""
    from live import LiveNodes

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    context = LiveNodes()
    yield context
    context.close()


@pytest.fixture
def start(tmp_path):
    """Starts executables, and ends them with the test."""
    from live import Process

    processes = []

    def run(name, *args):
        processes.append(Process(name, *args, cwd=tmp_path))
        return processes[-1]

    yield run
    for process in processes:
        process.close()
