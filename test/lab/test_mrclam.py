# SPDX-License-Identifier: Apache-2.0
"""MR.CLAM folders: velocities become poses, barcodes become landmarks."""

from __future__ import annotations

import lzma
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rlml_lab.datasets.mrclam import HALF_VIEW, chain, read_mrclam
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError
from rlml_slam.evaluation.ate import interpolate, trajectory_errors
from rlml_slam.types import ANONYMOUS

SHARED = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'mrclam' / 'dataset6'
BARCODES = '# subject barcode\n1 5\n2 14\n6 63\n7 81\n'
LANDMARKS = '6 1.0 2.0 0.001 0.001\n7 -1.0 0.5 0.001 0.001\n'
# a quarter circle of radius 1 in a second, then straight on, then standing
ODOMETRY = f'10.0 {np.pi / 2} {np.pi / 2}\n10.5 {np.pi / 2} {np.pi / 2}\n11.0 1.0 0.0\n12.0 0 0\n'
MEASUREMENTS = """# time barcode range bearing
10.2 63 2.0 0.5
10.2 81 1.0 -0.5
10.4 5 1.0 0.0
10.6 77 1.0 0.0
10.8 63 3.0 0.0
"""
TRUTH = '9.5 0 0 0\n10.0 1 1 3.0\n10.0 1 1 3.0\n10.5 1.5 1 -3.0\n'


@pytest.fixture
def folder(tmp_path):
    (tmp_path / 'Barcodes.dat').write_text(BARCODES)
    (tmp_path / 'Landmark_Groundtruth.dat').write_text(LANDMARKS)
    (tmp_path / 'Robot3_Odometry.dat').write_text(ODOMETRY)
    (tmp_path / 'Robot3_Measurement.dat').write_text(MEASUREMENTS)
    (tmp_path / 'Robot3_Groundtruth.dat.xz').write_bytes(lzma.compress(TRUTH.encode()))
    return tmp_path


def test_velocities_become_poses(folder):
    odometry = read_mrclam(folder, 3).odometry
    assert [o.stamp for o in odometry] == [10 * 10**9, 10_500_000_000, 11 * 10**9, 12 * 10**9]
    assert_allclose(odometry[0].pose, 0.0)
    assert_allclose(odometry[2].pose, [1.0, 1.0, np.pi / 2], atol=1e-12)
    assert_allclose(odometry[3].pose, [1.0, 2.0, np.pi / 2], atol=1e-12)


def test_rows_of_one_stamp_are_one_message(folder):
    data = read_mrclam(folder, 3)
    first, second = data.detections
    assert first.stamp == 10_200_000_000
    assert_array_equal(first.ids, [6, 7])
    assert_array_equal(second.ids, [6])
    assert_allclose(first.points[0], [2 * np.cos(0.5), 2 * np.sin(0.5)])
    assert first.frame_id == 'base_link'
    # straight ahead, the covariance is diagonal: along is x
    assert_allclose(second.cov[0], np.diag([(0.045 * 3) ** 2 + 0.04**2, (3 * 0.01) ** 2]))


def test_logged_ranges_are_depths_that_are_right_in_the_mean_over_the_picture(folder):
    (at_rim, _), (ahead,) = (d.points for d in read_mrclam(folder, 3, depths=True).detections)
    # logged as 3 m straight ahead and as 2 m half a radian aside: depths along x
    assert at_rim[0] / ahead[0] == pytest.approx(2.0 / 3.0)
    bearings = np.linspace(-HALF_VIEW, HALF_VIEW, 1001)
    depth_of_one_metre = np.cos(bearings) * 3.0 / ahead[0]
    # the rule of rectangles, 1001 of them
    assert depth_of_one_metre.mean() == pytest.approx(1.0, abs=1e-3)


def test_robots_and_misreads_are_counted(folder):
    assert dict(read_mrclam(folder, 3).counts) == {'used': 3, 'of_robots': 1, 'misread': 1}


def test_without_ids_all_are_anonymous(folder):
    for d in read_mrclam(folder, 3, ids=False).detections:
        assert (d.ids == ANONYMOUS).all()


def test_truth_and_landmarks(folder):
    data = read_mrclam(folder, 3)
    # a repeated stamp is taken once
    assert len(data.truth) == 3
    assert_array_equal(data.landmark_ids, [6, 7])
    assert_allclose(data.landmark_points, [[1.0, 2.0], [-1.0, 0.5]])


def test_data_set_without_truth_is_read(folder):
    (folder / 'Robot3_Groundtruth.dat.xz').unlink()
    assert read_mrclam(folder, 3).truth is None


def test_missing_file_is_named(folder):
    with pytest.raises(FileFormatError, match=r'has no Robot4_Odometry\.dat'):
        read_mrclam(folder, 4)


@pytest.mark.parametrize(
    ('name', 'line', 'why'),
    [
        ('Robot3_Odometry.dat', '13.0 1.0', '2 values, 3 expected'),
        ('Robot3_Measurement.dat', '13.0 63 x 0', 'could not convert'),
        ('Robot3_Measurement.dat', 'x 63 1 0', "'x' is not a time"),
    ],
)
def test_bad_line_is_named(folder, name, line, why):
    path = folder / name
    path.write_text(line + '\n' + path.read_text())
    with pytest.raises(FileFormatError, match=rf'{name}:1: {why}'):
        read_mrclam(folder, 3)


def test_chain_is_repeated_composition():
    steps = np.random.default_rng(3).normal(size=(50, 3))
    T = np.zeros(3)
    poses = [T]
    for step in steps:
        T = se2.compose(T, step)
        poses.append(T)
    # 50 compositions
    assert_allclose(se2.between(np.array(poses), chain(steps)), 0.0, atol=1e-12)


@pytest.mark.skipif(not SHARED.exists(), reason=f'the data set is not at {SHARED}')
def test_dataset_6_agrees_with_its_truth():
    data = read_mrclam(SHARED, 4, depths=True)
    stamps = np.array([o.stamp for o in data.odometry])[::50]
    dead = Trajectory(stamps, np.array([o.pose for o in data.odometry])[::50])
    # dead reckoning of this robot drifts by 1.3 m in 888 s
    assert trajectory_errors(dead, data.truth, aligned=True).summary()['rmse_m'] == pytest.approx(
        1.3, abs=0.1
    )
    errors, shares, bearings = [], [], []
    for d in data.detections:
        (pose,), (known,) = interpolate(data.truth, np.array([d.stamp]))
        if known:
            true = [data.landmark_points[data.landmark_ids == i][0] for i in d.ids]
            true = se2.transform(se2.inverse(pose), np.array(true))
            errors.extend(true - d.points)
            shares.extend(np.hypot(*d.points.T) / np.hypot(*true.T))
            bearings.extend(np.abs(np.arctan2(d.points[:, 1], d.points[:, 0])))
    # frames, signs and barcodes are right: without that it would be metres
    assert np.median(np.abs(errors), axis=0).max() < 0.12
    # of ranges as logged they are 6.5 % apart; beside the bearing only its own offset is left
    middle, rim = (
        np.median(np.array(shares)[b]) for b in (np.less(bearings, 0.2), np.greater(bearings, 0.3))
    )
    assert abs(rim - middle) < 0.03
