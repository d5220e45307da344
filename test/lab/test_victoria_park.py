# SPDX-License-Identifier: Apache-2.0
"""Victoria Park's MATLAB files: steering becomes poses, trunks become detections."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_allclose, assert_array_equal

from rlml_lab.datasets.victoria_park import HALF_TRACK, WHEEL_BASE, read_victoria_park
from rlml_lab.main import main
from rlml_slam.errors import FileFormatError

SHARED = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'victoria-park'


@pytest.fixture
def folder(tmp_path):
    # a turn to the left at 2 m/s of the rear axle, 10 s
    alpha = 0.2
    n = 401
    v_left = 2.0 * (1.0 - np.tan(alpha) * HALF_TRACK / WHEEL_BASE)
    drive = {
        'time': np.arange(1000, 1000 + 25 * n, 25, dtype=np.int32),
        'speed': np.full(n, v_left),
        'steering': np.full(n, alpha),
    }
    scipy.io.savemat(tmp_path / 'aa3_dr.mat', {k: v[:, None] for k, v in drive.items()})
    gps = {
        'timeGps': np.array([1000, 1200, 1200, 1400]),
        'Lo_m': np.array([1.0, 2.0, 2.0, np.nan]),
        'La_m': np.array([3.0, 4.0, 4.0, 5.0]),
    }
    scipy.io.savemat(tmp_path / 'aa3_gpsx.mat', {k: v[:, None] for k, v in gps.items()})
    cells = np.empty((1, 3), dtype=object)
    cells[0, 0] = np.array([[10.0, 5.0], [np.pi / 2, np.pi], [0.4, 0.0]])
    cells[0, 1] = np.zeros((3, 0))
    cells[0, 2] = np.array([[np.nan, -1.0], [1.0, 1.0], [0.1, 0.1]])
    trees = {'TLsr': np.array([[1.013, 1.226, 1.44]]), 'zt': cells}
    scipy.io.savemat(tmp_path / 'VictoriaParkSinSincronizar.mat', trees)
    return tmp_path


def test_steering_becomes_a_circle_of_the_rear_axle(folder):
    odometry = read_victoria_park(folder).odometry
    radius = WHEEL_BASE / np.tan(0.2)
    phi = 20.0 / radius
    assert odometry[-1].stamp - odometry[0].stamp == 10 * 10**9
    assert_allclose(
        odometry[-1].pose, [radius * np.sin(phi), radius * (1 - np.cos(phi)), phi], atol=1e-9
    )


def test_trunks_are_in_the_laser_frame(folder):
    first, empty, invalid = read_victoria_park(folder).detections
    # pi/2 is straight ahead, pi is to the left
    assert_allclose(first.points, [[10.0, 0.0], [0.0, 5.0]], atol=1e-12)
    assert_allclose(first.diameters, [0.4, np.nan])
    assert first.frame_id == 'laser'
    assert first.stamp == 1_013_000_000
    assert len(empty) == 0
    assert len(invalid) == 0


def test_counts_and_gps(folder):
    data = read_victoria_park(folder)
    assert dict(data.counts) == {'scans': 3, 'invalid': 2, 'trees': 2}
    # a repeated stamp and a gap are left out; GPS has no heading
    assert_array_equal(data.gps.stamps, [1_000_000_000, 1_200_000_000])
    assert_allclose(data.gps.poses, [[1.0, 3.0, np.nan], [2.0, 4.0, np.nan]])


def test_missing_file_is_named(folder):
    (folder / 'aa3_gpsx.mat').unlink()
    with pytest.raises(FileFormatError, match=r'aa3_gpsx\.mat: cannot be read'):
        read_victoria_park(folder)


def test_missing_variable_is_named(folder):
    scipy.io.savemat(folder / 'aa3_dr.mat', {'time': np.zeros(3)})
    with pytest.raises(FileFormatError, match=r'aa3_dr\.mat: has no variable speed, steering'):
        read_victoria_park(folder)


def test_file_that_is_not_matlab_is_named(folder):
    (folder / 'aa3_dr.mat').write_bytes(b'no matlab file at all' * 20)
    with pytest.raises(FileFormatError, match=r'aa3_dr\.mat: not a MATLAB file'):
        read_victoria_park(folder)


@pytest.mark.skipif(not SHARED.exists(), reason=f'the data set is not at {SHARED}')
def test_the_whole_drive():
    data = read_victoria_park(SHARED)
    assert len(data.odometry) == 61945
    assert len(data.detections) == 7249
    steps = np.diff([o.pose for o in data.odometry[::40]], axis=0)
    # about 4 km
    assert np.hypot(steps[:, 0], steps[:, 1]).sum() == pytest.approx(4000.0, rel=0.15)


@pytest.mark.skipif(not SHARED.is_dir(), reason='the data set is not here')
def test_filter_follows_gps_where_dead_reckoning_does_not(tmp_path, capsys):
    out = tmp_path / 'park.png'
    arguments = ['study', 'victoria-park', str(SHARED), '--system', 'dead_reckoning', 'ekf',
                 '--duration', '200', '--out', str(out), '--json']  # fmt: skip
    assert main(arguments) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['ekf']['rmse_m'] < min(5.0, figures['dead_reckoning']['rmse_m'])
    assert figures['ekf']['compared'] > 300
    assert 20 < figures['ekf']['trees'] < 200
    assert out.read_bytes().startswith(b'\x89PNG')
