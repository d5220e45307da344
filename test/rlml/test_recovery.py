# SPDX-License-Identifier: Apache-2.0
"""How often a lost robot is looked for in the map."""

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from rlml_slam.maps.saved import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.rlml import recovery
from rlml_slam.rlml.recovery import PERIOD, RARER, Recovery
from rlml_slam.rlml.relocalize import Relocation
from rlml_slam.types import Health, Level, Reflectors, Verdict

SECOND = 1_000_000_000


def no_reflectors():
    none, points = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    return Reflectors(none, points, np.zeros((0, 2, 2)), none, none, np.zeros(0))


def searched(monkeypatch, lasts, period=SECOND // 10):
    """Seconds since it was lost at which a robot is looked for."""
    now, at = [0], []

    def find_place(*_):
        at.append(now[0] / SECOND)
        return Relocation(Verdict.IMPOSSIBLE, 'no place fits')

    monkeypatch.setattr(recovery, 'find_place', find_place)
    looks, health = Recovery(Parameters()), Health(Level.LOST, ())
    saved = SavedMap(no_reflectors())
    for stamp in range(0, lasts * SECOND, period):
        now[0] = stamp
        frame = SimpleNamespace(
            stamp=SECOND + stamp, health=health, doubtful=False, observation=None
        )
        assert looks.look(frame, lambda: saved, True) is None
    return at


def test_robot_is_looked_for_three_times_a_second_at_first(monkeypatch):
    at = searched(monkeypatch, 3)
    assert len(at) == math.ceil(3 * SECOND / PERIOD)


def test_it_is_found_a_tenth_late_at_worst_and_the_cost_is_bounded(monkeypatch):
    at = searched(monkeypatch, 3600)
    assert all(b - a <= max(PERIOD / SECOND, a / RARER) + 0.1 for a, b in pairwise(at))
    # ten in the first seconds, then a geometric series
    assert len(at) < RARER + math.log(3600.0 / 3.0) / math.log(1.0 + 1.0 / RARER) + 1
