# SPDX-License-Identifier: Apache-2.0
"""The scenarios through calls of conductor, front end and back end."""

from __future__ import annotations

import pytest
from by_calls import ByCalls
from scenarios import SCENARIOS, check, save_map


@pytest.fixture(scope='module')
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp('maps')
    return folder, save_map(folder)


@pytest.mark.parametrize('scenario', SCENARIOS, ids=lambda s: s.name)
def test_scenario_by_calls(scenario, saved):
    folder, keyframes = saved
    check(scenario, ByCalls(scenario, folder).run(), keyframes)
