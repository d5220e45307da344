# SPDX-License-Identifier: Apache-2.0
"""The study of suggested layouts: small rooms, drives and rules of thumb."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_lab.layout.layout_cases import depot, large_hall, small_room
from rlml_lab.layout.planned_drive import drive
from rlml_lab.layout.rules_of_thumb import rules
from rlml_lab.layout.study_plan_suggest import small, text
from rlml_slam.planning import site as sites
from rlml_slam.planning.plan import Goal
from rlml_slam.simulation.world_file import load_world


@pytest.mark.parametrize('seed', [0, 1])
def test_small_room_is_near_the_best(seed):
    row = small(seed)
    assert row['kept']
    assert 0.95 <= row['share_of_best'] <= 1.0 + 1e-9
    assert '1 of 1 within 5% of the best' in text('small', [row])


def test_cases_are_what_they_say():
    assert len(large_hall().reflectors) == 100
    assert not len(depot().reflectors)
    assert len({len(small_room(k).static.segments) for k in range(8)}) > 1


def test_drive_is_compared_with_its_plan():
    world = load_world('room')
    found = drive(world, sites.of_world(world), Goal(0.01), 0)
    assert found.ok_share > 0.99
    assert 0.001 < found.error < 1.25 * found.planned
    assert np.hypot(found.along, found.across) >= found.error


def test_rules_have_the_expected_order():
    rows = rules()

    def column(rule: str) -> list[float]:
        return [r['driving_cm'] for r in rows if r['rule'].startswith(rule)]

    assert column('number') == sorted(column('number'), reverse=True)
    assert column('range') == sorted(column('range'))
    assert column('spacing') == sorted(column('spacing'))
    angle = column('angle')
    assert angle[:6] == sorted(angle[:6], reverse=True)
    unique = [r['unique'] for r in rows if r['rule'].startswith('asymmetry')]
    assert unique[0] == 0.0
    assert unique[-1] == 1.0
