# SPDX-License-Identifier: Apache-2.0
"""How often a lost robot is looked for in the map."""

from types import SimpleNamespace

import numpy as np

from rlml_slam.params import Parameters
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.types import Health, Level

SECOND = 1_000_000_000


def searched(lasts, pose, period=SECOND // 10):
    """Seconds since it was lost at which a robot is searched."""
    at = []
    recovery, health = Recovery(Parameters()), Health(Level.LOST, ())
    for stamp in range(0, lasts * SECOND, period):
        frame = SimpleNamespace(
            stamp=SECOND + stamp, health=health, unconfirmed=False, T_map_base=pose(stamp / SECOND)
        )
        recovery.follow(frame)
        if recovery.is_due(frame):
            at.append(stamp / SECOND)
    return at


def test_robot_that_stands_is_looked_for_rarely_and_at_once_where_it_comes():
    at = searched(120, lambda t: np.array([max(t - 100.0, 0.0), 0.0, 0.0]))
    assert 20 < sum(t < 100.0 for t in at) < 60
    # a metre a second: looked for as soon as it has gone one, and then ever more rarely
    after = [t for t in at if t >= 100.0]
    assert after[0] <= 101.2
    assert 10 < len(after) < 15
