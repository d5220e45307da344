# SPDX-License-Identifier: Apache-2.0
"""A laser that sees little of bare walls keeps the heading along them (eq. 68)."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.params import Parameters
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Odometry, Scan

SPEED, PERIOD, EVERY, STEPS = 0.6, 0.05, 4, 1000  # [m/s], [s], odometry per scan; 30 m in all
BEAM, SIGMA = np.radians(1.0), 0.01
BESIDE, BEHIND, BEYOND = 1.0, -20.0, 60.0  # [m] from the way to a wall, and where it ends
LEFT, BOTH = (1.0,), (1.0, -1.0)


def ranges(x, angles, sides, reach, rng):
    """Of the walls beside a robot at (x, 0) that looks along them."""
    r = np.full(len(angles), np.inf)
    for side in sides:
        with np.errstate(divide='ignore'):
            d = side * BESIDE / np.sin(angles)
        hit = x + d * np.cos(angles)
        seen = (d > 0.0) & (d <= reach) & (hit >= BEHIND) & (hit <= BEYOND)
        r = np.where(seen, np.minimum(r, d), r)
    return (r + SIGMA * rng.standard_normal(len(r))).astype(np.float32)


def turned(first, last, sides, reach, seed):
    """Heading [rad] after a straight way, where odometry is right."""
    rng, slam, frames = np.random.default_rng(seed), Slam(Parameters()), []
    slam.set_sensor_pose('laser', np.zeros(3))
    angles = np.arange(np.radians(first), np.radians(last) + 1e-9, BEAM)
    pose = np.zeros(3)
    for k in range(STEPS):
        stamp = 10**9 + int(k * PERIOD * 1e9)
        frames += slam.add_odometry(Odometry(stamp, pose))
        if k % EVERY == 0:
            r = ranges(pose[0], angles, sides, reach, rng)
            frames += slam.add_scan(
                Scan(stamp, 'laser', angles[0], BEAM, 0.0, 0.05, 30.0, r, np.zeros(0, np.float32))
            )
        pose = se2.compose(pose, np.array([SPEED * PERIOD, 0.0, 0.0]))
    return abs(frames[-1].T_map_base[2])


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize(
    ('first', 'last', 'sides', 'reach'),
    [
        (-90, 90, BOTH, 30.0),
        (-90, 90, LEFT, 30.0),
        (-90, 90, LEFT, 4.0),
        (-45, 45, LEFT, 30.0),
        (30, 90, BOTH, 30.0),
        (100, 170, LEFT, 30.0),
    ],
    ids=['both walls', 'one wall', 'short reach', 'narrow', 'short part of a wall', 'behind'],
)
def test_heading_stays_along_walls_of_which_little_is_seen(first, last, sides, reach, seed):
    assert turned(first, last, sides, reach, seed) < np.radians(2.5)
