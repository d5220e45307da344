# SPDX-License-Identifier: Apache-2.0
"""A gyro that is dead, upside down or in degrees is not used; one beside wheels that slip is."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.motion import SECOND
from rlml_slam.params import Node, Parameters
from rlml_slam.sensing.synchronization.gyro_check import DEGREES, FAULTS, MEMORY, GyroCheck
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Imu, Odometry, Scan

START = 1_700_000_000 * SECOND
DEAD, FLIPPED, IN_DEGREES = FAULTS


def rate_at(t):
    """Of a robot that stands, then turns to and fro [rad/s]."""
    return 0.0 if t < 2.0 else 0.9 * math.cos(0.7 * (t - 2.0))


def drive(check, gyro=1.0, wheels=1.0, scans=1.0, seconds=20.0, late=0.0, begin=0.0, rate=rate_at):
    """IMU at 100 Hz, odometry at 50 and poses of scans at 10, as shares of the true turn."""
    true = 0.0
    for k in range(round(begin * 100), round((begin + seconds) * 100)):
        t = k / 100.0
        stamp = START + k * SECOND // 100
        true += rate(t) / 100.0
        check.add_imu(Imu(stamp, gyro * rate(t - late)))
        if k % 2 == 0:
            check.add_odometry(stamp, float(se2.wrapped(wheels * true)))
        if k % 10 == 0 and scans is not None:
            check.add_pose(float(se2.wrapped(scans * true)))
    return check.fault


@pytest.mark.parametrize('scans', [1.0, None])
@pytest.mark.parametrize(
    ('gyro', 'fault'),
    [
        (0.0, DEAD), (0.05, DEAD), (-1.0, FLIPPED), (-1.1, FLIPPED), (DEGREES, IN_DEGREES),
        (1.0, ''), (0.6, ''), (1.6, ''), (-0.5, ''), (-DEGREES, ''), (20.0, ''),
    ],
)  # fmt: skip
def test_only_the_three_faults_of_a_set_up_are_found(gyro, fault, scans):
    check = GyroCheck()
    assert drive(check, gyro, scans=scans) == fault
    assert check.error.endswith(fault)


def test_error_has_the_figures():
    check = GyroCheck()
    drive(check, 0.0, rate=lambda t: 1.0)
    assert 'turned by 0.00 rad where odometry turned by 0.48 rad' in check.error


def test_two_windows_decide():
    """Half a radian each, with what it turns until its end."""
    check = GyroCheck()
    assert not drive(check, 0.0, seconds=0.8, rate=lambda t: 1.0)
    assert drive(check, 0.0, seconds=0.6, begin=0.8, rate=lambda t: 1.0)


def test_wheels_that_spin_while_scans_see_no_turn_decide_nothing():
    assert not drive(GyroCheck(), gyro=0.0, scans=1e-6)
    # nor those of which the sign is wrong
    assert not drive(GyroCheck(), gyro=-1.0, scans=-1.0)
    # without scans, a gyro that has agreed for long is believed for long
    check = GyroCheck()
    drive(check, scans=None, seconds=120.0)
    assert not drive(check, gyro=0.0, scans=None, begin=120.0, seconds=10.0)


@pytest.mark.parametrize('late', [0.05, 0.2, -0.2])
@pytest.mark.parametrize('speed', [0.7, 2.0])
def test_late_gyro_is_not_wrong(late, speed):
    assert not drive(
        GyroCheck(), seconds=60.0, late=late, rate=lambda t: 0.9 * math.cos(speed * t)
    )


def test_carried_robot_keeps_its_gyro():
    assert not drive(GyroCheck(), wheels=0.0)


def test_gyro_that_agrees_again_is_used_again():
    check = GyroCheck()
    assert drive(check, gyro=0.0, seconds=60.0)
    assert not drive(check, begin=60.0, seconds=60.0)


def test_gyro_that_dies_is_found():
    check = GyroCheck()
    drive(check, seconds=60.0)
    assert drive(check, gyro=0.0, begin=60.0, seconds=5.0 * MEMORY) == DEAD


@pytest.mark.parametrize('pause', ['imu', 'odometry'])
def test_windows_with_a_gap_do_not_count(pause):
    check = GyroCheck()
    for k in range(2000):
        stamp, is_gap = START + k * SECOND // 100, k % 100 < 60
        if pause != 'imu' or not is_gap:
            check.add_imu(Imu(stamp, 0.0))
        if k % 2 == 0 and (pause != 'odometry' or k % 400 > 300):
            check.add_odometry(stamp, float(se2.wrapped(0.01 * k)) if k % 200 else 0.0)
        if k % 40 == 0:
            check.restart()
    assert check.fault == ''


def fed(gyro, jumps=False):
    """A synchronizer after a turn of 4 s."""
    synchronizer = Synchronizer(Parameters())
    for k in range(400):
        stamp = START + k * SECOND // 100
        synchronizer.add_imu(Imu(stamp, gyro))
        if k % 2 == 0:
            away = 50.0 * (jumps and k // 20 % 2)
            synchronizer.add_odometry(Odometry(stamp, np.array([away, 0.0, 0.01 * k])))
    return synchronizer


def test_wrong_gyro_is_not_used_any_more_and_counted():
    synchronizer = fed(-1.0)
    counts = synchronizer.inputs.counts['imu']
    assert counts['contradicts'] > 200
    assert 'its sign is wrong' in synchronizer.inputs.first_errors['imu']
    motion = synchronizer.buffer.motion(START + SECOND // 2, START + 3 * SECOND)
    assert motion.delta[2] == pytest.approx(2.5, abs=1e-6)  # that of odometry
    assert not motion.bias_gain.any()


def test_in_degrees_most_rates_are_those_of_no_robot():
    counts = fed(DEGREES).inputs.counts['imu']
    assert counts['invalid'] == 400


def test_odometry_that_jumps_decides_nothing():
    assert fed(0.0, jumps=True).gyro.fault == ''


@pytest.fixture(scope='module')
def rooms():
    """Four drives: of one, the error is half as large or twice as large by chance."""
    return [[event.message for event in Simulation(load_world('room'), seed=k)] for k in range(4)]


def driven(messages, gyro, use_imu=True):
    """RMS error of the heading [rad] in the second half of a drive, and the fate of the rates."""
    slam = Slam(Parameters(node=Node(use_reflectors=False, use_imu=use_imu)))
    truth, errors = {}, []
    for m in messages:
        frames = []
        if isinstance(m, GroundTruth):
            truth[m.stamp] = m.T_map_base[2]
        elif isinstance(m, Imu):
            slam.add_imu(replace(m, yaw_rate=gyro * m.yaw_rate))
        elif isinstance(m, Odometry):
            frames = slam.add_odometry(m)
        elif isinstance(m, Scan):
            frames = slam.add_scan(m)
        errors += [se2.wrapped(f.T_map_base[2] - truth[f.stamp]) for f in frames]
    return np.sqrt(np.mean(np.square(errors[len(errors) // 2 :]))), slam.counts.get('imu')


def test_wrong_gyro_costs_a_drive_no_more_than_none(rooms):
    assert set(driven(rooms[0], 1.0)[1]) == {'used'}
    without = np.mean([driven(room, 1.0, use_imu=False)[0] for room in rooms])
    for gyro in (0.0, -1.0):
        errors = []
        for room in rooms:
            error, counts = driven(room, gyro)
            assert counts['contradicts'] > 2 * counts['used']
            errors.append(error)
        assert np.mean(errors) < 1.5 * without  # five times as large if it is believed
