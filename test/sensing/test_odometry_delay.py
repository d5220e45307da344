# SPDX-License-Identifier: Apache-2.0
"""The delay of odometry is found from turns, and where there is none, none is said."""

import math

import numpy as np
import pytest

from rlml_slam.motion import SECOND, STILL, MotionBuffer
from rlml_slam.params import MotionNoise, Parameters
from rlml_slam.sensing.synchronization.odometry_delay import OdometryDelay
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.types import Frame, Observation, Odometry, Status

START = 1_700_000_000 * SECOND


def heading(t):
    """Of a robot that turns to and fro [rad]."""
    return 0.8 * np.sin(0.9 * t) + 0.3 * np.sin(2.3 * t + 1.0)


def drive(delay, seconds=120.0, scale=1.0, noise=0.003, slips=0.0, seed=0, course=heading):
    """Odometry at 20 Hz stamped ``delay`` [s] late, poses at 5 Hz; the delays [ns] found."""
    rng = np.random.default_rng(seed)
    found, slipped = OdometryDelay(), 0.0
    events = [(t + delay, 'odometry', t) for t in np.arange(0.0, seconds, 0.05)]
    events += [(t, 'pose', t) for t in np.arange(0.0, seconds, 0.2)]
    said = []
    for stamp, kind, t in sorted(events):
        at = START + round(stamp * SECOND)
        if kind == 'odometry':
            slipped += 0.1 * (rng.random() < slips)
            found.add_odometry(at, scale * course(t) + slipped + noise * rng.standard_normal())
        else:
            found.add_pose(at, course(t) + noise * rng.standard_normal())
        said.append(found.now)
    return np.array(said)


@pytest.mark.parametrize('delay', [-0.2, -0.07, 0.03, 0.1, 0.25])
@pytest.mark.parametrize('seed', range(3))
def test_delay_is_found(delay, seed):
    said = drive(delay, seed=seed)
    assert said[0] == 0
    assert (np.abs(said[len(said) // 2 :] / SECOND - delay) < 0.016).all()


def test_delay_at_the_end_of_the_grid_may_be_larger():
    assert drive(0.4)[-1] == 3 * SECOND // 10
    delay = OdometryDelay()
    delay.now = 3 * SECOND // 10
    assert str(delay) == 'late by at least 0.30 s'
    delay.now = -SECOND // 10
    assert str(delay) == 'early by 0.10 s'


@pytest.mark.parametrize('change', [{}, {'scale': 0.9}, {'slips': 0.01}, {'noise': 0.02}])
def test_odometry_that_is_wrong_in_other_ways_is_not_late(change):
    assert not drive(0.0, **change).any()


def test_delay_is_found_where_wheels_slip():
    assert abs(drive(0.1, scale=0.95, slips=0.01)[-1] / SECOND - 0.1) < 0.016


def standing(t):
    return 0.0 * t


def in_aisles(t):
    """Of a vehicle that drives straight for 17 s and turns by 90 degrees in 3 s."""
    k = np.floor(t / 20.0)
    share = np.clip((t - 20.0 * k) / 3.0, 0.0, 1.0)
    return 0.5 * np.pi * (k + share**2 * (3.0 - 2.0 * share))


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('noise', [0.001, 0.003])
def test_noise_of_a_robot_that_stands_is_no_delay(noise, seed):
    assert not drive(0.0, 300.0, noise=noise, seed=seed, course=standing).any()


@pytest.mark.parametrize('delay', [0.0, 0.15, -0.1])
@pytest.mark.parametrize('seed', range(3))
def test_few_turns_are_enough(delay, seed):
    said = drive(delay, 600.0, noise=0.001, seed=seed, course=in_aisles)
    assert abs(said[-1] / SECOND - delay) < 0.016


def test_poses_that_pause_cost_no_memory_and_turns_across_the_pause_do_not_count():
    found = OdometryDelay()
    found.add_pose(START, 0.0)
    for k in range(20_000):
        found.add_odometry(START + k * SECOND // 100, 0.01 * (k % 300))
    assert len(found._odometry) < 600
    for k in range(500):
        found.add_pose(START + 100 * SECOND + k * SECOND // 5, 1.0 * k)
    assert found.now == 0


def test_stamps_that_go_back_are_not_compared_with_those_before():
    found = OdometryDelay()
    late = 0.1
    for begin in (START, START - 100 * SECOND):
        for k in range(900):
            t = 0.1 * k
            found.add_odometry(begin + round((t + late) * SECOND), heading(t))
            found.add_pose(begin + round(t * SECOND), heading(t))
        assert abs(found.now / SECOND - late) < 0.011
    assert str(found) == 'late by 0.10 s'


def test_motion_is_that_of_odometry_stamped_right():
    buffers = [MotionBuffer(MotionNoise(), 100.0) for _ in range(3)]
    delay = SECOND // 5
    buffers[1].set_odometry_delay(delay)
    for k in range(200):
        pose = np.array([0.02 * k, 0.0, heading(0.05 * k)])
        stamp = START + k * SECOND // 20
        buffers[0].add_odometry(Odometry(stamp, pose))
        buffers[1].add_odometry(Odometry(stamp + delay, pose))
        buffers[2].add_odometry(Odometry(stamp + delay, pose))
        if k == 100:
            buffers[2].set_odometry_delay(delay)
    begin, end = START + 3 * SECOND, START + 8 * SECOND
    right, *shifted = (b.motion(begin, end) for b in buffers)
    for motion in shifted:
        np.testing.assert_allclose(motion.delta, right.delta, atol=1e-12)
        np.testing.assert_allclose(motion.cov, right.cov, atol=1e-12)
    # others look up the pose that has the stamp
    np.testing.assert_allclose(buffers[1].pose_at(end + delay), buffers[0].pose_at(end))
    assert buffers[1].newest == buffers[0].newest
    buffers[1].forget_odometry_after(end + delay)
    buffers[0].forget_odometry_after(end)
    assert buffers[1].newest == buffers[0].newest


def followed(delay, measured, seconds=120.0, until=math.inf):
    """The delay [s] found of poses of which every second one was ``measured``, for a while.

    The others are those of the odometry as it is used, delay and all.
    """
    synchronizer = Synchronizer(Parameters())
    last = moved = heading(-delay)
    for k in range(round(seconds * 20)):
        t = k / 20.0
        sample = np.array([0.0, 0.0, heading(t - delay)])
        stamp = START + round(t * SECOND)
        synchronizer.add_odometry(Odometry(stamp, sample))
        if k % 4:
            continue
        is_measured = k % 8 == 0 and t < until
        used = heading(t - delay + synchronizer.delay.now / SECOND)
        last = heading(t) if is_measured else last + used - moved
        moved = used
        status = Status.USED if is_measured and measured == 'reflectors' else Status.NEW
        pose = np.array([0.0, 0.0, last])
        frame = Frame(
            stamp, Observation(stamp, STILL), pose, np.eye(3), pose, np.eye(3), np.array([0]),
            np.array([status]), scan_used=is_measured and measured == 'scan',
        )  # fmt: skip
        synchronizer.follow(frame)
    return synchronizer.delay


@pytest.mark.parametrize('delay', [0.2, -0.2, 0.0])
@pytest.mark.parametrize('measured', ['scan', 'reflectors'])
def test_poses_of_the_odometry_itself_say_nothing_of_its_delay(delay, measured):
    assert abs(followed(delay, measured).now / SECOND - delay) < 0.016


def test_where_nothing_is_measured_nothing_is_compared():
    short, long = followed(0.2, 'scan', 60.0), followed(0.2, 'scan', 300.0, until=60.0)
    assert abs(long.now / SECOND - 0.2) < 0.016
    assert long._num == pytest.approx(short._num, abs=1.5)
    assert followed(0.2, 'nothing')._num == 0.0
