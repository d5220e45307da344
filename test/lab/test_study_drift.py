# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_lab.faults.study_drift import drifts, row
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.types import Frame, Health, Level, Motion, Observation

SECOND = 10**9
NONE = np.zeros(0, dtype=np.int64)


def frame(k, pose, variance, jumped=False):
    motion = Motion(np.zeros(3), np.eye(3))
    cov = np.diag([1e-4, 1e-4, variance])
    return Frame(
        k * SECOND, Observation(k * SECOND, motion), pose, cov, pose, cov, NONE, NONE,
        Health(Level.OK), jumped=jumped,
    )  # fmt: skip


def walk(share, steps=4000, sigma=0.002, jump=None):
    """Straight ahead, 1 m a frame, with a heading that walks; its sigma is a ``share`` of that."""
    rng = np.random.default_rng(2)
    off = np.cumsum(rng.normal(0.0, sigma, steps))
    true = np.stack([np.arange(steps), np.zeros(steps), np.zeros(steps)], axis=-1).astype(float)
    poses = true + np.stack([0.0 * off, 0.0 * off, off], axis=-1)
    frames = [frame(k, poses[k], k * (share * sigma) ** 2, jumped=k == jump) for k in range(steps)]
    return frames, Trajectory(np.arange(steps) * SECOND, true)


@pytest.mark.parametrize('share', [1.0, 0.2])
def test_drift_is_compared_with_what_was_said_of_it(share):
    found = drifts(*walk(share), 20.0)
    assert np.std(found.errors) == pytest.approx(0.002 * np.sqrt(20.0), rel=0.15)
    np.testing.assert_allclose(found.sigmas, share * 0.002 * np.sqrt(20.0), rtol=1e-6)
    assert float(row(found)[-1]) == pytest.approx(0.67 / share, rel=0.15)


def test_pairs_across_a_jump_are_left_out():
    whole, cut = (drifts(*walk(1.0, 400, jump=j), 20.0) for j in (None, 200))
    assert len(cut.errors) == len(whole.errors) - 2


def test_turn_of_more_than_half_a_circle_is_no_error():
    poses = [np.array([k, 0.0, se2.wrapped(0.4 * k)]) for k in range(60)]
    true = Trajectory(np.arange(60) * SECOND, np.array(poses))
    found = drifts([frame(k, p, 1e-6 * k) for k, p in enumerate(poses)], true, 10.0)
    np.testing.assert_allclose(found.errors, 0.0, atol=1e-12)
