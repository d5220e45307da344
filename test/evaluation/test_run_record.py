# SPDX-License-Identifier: Apache-2.0
"""The truth of a run whose map begins later than the truth does."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.run_record import FrameLog, Truth
from rlml_slam.types import Health, Level

STEP = 100_000_000  # [ns] between poses of the truth


def driven(rng, n=40):
    """A truth that begins at its origin, with two reflectors."""
    poses = np.cumsum(rng.normal(0.0, [0.2, 0.1, 0.1], (n, 3)), axis=0)
    poses[0] = 0.0
    path = Trajectory(np.arange(n, dtype=np.int64) * STEP, poses)
    return Truth(path, True, np.array([3, 4]), rng.normal(size=(2, 2)))


def log_of(stamps, poses, cov=0.0):
    log = FrameLog()
    for stamp, pose in zip(stamps, poses, strict=True):
        log.add_pose(stamp, pose, cov * np.eye(3), Health(Level.OK, ()))
    return log


@pytest.mark.parametrize('seed', range(10))
def test_map_that_begins_later_has_the_truth_of_its_first_pose(seed):
    rng = np.random.default_rng(seed)
    truth, first = driven(rng), int(rng.integers(1, 30))
    stamps, T = truth.trajectory.stamps[first:], truth.trajectory.poses[first]
    perfect = se2.between(T, truth.trajectory.poses[first:])
    found = truth.in_map_of(log_of(stamps, perfect))
    assert found.is_map
    assert_allclose(found.trajectory.poses[first:], perfect, atol=1e-12)
    assert_allclose(se2.transform(T, found.reflectors), truth.reflectors, atol=1e-12)


def test_truth_of_a_map_that_was_there_stays():
    truth = driven(np.random.default_rng(0))
    stamps, poses = truth.trajectory.stamps[5:], truth.trajectory.poses[5:]
    assert truth.in_map_of(log_of(stamps, poses)) is truth  # localized: not at the origin
    at_origin = log_of(stamps, se2.between(poses[0], poses), cov=1e-4)
    assert truth.in_map_of(at_origin) is truth  # by chance there: it has a covariance
    assert truth.in_map_of(log_of(truth.trajectory.stamps, truth.trajectory.poses)) is truth
    assert truth.in_map_of(FrameLog()) is truth


def test_truth_that_is_unknown_at_the_first_pose_is_aligned():
    truth = driven(np.random.default_rng(0))
    keep = np.r_[0:3, 15:40]  # messages were lost
    path = Trajectory(truth.trajectory.stamps[keep], truth.trajectory.poses[keep])
    cut = Truth(path, True)
    first = truth.trajectory.stamps[8:]
    assert not cut.in_map_of(log_of(first, np.zeros((len(first), 3)))).is_map


def test_truth_without_headings_is_aligned_where_the_map_begins_later():
    truth = driven(np.random.default_rng(0))
    path = Trajectory(truth.trajectory.stamps, truth.trajectory.poses * [1.0, 1.0, np.nan])
    first = path.stamps[8:]
    assert not Truth(path, True).in_map_of(log_of(first, np.zeros((len(first), 3)))).is_map


def test_truth_that_begins_after_the_map_stays():
    truth = driven(np.random.default_rng(0))
    path = Trajectory(truth.trajectory.stamps + STEP // 2, truth.trajectory.poses + 0.1)
    late = Truth(path, True)
    first = truth.trajectory.stamps
    assert late.in_map_of(log_of(first, np.zeros((len(first), 3)))) is late
