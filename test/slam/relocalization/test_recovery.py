# SPDX-License-Identifier: Apache-2.0
"""How often a lost robot is looked for in the map."""

from types import SimpleNamespace

import numpy as np

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.slam.relocalization import recovery
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Health, Level, Reflectors, Verdict

SECOND = 1_000_000_000


def no_reflectors():
    none, points = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    return Reflectors(none, points, np.zeros((0, 2, 2)), none, none, np.zeros(0))


def searched(monkeypatch, lasts, pose, period=SECOND // 10):
    """Seconds since it was lost at which a robot is looked for."""
    now, at = [0], []

    def localize_globally(*_):
        at.append(now[0] / SECOND)
        return Relocation(Verdict.IMPOSSIBLE, 'no place fits')

    monkeypatch.setattr(recovery, 'localize_globally', localize_globally)
    looks, health = Recovery(Parameters()), Health(Level.LOST, ())
    saved = SavedMap(no_reflectors())
    for stamp in range(0, lasts * SECOND, period):
        now[0] = stamp
        frame = SimpleNamespace(
            stamp=SECOND + stamp, health=health, unconfirmed=False, observation=None,
            T_map_base=pose(stamp / SECOND),
        )  # fmt: skip
        assert looks.look(frame, lambda: saved, True) is None
    return at


def test_robot_that_stands_is_looked_for_rarely_and_at_once_where_it_comes(monkeypatch):
    at = searched(monkeypatch, 120, lambda t: np.array([max(t - 100.0, 0.0), 0.0, 0.0]))
    assert 20 < sum(t < 100.0 for t in at) < 60
    # a metre a second: looked for as soon as it has gone one
    assert 17 < sum(t >= 100.0 for t in at) < 21
