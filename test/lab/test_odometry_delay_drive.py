# SPDX-License-Identifier: Apache-2.0
"""A drive through the hall, without an IMU, whose odometry is stamped late."""

from dataclasses import replace

import numpy as np
import pytest

from rlml_lab.faults import fault_run, recording
from rlml_lab.faults.fault_catalog import late
from rlml_lab.support.drives import feed_one
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.motion import SECOND
from rlml_slam.params import Node, Parameters
from rlml_slam.recordings.bag_replay import patient
from rlml_slam.slam.offline.slam import Slam

DELAY = 0.15


@pytest.fixture(scope='module')
def hall():
    return recording.simulated('hall', 0)


def worst(given, estimate):
    """Largest error [m] of the published poses in the second half of the drive."""
    node = Node(use_imu=False, estimate_odometry_delay=estimate)
    log = fault_run.run(given, late(DELAY), 0, replace(Parameters(), node=node))[2]
    poses = Trajectory(np.array(log.stamps), np.array(log.poses).reshape(-1, 3))
    distances = trajectory_errors(poses, given.truth).distances
    return distances[len(distances) // 2 :].max()


class Watched(Slam):
    """Remembers the observations."""

    def __init__(self, params):
        super().__init__(params)
        self.seen = []

    def process(self, observations):
        observations = list(observations)
        self.seen += observations
        return super().process(observations)


def driven_live(given, delay):
    """The system as it is on a robot, where nothing waits longer than ``odom_timeout``."""
    slam = Watched(replace(Parameters(), node=Node(use_imu=False, use_reflectors=False)))
    for message in late(delay)(given.messages, np.random.default_rng(0)):
        feed_one(slam, message)
    return slam


def test_early_odometry_has_a_pose_at_every_scan(hall):
    slam = driven_live(hall, -0.2)
    assert abs(slam.synchronizer.delay.now / SECOND + 0.2) < 0.025
    missing = [o.odom_pose is None for o in slam.seen]
    assert len(missing) > 1000
    assert sum(missing) <= 3


def test_scans_do_not_wait_in_vain_for_odometry_that_is_too_late(hall):
    slam = driven_live(hall, 0.3)
    assert slam.synchronizer.delay.now / SECOND > 0.25
    assert slam.counts['scan'].get('waited_out', 0) < 30


def test_delay_of_a_drive_is_found(hall):
    slam = Slam(patient(Parameters()))
    for message in late(DELAY)(hall.messages, np.random.default_rng(0)):
        feed_one(slam, message)
    assert abs(slam.synchronizer.delay.now / SECOND - DELAY) < 0.025


def test_poses_are_right_once_the_delay_is_found(hall):
    found, ignored = worst(hall, True), worst(hall, False)
    assert found < 0.025
    assert found < 0.6 * ignored
