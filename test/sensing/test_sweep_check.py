# SPDX-License-Identifier: Apache-2.0
"""A sweep that does not fit between two scans is cut; lasers that share a frame are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam.motion import SECOND
from rlml_slam.params import Node, Parameters, SimulatorParameters
from rlml_slam.sensing.deskew import sweep_time
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.sweep_check import LASERS, SweepCheck
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Odometry, Scan

N = 400
PERIOD = 0.1  # [s]


def sweeps(stamps, sweep, first_angles=(-2.0,), frame='laser'):
    """Durations [s] of the sweeps as they are used, and the counts."""
    inputs = InputCounts()
    check, out = SweepCheck(inputs), []
    for k, t in enumerate(stamps):
        ranges = np.ones(N, np.float32)
        scan = Scan(
            SECOND + round(t * SECOND), frame, first_angles[k % len(first_angles)], 0.01,
            sweep / N, 0.1, 20.0, ranges, ranges[:0],
        )  # fmt: skip
        out.append(sweep_time(check.possible(scan)))
    return np.array(out), inputs


REGULAR = PERIOD * np.arange(60)


@pytest.mark.parametrize('factor', [1.5, 2.0, 5.0, 1000.0])
def test_sweep_that_is_too_long_ends_at_the_next_scan(factor):
    found, inputs = sweeps(REGULAR, factor * PERIOD)
    np.testing.assert_allclose(found[6:], PERIOD, rtol=1e-6)
    assert inputs.counts['scan']['sweep_time'] >= 54
    assert 'no sweep of 0 to ' in inputs.first_errors['scan']


def test_sweep_that_cannot_be_has_no_ray_times():
    found, inputs = sweeps(REGULAR, -PERIOD)
    assert not found.any()
    assert inputs.counts['scan']['sweep_time'] == 60
    assert not sweeps(REGULAR[:4], 30.0)[0].any()  # the period is not known yet


def jittered(rng):
    return REGULAR + rng.normal(0.0, 0.01, len(REGULAR))


@pytest.mark.parametrize(
    ('stamps', 'angles'),
    [
        (REGULAR, (-2.0,)),
        (REGULAR[::2], (-2.0,)),  # every second scan is lost
        (np.delete(REGULAR, [20, 21, 33]), (-2.0,)),
        (jittered(np.random.default_rng(0)), (-2.0,)),
        (REGULAR, (-2.0, -1.995)),  # interlaced
        (np.sort([*REGULAR, *REGULAR + 0.04]), (-2.0, 1.0)),  # two lasers, one frame
        (np.sort([*REGULAR, *REGULAR + 0.002, *REGULAR + 0.004]), (-2.0,)),  # layers
        (np.where(REGULAR > 3.0, REGULAR + 5.0, REGULAR), (-2.0,)),  # a pause
    ],
)
def test_sound_sweep_stays_as_it_is(stamps, angles):
    found, inputs = sweeps(stamps, PERIOD, angles)
    np.testing.assert_allclose(found, PERIOD)
    assert not inputs.counts


def test_period_is_that_of_each_laser():
    """The sweep of a slow laser is longer than the period of a fast one beside it."""
    check = SweepCheck(InputCounts())
    ranges = np.ones(N, np.float32)
    for k in range(100):
        frame, sweep = ('slow', 0.2) if k % 5 == 0 else ('fast', 0.04)
        scan = Scan(
            SECOND + k * SECOND // 25, frame, -2.0, 0.01, sweep / N, 0.1, 20.0, ranges, ranges
        )
        assert check.possible(scan) is scan


def error_of_drive(messages, factor):
    """RMS error [m] of a drive whose rays are said to last ``factor`` times as long."""
    pose = SimulatorParameters().node.laser_pose
    slam = Slam(Parameters(node=Node(use_reflectors=False, laser_pose=pose)))
    truth, errors = {}, []
    for m in messages:
        frames = []
        if isinstance(m, GroundTruth):
            truth[m.stamp] = m.T_map_base
        elif isinstance(m, Odometry):
            frames = slam.add_odometry(m)
        elif isinstance(m, Scan):
            frames = slam.add_scan(replace(m, time_increment=factor * m.time_increment))
        errors += [(f.T_map_base - truth[f.stamp])[:2] for f in frames]
    return np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))


def test_wrong_time_per_ray_costs_a_drive_little():
    messages = [event.message for event in Simulation(load_world('room'), seed=0)]
    right, wrong = (error_of_drive(messages, factor) for factor in (1.0, 5.0))
    assert right < 0.015
    assert wrong < right + 0.005


def test_names_of_frames_cost_no_memory():
    check = SweepCheck(InputCounts())
    ranges = np.ones(N, np.float32)
    for k in range(1000):
        scan = Scan(SECOND * k, f'laser{k}', -2.0, 0.01, 0.0, 0.1, 20.0, ranges, ranges[:0])
        assert check.possible(scan) is scan
    assert len(check._stamps) == LASERS
