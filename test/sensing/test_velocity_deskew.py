# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.sensing.velocity_deskew import deskewed
from rlml_slam.types import Motion, Observation, Scan

RAY = 2e-4  # [s] from one beam to the next
N = 360
VELOCITY = np.array([0.8, -0.05, 0.6])
T_BASE_LASER = np.array([0.2, 0.1, 0.05])


def observed(gyro=False, ray=RAY):
    """A sweep, taken on the way, of points that stand in the base frame at the stamp."""
    angles = -1.5 + 3.0 / N * np.arange(N)
    points = 4.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ranges = np.empty(N, dtype=np.float32)
    laser = se2.compose(se2.exp(VELOCITY * (ray * np.arange(N))[:, None]), T_BASE_LASER)
    # cast along each beam at a circle around where the base was at the stamp
    beam = laser[:, 2] + angles
    d = np.stack([np.cos(beam), np.sin(beam)], axis=1)
    along = np.einsum('ni,ni->n', laser[:, :2], d)
    ranges[:] = -along + np.sqrt(along**2 - (laser[:, :2] ** 2).sum(axis=1) + 16.0)
    scan = Scan(0, 'laser', -1.5, 3.0 / N, ray, 0.1, 30.0, ranges, np.zeros(0, np.float32))
    gain = np.array([0.0, 0.0, -0.1 if gyro else 0.0])
    sweep = np.zeros((4, 3))
    sweep[:, 2] = VELOCITY[2] * ray * N * np.arange(1, 5) / 4.0 if gyro else 0.0
    motion = Motion(np.zeros(3), np.eye(3), False, gain)
    return points, Observation(
        0, motion, points, T_BASE_LASER[:2], scan=scan, T_base_laser=T_BASE_LASER, sweep=sweep
    )


@pytest.mark.parametrize('gyro', [False, True])
def test_end_points_lie_where_they_did_at_the_stamp(gyro):
    _, observation = observed(gyro)
    # with a gyro, its turn counts and not that of the state
    velocity = VELOCITY + np.array([0.0, 0.0, 0.5 if gyro else 0.0])
    out, sweep = deskewed(observation, velocity, 30.0)
    # the chord in the place of the arc
    np.testing.assert_allclose(np.hypot(*out.points.T), 4.0, atol=1e-4)
    np.testing.assert_allclose(sweep.half[:2], 0.5 * N * RAY)
    assert sweep.half[2] == (0.0 if gyro else sweep.half[0])


def test_scan_of_one_instant_stays_as_it_is():
    _, observation = observed(ray=0.0)
    out, sweep = deskewed(observation, VELOCITY, 30.0)
    assert out is observation
    assert not sweep.half.any()
