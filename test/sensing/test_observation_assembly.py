# SPDX-License-Identifier: Apache-2.0
import numpy as np

from rlml_slam import se2
from rlml_slam.motion import MAX_VARIANCE, SECOND
from rlml_slam.params import Parameters
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.observation_assembly import (
    MAX_LATE,
    ObservationAssembly,
    limited,
)
from rlml_slam.sensing.synchronization.waiting_queue import Waiting
from rlml_slam.types import Motion, Odometry, Scan

T0 = 10 * SECOND
STEP = SECOND // 50
TWIST = np.array([0.8, 0.0, 0.3])


def pose_at(stamp):
    return se2.exp(TWIST * (stamp - T0) / SECOND)


def driven(seconds=2.0):
    """An assembly with odometry of a drive."""
    assembly = ObservationAssembly(Parameters(), InputCounts())
    for k in range(round(seconds * 50) + 1):
        assembly.buffer.add_odometry(Odometry(T0 + k * STEP, pose_at(T0 + k * STEP)))
    return assembly


def scan(stamp):
    ranges, none = np.full(3, 2.0, dtype=np.float32), np.zeros(0, dtype=np.float32)
    return Scan(stamp, 'laser', -1.0, 1.0, 0.0, 0.1, 20.0, ranges, none)


def waiting(stamp, delay=0):
    return [Waiting(stamp, 'scan', scan(stamp), delay)]


def test_motion_is_that_since_the_last_observation():
    assembly = driven()
    first = assembly.assemble(T0, waiting(T0), (0.0, 0.0))
    np.testing.assert_array_equal(first.motion.delta, 0.0)
    later = T0 + SECOND
    second = assembly.assemble(later, waiting(later), (0.0, 0.0))
    # midpoint chords of 20 ms: (w dt)^2 / 24 = 1.5e-6 of 0.8 m
    np.testing.assert_allclose(second.motion.delta, pose_at(later), atol=2e-6)
    assert assembly.last == later


def test_points_of_a_delayed_scan_are_in_the_base_frame_at_its_stamp():
    assembly = driven()
    stamp, delay = T0 + SECOND, 100_000_000
    on_time = driven().assemble(stamp, waiting(stamp), (0.0, 0.0))
    delayed = assembly.assemble(stamp, waiting(stamp, delay), (0.0, 0.0))
    moved = se2.between(pose_at(stamp), pose_at(stamp + delay))
    np.testing.assert_allclose(delayed.points, se2.transform(moved, on_time.points), atol=1e-6)
    np.testing.assert_allclose(delayed.origin, moved[:2], atol=1e-6)


def test_first_unknown_frame_of_a_stream_gets_the_laser_pose_and_others_none():
    assembly = driven()
    assert assembly.has_frame('scan', 'laser')
    assert not assembly.has_frame('scan', 'attic')
    assembly.set_sensor_pose('attic', np.zeros(3))
    assert assembly.has_frame('scan', 'attic')


def test_motion_of_a_long_time_without_observations_is_carried():
    assembly = driven(12.0)
    assembly.assemble(T0, waiting(T0), (0.0, 0.0))
    assembly.carry(T0 + 2 * MAX_LATE)
    assert assembly.last == T0 + MAX_LATE
    stamp = T0 + 12 * SECOND
    observation = assembly.assemble(stamp, waiting(stamp), (0.0, 0.0))
    np.testing.assert_allclose(observation.motion.delta, pose_at(stamp), atol=2e-5)


def test_no_motion_is_more_uncertain_than_can_be_computed_with():
    cov = np.array([[4e18, 1e12, 0.0], [1e12, 4e6, 10.0], [0.0, 10.0, 0.25]])
    found = limited(Motion(np.zeros(3), cov, known=False)).cov
    np.testing.assert_allclose(np.diag(found), [MAX_VARIANCE, MAX_VARIANCE, 0.25])
    np.testing.assert_allclose(found, found.T)
    correlation = cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    np.testing.assert_allclose(
        found / np.sqrt(np.outer(np.diag(found), np.diag(found))), correlation
    )
    plain = Motion(np.zeros(3), np.eye(3))
    assert limited(plain) is plain
