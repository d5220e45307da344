# SPDX-License-Identifier: Apache-2.0
"""The scenarios through two processes and a robot that waits for neither: as through calls."""

from __future__ import annotations

import shutil

import pytest
from by_processes import ByProcesses
from scenarios import SCENARIOS, check, save_map


@pytest.fixture(scope='module')
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp('maps')
    return folder, save_map(folder)


@pytest.mark.parametrize('scenario', SCENARIOS, ids=lambda s: s.name)
def test_scenario_as_processes(scenario, saved, tmp_path, live, start, monkeypatch):
    folder, keyframes = saved
    shutil.copytree(folder, tmp_path / 'maps')
    outcome = ByProcesses(scenario, tmp_path / 'maps', live, start, monkeypatch).run()
    check(scenario, outcome, keyframes)
