# SPDX-License-Identifier: Apache-2.0
import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlml_lab.faults import fault_catalog as faults
from rlml_lab.faults import study_faults, study_stalls
from rlml_lab.faults.fault_run import (
    FaultFigures,
    is_wrong,
    longest,
    restamped,
    stamps_as_recorded,
)
from rlml_lab.faults.other_drives import DRIVES
from rlml_lab.faults.recording import Recording
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.relations import Relations
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import Parameters
from rlml_slam.types import Detections, Imu, Odometry, Scan

SECOND = 10**9


def drive(duration=130.0):
    """Odometry and scans at 5 Hz along an arc."""
    out = []
    for k in range(round(5 * duration)):
        stamp = SECOND + k * SECOND // 5
        out.append(Odometry(stamp, se2.exp(np.array([0.1, 0.0, 0.05]) * k)))
        ranges = np.full(90, 5.0 + 0.01 * k, dtype=np.float32)
        out.append(Scan(stamp, 'laser', -1.5, 0.034, 0.0, 0.1, 30.0, ranges, np.zeros(0)))
    return out


def odometry(messages):
    return np.array([m.pose for m in messages if isinstance(m, Odometry)])


def applied(fault, messages, seed=3):
    return fault(messages, np.random.default_rng(seed))


def other(drive, messages):
    """The drive as another one, with relations and a truth."""
    relations = Relations(np.array([[2 * SECOND, 5 * SECOND]]), np.array([[1.0, 0.5, 0.2]]))
    truth = Trajectory(np.array([2, 5]) * SECOND, np.array([[0.0, 1.0, 0.1], [1.0, 2.0, 0.3]]))
    given = Recording('arc', messages, {'laser': np.array([0.2, 0.1, 0.3])}, relations, truth)
    return DRIVES[drive](given)


def test_mirrored_drive_has_its_left_at_the_right():
    ranges = np.arange(1.0, 4.0, dtype=np.float32)
    scan = Scan(5, 'laser', -0.5, 0.1, 0.0, 0.1, 30.0, ranges, ranges)
    seen = Detections(
        6, 'laser', np.array([[3.0, 1.0]]), np.array([[[2.0, 1.0], [1.0, 3.0]]]),
        np.array([7]), np.array([0.1]),
    )  # fmt: skip
    messages = [Odometry(4, np.array([1.0, 2.0, 0.5])), Imu(4, 0.3), scan, seen]
    out = other('mirrored', messages)
    assert out.messages[0].pose.tolist() == [1.0, -2.0, -0.5]
    assert out.messages[1].yaw_rate == -0.3
    assert out.messages[2].ranges.tolist() == [3.0, 2.0, 1.0]
    assert out.messages[2].angle_min == pytest.approx(0.3)  # the beam that was the last one
    assert out.messages[3].points.tolist() == [[3.0, -1.0]]
    assert out.messages[3].cov.tolist() == [[[2.0, -1.0], [-1.0, 3.0]]]
    assert out.sensors['laser'].tolist() == [0.2, -0.1, -0.3]
    assert out.relations.deltas.tolist() == [[1.0, -0.5, -0.2]]
    assert out.truth.poses[1].tolist() == [1.0, -2.0, -0.3]


def test_drive_backwards_keeps_the_distances_in_time_and_twice_gives_the_drive():
    before = drive(5.0)
    out = other('backwards', before)
    stamps = [m.stamp for m in out.messages]
    assert stamps == sorted(stamps)
    first, last = out.messages[-1], before[0]  # a scan has the same stamp as its odometry
    assert odometry(out.messages)[-1].tolist() == last.pose.tolist()
    assert first.stamp == out.end
    assert out.relations.stamps[0, 0] - out.relations.stamps[0, 1] == 3 * SECOND
    assert (np.diff(out.truth.stamps) == 3 * SECOND).all()
    again = DRIVES['backwards'](out)
    assert sorted(m.stamp for m in again.messages) == sorted(m.stamp for m in before)
    np.testing.assert_array_equal(again.truth.poses, other('recorded', before).truth.poses)


def test_noise_of_ranges_is_white():
    before = [m.ranges for m in drive(20.0) if isinstance(m, Scan)]
    after = [m.ranges for m in applied(faults.noise(0.01), drive(20.0)) if isinstance(m, Scan)]
    error = np.array(after) - np.array(before)
    assert error.std() == pytest.approx(0.01, rel=0.05)
    assert abs(error.mean()) < 0.001


def test_same_seed_gives_the_same_fault():
    a, b = (applied(faults.cut(3.0), drive()) for _ in range(2))
    assert [m.stamp for m in a] == [m.stamp for m in b]


def test_cut_takes_all_messages_of_its_windows_and_keeps_the_rest():
    before = drive()
    after = applied(faults.cut(3.0), before)
    stamps = np.unique([m.stamp for m in after])
    gaps = np.diff(stamps)
    assert int((gaps > SECOND).sum()) == 2
    assert gaps.max() == pytest.approx(3.2 * SECOND, abs=0.2 * SECOND)
    assert all(any(m is n for n in before) for m in after[:10])


def test_stall_repeats_a_pose_and_catches_up():
    before, after = (odometry(m) for m in (drive(), applied(faults.stall(2.0, True), drive())))
    still = (np.diff(after, axis=0) == 0.0).all(axis=1)
    assert still.sum() == pytest.approx(20, abs=2)
    np.testing.assert_allclose(after[-1], before[-1], atol=1e-9)


def test_stall_that_does_not_catch_up_loses_its_motion_and_no_more():
    before, after = (odometry(m) for m in (drive(), applied(faults.stall(2.0, False), drive())))
    steps = se2.between(before[:-1], before[1:])
    after_steps = se2.between(after[:-1], after[1:])
    moved = np.abs(after_steps).sum(axis=1) > 1e-9
    assert (~moved).sum() == pytest.approx(20, abs=2)
    np.testing.assert_allclose(after_steps[moved], steps[moved], atol=1e-9)


def test_reset_odometry_begins_at_zero():
    after = odometry(applied(faults.reset, drive()))
    assert (np.abs(after[1:]).sum(axis=1) == 0.0).sum() == 2


def test_scans_are_decimated_frozen_dirty_and_blocked():
    def scans(fault):
        return [m for m in applied(fault, drive(80.0)) if isinstance(m, Scan)]

    assert len(scans(faults.decimate(1.0))) == 80
    frozen = [s.ranges[0] for s in scans(faults.frozen(3.0))]
    assert (np.diff(frozen) == 0.0).sum() == pytest.approx(15, abs=1)
    dirty = {tuple(np.isnan(s.ranges).tolist()) for s in scans(faults.dirt(0.3))}
    assert len(dirty) == 1
    assert 0.1 < np.mean(next(iter(dirty))) < 0.5
    near = scans(faults.blocked(0.4, 0.4))[0].ranges
    assert (near == np.float32(0.4)).sum() == pytest.approx(0.4 / 0.034, abs=2)
    assert min(s.ranges.min() for s in scans(faults.people(3))) < 2.3


def test_beams_of_another_laser_are_those_that_were_measured_there():
    ranges = np.arange(1.0, 12.0, dtype=np.float32)
    scan = Scan(SECOND, 'laser', -1.0, 0.2, 0.01, 0.1, 30.0, ranges, 10.0 * ranges)
    for turns in (0.0, 2.0 * np.pi):
        (narrow,) = applied(faults.view(0.85), [replace(scan, angle_min=turns - 1.0)])
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(narrow.ranges)), range(3, 8))
    (coarse,) = applied(faults.every(4), [scan])
    np.testing.assert_array_equal(coarse.ranges, [1.0, 5.0, 9.0])
    assert (coarse.angle_min, coarse.angle_increment) == (-1.0, 0.8)
    assert (coarse.stamp, coarse.time_increment) == (SECOND, 0.04)
    (short,) = applied(faults.reach(4.0), [scan])
    assert np.isfinite(short.ranges).sum() == 4
    np.testing.assert_array_equal(coarse.intensities, 10.0 * coarse.ranges)


def test_reflectors_are_missed_invented_and_confused():
    n = 6
    seen = [
        Detections(
            SECOND * k, 'laser', np.ones((n, 2)), np.tile(np.eye(2), (n, 1, 1)),
            np.arange(n), np.full(n, np.nan),
        )
        for k in range(1, 200)
    ]  # fmt: skip
    kept = np.mean([len(d) for d in applied(faults.misses(0.5), seen)])
    assert kept == pytest.approx(3.0, abs=0.3)
    assert np.mean([len(d) for d in applied(faults.ghosts(3.0), seen)]) == pytest.approx(9.0, 0.1)
    changed = np.mean([d.ids != np.arange(n) for d in applied(faults.wrong_ids(0.5), seen)])
    assert changed == pytest.approx(0.5 * (1.0 - 1.0 / n), abs=0.05)


def test_pose_is_wrong_beyond_its_own_covariance_only():
    truth = Trajectory(np.arange(4) * SECOND, np.zeros((4, 3)))
    log = FrameLog()
    for k, (x, turn, sigma) in enumerate(
        [(0.6, 0, 0.01), (0.6, 0, 0.1), (0, 0.3, 0.01), (0, 0, 1)]
    ):
        log.add_pose(k * SECOND, np.array([x, 0.0, turn]), sigma**2 * np.eye(3))
    wrong = is_wrong(log, truth)
    assert wrong.tolist() == [True, False, True, False]
    assert longest(np.array(log.stamps), np.array([True, True, False, True])) == 1.0


def test_pose_is_compared_with_the_truth_of_the_moment_its_scan_was_taken():
    recorded = [m for m in drive(10.0) if isinstance(m, Scan)]
    moved = applied(faults.jitter(0.02), recorded)
    taken = stamps_as_recorded(moved, recorded)
    assert [taken[m.stamp] for m in moved] == [m.stamp for m in recorded]
    poses = np.column_stack([np.arange(50.0), np.zeros((50, 2))])
    path = restamped(Trajectory(np.array([m.stamp for m in moved]), poses), taken)
    assert path.stamps.tolist() == [m.stamp for m in recorded]
    log = FrameLog()
    for m, pose in zip(moved, poses, strict=True):
        log.add_pose(m.stamp, pose, 1e-6 * np.eye(3))
    truth = Trajectory(np.array([m.stamp for m in recorded]), 40.0 * poses)
    assert is_wrong(log, truth, taken).tolist() == [False] + 49 * [True]
    assert not is_wrong(log, Trajectory(truth.stamps, poses), taken).any()
    assert stamps_as_recorded(recorded[1:], recorded) == {}


def test_stalls_in_a_fast_turn_among_furniture_cost_nothing():
    """Counted twice, the step after this stall once turned the map by 67 degrees."""
    world = str(Path(study_stalls.__file__).with_name('cluttered.yaml'))
    given = study_stalls.Drive(0.97, 1.11, 1.05, catches_up=True)
    figures = study_stalls.evaluate(world, 6, Parameters(), given)
    assert max(figures['headings']) < 2.0
    assert figures['ok_and_wrong'] == 0.0
    assert figures['mean_m'] < 1.5 * figures['clean_m']


def test_each_row_is_printed_when_its_run_ends(monkeypatch, capsys):
    printed_before = []

    def one_run(given, fault, seed, params, reference):
        printed_before.append(capsys.readouterr().out.splitlines())
        return FaultFigures(0.02 * (1 + seed), 0.01, 0.5, 0.0, 0.1, 0.0, 0.0, 3.0, 60.0), 'path', 0

    monkeypatch.setattr(study_faults, 'run_fault', one_run)
    monkeypatch.setattr(study_faults.recording, 'load', lambda *given: None)
    args = argparse.Namespace(
        recording='',
        reference=None,
        fault=['cut 3 s'],
        drive='recorded',
        seeds=2,
        config=None,
        json=False,
    )
    assert study_faults.run(args) == 0
    first, second, third = printed_before
    assert first[0].split()[0] == 'fault'
    assert second[0].split()[:2] == ['none', '0']
    assert third[0].split()[:4] == ['cut', '3', 's', '0']
    last = capsys.readouterr().out.splitlines()[0]
    assert last.split()[:9] == ['cut', '3', 's', '1', '0.0400', '±', '0.0100', '2.00', '0.50']
