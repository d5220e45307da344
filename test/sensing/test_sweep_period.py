# SPDX-License-Identifier: Apache-2.0
import numpy as np

from rlml_slam.sensing.synchronization.sweep_period import SweepPeriod


def test_stamps_of_a_steady_laser_are_believed():
    clock = SweepPeriod()
    for dt in 0.1 + 0.01 * np.random.default_rng(0).standard_normal(200):
        assert clock.elapsed(dt) == (dt, 0.0)


def test_lost_sweeps_are_time_that_passed():
    clock = SweepPeriod()
    got = [clock.elapsed(0.3 if k % 7 == 0 else 0.1) for k in range(200)]
    assert got == [(0.3 if k % 7 == 0 else 0.1, 0.0) for k in range(200)]


def test_sweeps_that_come_in_bursts_are_a_period_apart_and_that_is_as_sure_as_the_stamps():
    clock, burst = SweepPeriod(), [0.37, 0.002, 0.026, 0.402]
    got = np.array([clock.elapsed(dt) for dt in burst * 50])
    np.testing.assert_allclose(got[40:, 0], 0.2, rtol=0.05)
    np.testing.assert_allclose(got[40:, 1], np.std(burst), rtol=0.05)


def test_nothing_is_said_before_the_period_is_known():
    clock = SweepPeriod()
    assert [clock.elapsed(dt)[0] for dt in (0.4, 0.001, 0.4)] == [0.4, 0.001, 0.4]
    assert clock.elapsed(0.5) == (0.5, 0.0)
