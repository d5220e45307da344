# SPDX-License-Identifier: Apache-2.0
"""Corrections of map to odom are reported, and taken over no faster than wanted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.params import BackEnd
from rlml_slam.ros.back_end.correction_smoothing import SmoothedCorrection

STEP = 100_000_000
BASE = np.array([40.0, -25.0, 2.0])  # far from the origin, where a turn moves much
SLOW = replace(BackEnd(), correction_speed=0.2, correction_turn_rate=0.1)


def run(params, targets, bases):
    reported = []
    steady = SmoothedCorrection(params, lambda stamp, jump: reported.append((stamp, jump)))
    out = [
        steady.follow(k * STEP, t, b) for k, (t, b) in enumerate(zip(targets, bases, strict=True))
    ]
    return np.array(out), reported


def corrected(by, n=60, at=5):
    """Map to odom before and after the robot at BASE was moved by a pose (3,), its own frame."""
    before = np.array([1.0, 2.0, 0.5])
    moved = se2.compose(se2.compose(before, BASE), by)
    after = se2.compose(moved, se2.inverse(BASE))
    return np.array([before] * at + [after] * (n - at)), np.array([BASE] * n)


def test_without_a_limit_it_follows_at_once():
    targets, bases = corrected((0.3, -0.1, 0.05))
    out, reported = run(BackEnd(), targets, bases)
    np.testing.assert_allclose(out, targets, atol=1e-9)
    ((stamp, jump),) = reported
    assert stamp == 5 * STEP
    np.testing.assert_allclose(jump, [0.3, -0.1, 0.05], atol=1e-9)


def test_robot_is_moved_no_faster_than_wanted_and_arrives():
    targets, bases = corrected((0.3, -0.1, 0.05))
    out, reported = run(SLOW, targets, bases)
    shown = se2.compose(out, bases)
    steps = se2.between(shown[:-1], shown[1:])
    assert np.hypot(steps[:, 0], steps[:, 1]).max() <= 0.2 * 0.1 + 1e-9
    assert np.abs(steps[:, 2]).max() <= 0.1 * 0.1 + 1e-9
    np.testing.assert_allclose(out[-1], targets[-1], atol=1e-9)
    # 0.316 m at 0.2 m/s
    arrived = np.argmax(np.abs(out - targets[-1]).max(axis=1) < 1e-9)
    assert arrived == 5 + 15
    assert len(reported) == 1  # the jump of the estimate, not each step after it


def test_limit_holds_for_a_robot_that_drives():
    targets, _ = corrected((0.0, 0.2, 0.0))
    bases = se2.compose(BASE, np.array([[0.05 * k, 0.0, 0.02 * k] for k in range(60)]))
    out, _ = run(SLOW, targets, bases)
    # what the same motion of the odometry would have shown without the correction
    shown = se2.compose(out[1:], bases[1:])
    steps = se2.between(se2.compose(out[:-1], bases[1:]), shown)
    assert np.hypot(steps[:, 0], steps[:, 1]).max() <= 0.02 + 1e-9
    np.testing.assert_allclose(out[-1], targets[-1], atol=1e-9)


@pytest.mark.parametrize('by', [(3.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_robot_that_was_elsewhere_all_the_time_is_put_there_at_once(by):
    targets, bases = corrected(by)
    out, reported = run(SLOW, targets, bases)
    np.testing.assert_allclose(out, targets, atol=1e-9)
    assert len(reported) == 1


def test_small_corrections_are_no_jumps():
    targets, bases = corrected((0.02, 0.0, 0.005))
    assert run(SLOW, targets, bases)[1] == []


def test_clock_that_jumps_back_waits_for_nothing():
    steady = SmoothedCorrection(SLOW, lambda *_: None)
    targets, bases = corrected((0.3, 0.0, 0.0), at=1)
    steady.follow(100 * STEP, targets[0], bases[0])
    np.testing.assert_allclose(steady.follow(0, targets[1], bases[1]), targets[1], atol=1e-9)
