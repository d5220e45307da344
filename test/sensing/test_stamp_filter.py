# SPDX-License-Identifier: Apache-2.0
"""Stamps of a steady sensor lose their jitter; all others stay as they are."""

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.params import Node, Parameters
from rlml_slam.sensing.synchronization.observation_assembly import widened
from rlml_slam.sensing.synchronization.stamp_filter import ENOUGH, WINDOW, StampFilter
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.types import ANONYMOUS, Detections, Motion, Odometry

MS = 1_000_000
SECOND = 1000 * MS
REFLECTORS = np.array([[3.0, 1.0], [-2.0, 4.0], [1.0, 8.0], [5.0, 5.0]])
TWIST = np.array([1.0, 0.0, 0.3])


def filtered_stamps(stamps):
    clock = StampFilter()
    return np.array([clock.filtered(int(s)) for s in stamps])


def ticks(period, n):
    return SECOND + np.arange(n) * period * MS


def jittered(true, rng, sigma=20):
    return true + np.rint(sigma * MS * rng.standard_normal(len(true))).astype(np.int64)


@pytest.mark.parametrize('period', [100, 20, 10])
def test_jitter_of_a_steady_sensor_is_averaged_over_the_window(period):
    true = ticks(period, 8000)
    error = (filtered_stamps(jittered(true, np.random.default_rng(0))) - true)[WINDOW:] / MS
    # the end of a line through n stamps has 2 / sqrt(n) of their error; a tenth of it is the
    # sampling error of some twenty independent windows
    assert 0.7 * 2.0 < error.std() < 1.3 * 2.0


@pytest.mark.parametrize('seed', [1, 5])
def test_the_error_that_is_left_is_told(seed):
    # five sigmas per period: some late messages look as if one had been lost before
    true = ticks(100, 6000)
    stamps = jittered(true, np.random.default_rng(seed))
    clock, error, sigma = StampFilter(), [], []
    for t, s in zip(true, stamps, strict=True):
        error.append(clock.filtered(int(s)) - t)
        sigma.append(clock.sigma)
    normalised = (np.array(error) / np.maximum(sigma, 1.0))[ENOUGH:]
    assert 0.6 < normalised.std() < 1.5
    # before a line is believed, the stamps have all of their jitter
    assert 10 * MS < sigma[ENOUGH - 2] < 30 * MS
    assert filtered_stamps(true).tolist() == true.tolist()
    assert StampFilter().sigma == 0.0


def test_stamps_with_little_jitter_stay_as_they_are():
    true = ticks(100, 300) + np.random.default_rng(0).integers(0, 3 * MS, 300)
    np.testing.assert_array_equal(filtered_stamps(true), true)


def test_intervals_that_vary_are_not_jitter():
    rng = np.random.default_rng(0)
    for share in (0.02, 0.1, 0.3):
        steps = 100.0 * MS * np.maximum(1.0 + share * rng.standard_normal(3000), 0.1)
        true = SECOND + np.cumsum(steps).astype(np.int64)
        # a random walk may look like a line for a while
        assert np.mean(filtered_stamps(true) != true) < 0.05


def test_bursts_are_not_jitter():
    # ten at once every second: as far off a line as white jitter of three periods, but in order
    true = np.sort(ticks(1000, 200)[:, None] + np.arange(10) * MS, axis=None)
    np.testing.assert_array_equal(filtered_stamps(true), true)


def test_exact_stamps_of_messages_that_overtake_one_another_stay():
    rng = np.random.default_rng(6)
    true = ticks(20, 1000)
    late = np.argsort(true + rng.uniform(0.0, 80.0 * MS, len(true)), kind='stable')
    clock = StampFilter()
    for stamp in true[late]:
        assert clock.filtered(int(stamp)) == stamp
        assert clock.sigma == 0.0


def test_lost_messages_are_counted():
    true = ticks(100, 400)
    kept = np.delete(true, [150, 200, 201, *range(250, 256)])
    error = filtered_stamps(jittered(kept, np.random.default_rng(1), 10.0)) - kept
    assert np.abs(error[ENOUGH:]).max() < 20 * MS


@pytest.mark.parametrize('sigma', [12, 20])
@pytest.mark.parametrize('seed', [0, 5, 6])
def test_message_lost_before_there_is_a_line_does_not_hide_all_others(seed, sigma):
    rng = np.random.default_rng(seed)
    true = ticks(100, 6000)
    kept = true[(rng.random(len(true)) > 0.02) & (np.arange(len(true)) != 4)]
    error = (filtered_stamps(jittered(kept, rng, sigma)) - kept)[2 * WINDOW :] / MS
    # where one was lost, the stamp stays as it is
    assert np.mean(np.abs(error) > 0.5 * sigma) < 0.03
    assert np.sqrt((error**2).mean()) < 0.4 * sigma


def test_jump_of_the_clock_begins_another_line():
    true = np.concatenate([ticks(100, 200), 5 * SECOND // 3 + 500 * SECOND + ticks(100, 200)])
    stamps = jittered(true, np.random.default_rng(2))
    out = filtered_stamps(stamps)
    np.testing.assert_array_equal(out[200 : 200 + ENOUGH - 1], stamps[200 : 200 + ENOUGH - 1])
    assert np.std(out[350:] - true[350:]) < 0.6 * np.std(stamps[350:] - true[350:])


def test_the_same_stamp_is_told_the_same_again():
    clock = StampFilter()
    for s in jittered(ticks(100, 100), np.random.default_rng(3)):
        first = clock.filtered(int(s))
        assert clock.filtered(int(s)) == first


def observed(steady):
    """Errors [m] of what is seen of REFLECTORS on a drive where all stamps jitter by 20 ms."""
    rng = np.random.default_rng(4)
    synchronizer = Synchronizer(replace(Parameters(), node=Node(filter_stamps=steady)))
    stamps, out = set(), []
    for k in range(1500):
        pose = se2.exp(TWIST * k * 0.02)
        stamp = SECOND + k * 20 * MS + int(20 * MS * rng.standard_normal())
        out += synchronizer.add_odometry(Odometry(stamp, pose))
        if k % 5 == 0:
            stamp = SECOND + k * 20 * MS + int(20 * MS * rng.standard_normal())
            stamps.add(stamp)
            z = se2.transform(se2.inverse(pose), REFLECTORS)
            ids, cov = np.full(4, ANONYMOUS), np.tile(1e-4 * np.eye(2), (4, 1, 1))
            seen = Detections(stamp, 'base_link', z, cov, ids, np.full(4, np.nan))
            out += synchronizer.add_detections(seen)
    errors = []
    for o in out:
        seen = se2.transform(se2.exp(TWIST * (o.stamp - SECOND) / SECOND), o.detections.points)
        errors.append(float(np.sqrt(np.mean((seen - REFLECTORS) ** 2))))
    return np.array(errors)[60:], {o.stamp for o in out} <= stamps


def test_what_is_seen_is_moved_to_its_stamp_and_keeps_it():
    raw, _ = observed(False)
    steady, kept = observed(True)
    assert kept
    # 20 ms move what is seen by a few centimetres; a fifth of the jitter is left of it
    assert raw.mean() > 0.01
    assert steady.mean() < 0.4 * raw.mean()


def test_motion_between_jittered_stamps_is_less_sure():
    motion = Motion(np.array([0.1, 0.0, 0.05]), 1e-6 * np.eye(3))
    wider = widened(motion, 100 * MS, 0.02)
    shift = motion.delta / 0.1 * 0.02
    np.testing.assert_allclose(wider.cov - motion.cov, np.outer(shift, shift))
    assert widened(motion, 100 * MS, 0.0) is motion


def test_stamps_far_in_the_past_do_not_move_later_ones():
    true = ticks(20, 600)
    clock, rng = StampFilter(), np.random.default_rng(5)
    for stamp in true:
        clock.filtered(int(stamp))
        assert clock.filtered(int(stamp) + 5 * MS) == stamp + 5 * MS
        clock.filtered(int(stamp) - int(rng.integers(SECOND // 5, 20 * SECOND)))
        assert abs(clock.filtered(int(stamp) + 6 * MS) - stamp - 6 * MS) < 10 * MS
