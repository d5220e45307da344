# SPDX-License-Identifier: Apache-2.0
"""The scenarios through messages between two nodes: to the last bit as through calls."""

from __future__ import annotations

import shutil

import pytest
from by_calls import ByCalls
from by_messages import ByMessages
from scenarios import SCENARIOS, check, same, save_map


@pytest.fixture(scope='module')
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp('maps')
    return folder, save_map(folder)


@pytest.mark.parametrize('scenario', SCENARIOS, ids=lambda s: s.name)
def test_scenario_by_messages(scenario, saved, tmp_path, live, monkeypatch):
    folder, keyframes = saved
    shutil.copytree(folder, tmp_path / 'maps')
    outcome = ByMessages(scenario, tmp_path / 'maps', live, monkeypatch).run()
    check(scenario, outcome, keyframes)
    same(ByCalls(scenario, folder).run(), outcome)
