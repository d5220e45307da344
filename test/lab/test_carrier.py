# SPDX-License-Identifier: Apache-2.0
from itertools import islice, pairwise

import numpy as np
import pytest

from rlml_lab.carrier.carrier import simulate_carrier, true_features
from rlml_lab.carrier.carrier_parameters import Carrier
from rlml_slam.se2 import between, transform


def steps(count, seed=0, **settings):
    return list(islice(simulate_carrier(Carrier(**settings), seed), count))


def test_same_seed_gives_the_same_steps():
    for a, b in zip(steps(20), steps(20), strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.detections.points, b.detections.points)


@pytest.mark.parametrize('kind', ['train', 'conveyor'])
def test_detections_are_the_features_seen_from_the_true_pose(kind):
    for step in steps(100, kind=kind, sigma=1e-9):
        world = transform(step.pose, step.detections.points)
        expected = [true_features(step)[i] for i in step.seen.tolist()]
        np.testing.assert_allclose(world, np.reshape(expected, (-1, 2)), atol=1e-6)


def test_odometry_error_has_the_stated_covariance():
    run = steps(4000, odometry_sigma=(0.02, 0.03, 0.01))
    errors = np.array([
        between(b.motion.delta, between(a.pose, b.pose)) for a, b in pairwise(run)
    ])  # fmt: skip
    # 1 / sqrt(2 n) is 1.1 % of a sigma
    np.testing.assert_allclose(
        errors.std(0), np.sqrt(0.1) * np.array([0.02, 0.03, 0.01]), rtol=0.05
    )


def test_features_leave_their_nominal_motion_as_stated():
    run = steps(3000, turn_rate=0.0, drift=0.04, common_drift=0.0)
    own = np.array([
        b.points - a.points - 0.1 * b.linear for a, b in pairwise(run)
    ])  # fmt: skip
    assert own.std() == pytest.approx(0.04 * np.sqrt(0.1), rel=0.03)


def test_train_stays_in_range_and_a_conveyor_brings_new_features():
    train, conveyor = steps(3000), steps(3000, kind='conveyor')
    last = train[-1]
    assert np.linalg.norm(last.points - last.pose[:2], axis=-1).max() < 8.0
    assert train[-1].ids.tolist() == list(range(6))
    assert conveyor[-1].ids.min() > 5
    assert len(conveyor[-1].ids) == 6


def test_ghosts_and_missing_come_in_the_stated_share():
    run = steps(1000, false_detections=0.5, missed_share=0.3, ids=False)
    seen = np.concatenate([s.seen for s in run])
    assert (seen == -1).mean() * len(seen) / 1000 == pytest.approx(0.5, abs=0.07)
    assert (seen >= 0).sum() / 6000 == pytest.approx(0.7, abs=0.02)
    assert all((s.detections.ids == -1).all() for s in run)
