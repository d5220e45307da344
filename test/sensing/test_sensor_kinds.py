# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_slam.sensing.synchronization.sensor_kinds import MEMORY, REPEATED, SensorKinds


def refused(messages):
    kinds = SensorKinds()
    return [k for k, message in enumerate(messages) if kinds.is_foreign(*message)]


@pytest.mark.parametrize('rare', [('base_link', -1.0), ('laser', 0.0)])
def test_rare_kind_is_refused(rare):
    messages = [('laser', -1.0)] * 10 * MEMORY
    at = list(range(30, len(messages), 25))
    for k in at:
        messages[k] = rare
    assert refused(messages) == at


@pytest.mark.parametrize('share', [2, 5, 15])
def test_lidars_in_turn_are_all_used(share):
    assert not refused([('front', -1.0), *[('rear', -1.0)] * (share - 1)] * MEMORY)


def test_first_angles_that_alternate_or_vary_are_used():
    rng = np.random.default_rng(0)
    assert not refused([('laser', -1.0 + 0.25 * k) for k in range(8)] * MEMORY)
    assert not refused([('laser', angle) for angle in rng.uniform(-3.0, 3.0, 3 * MEMORY)])
    assert not refused([('laser', -1.0 + e) for e in rng.uniform(0.0, 0.01, 3 * MEMORY)])


def test_sensor_that_was_set_up_in_another_way_is_followed():
    before = [('laser', -1.0)] * 2 * MEMORY
    assert refused(before + [('laser', -1.5)] * 50) == list(
        range(len(before), len(before) + REPEATED - 1)
    )


def test_each_value_is_compared_on_its_own():
    """Beams' times that vary, as a motor's speed does, do not hide a rare first angle."""
    times = 1e-4 * np.random.default_rng(0).uniform(0.9, 1.1, 3 * MEMORY)
    messages = [('laser', -1.0, 0.01, t) for t in times]
    messages[200] = ('laser', 0.5, 0.01, times[200])
    assert refused(messages) == [200]


@pytest.mark.parametrize('rare', [(0.01, 0.0), (0.01, 2e-5), (0.02, 1e-5), (-0.01, 1e-5)])
def test_rare_increment_is_refused_however_fast_the_laser(rare):
    messages = [('laser', -1.0, 0.01, 1e-5)] * 3 * MEMORY
    messages[200] = ('laser', -1.0, *rare)
    assert refused(messages) == [200]
