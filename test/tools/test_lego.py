# SPDX-License-Identifier: Apache-2.0
"""The LEGO robot: its files, the camera's view of it, and spikes with the EKF on the real log."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.errors import FileFormatError
from rlml_slam.tools.convert_lego import (
    BEAM,
    METRES_PER_TICK,
    MIDDLE,
    MOUNTING,
    T_BASE_LASER,
    WHEEL_BASE,
    read_lego,
)
from rlml_slam.tools.lego_scale import Ranges, fit_scale
from rlml_slam.tools.main import main
from rlml_slam.tools.study_lego import camera_view

SHARED = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'lego-cylinders'
real_data = pytest.mark.skipif(not SHARED.is_dir(), reason='the data set is not here')


@pytest.fixture
def folder(tmp_path):
    # the left wheel stands and the right one goes a quarter circle of radius WHEEL_BASE
    quarter = 0.5 * np.pi * WHEEL_BASE / METRES_PER_TICK
    motors = '\n'.join(f'M {t} 500 0 0 0 {700 + k * quarter / 4:.6f} 0' for k, t in
                       enumerate(range(10, 1010, 200)))  # fmt: skip
    ranges = ' '.join(['1500'] * MIDDLE + ['0'] + ['2500'] * (659 - MIDDLE))
    scans = '\n'.join(f'S {t} 660 {ranges}' for t in range(0, 1000, 200))
    track = '\n'.join(f'P {t} 1000 2000' for t in range(30, 1030, 200))
    (tmp_path / 'robot4_motors.txt').write_text(motors + '\n')
    (tmp_path / 'robot4_scan.txt').write_text(scans + '\n')
    (tmp_path / 'robot4_reference.txt').write_text(track + '\n')
    (tmp_path / 'robot_arena_landmarks.txt').write_text('L C 1291.0\t1881.0\t55.0\n')
    return tmp_path


def test_ticks_become_the_arc_of_the_middle_between_the_wheels(folder):
    end = read_lego(folder).odometry[-1].pose
    r = 0.5 * WHEEL_BASE
    assert_allclose(end, [r, r, 0.5 * np.pi], atol=1e-8)


def test_beams_lie_where_the_course_says(folder):
    scan = read_lego(folder).scans[0]
    assert np.isnan(scan.ranges[MIDDLE])  # 0 is no return
    assert_allclose([scan.ranges[0], scan.ranges[-1]], [1.5, 2.5])
    k = 100
    angle = scan.angle_min + k * scan.angle_increment + T_BASE_LASER[2]
    assert angle == pytest.approx((k - MIDDLE) * BEAM - MOUNTING, abs=1e-12)


def test_rows_belong_together(folder):
    data = read_lego(folder)
    stamps = [s.stamp for s in data.scans]
    assert [o.stamp for o in data.odometry] == stamps == data.track.stamps.tolist()
    assert_allclose(data.track.poses[:, :2], np.tile([1.0, 2.0], (5, 1)))
    assert_allclose(data.landmarks, [[1.291, 1.881]])


def test_files_of_different_length_are_refused(folder):
    path = folder / 'robot4_reference.txt'
    path.write_text(''.join(path.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(FileFormatError, match='differ in number of rows'):
        read_lego(folder)


def test_camera_view_finds_scale_and_point():
    rng = np.random.default_rng(3)
    scanner = np.column_stack([rng.normal(size=(40, 2)), rng.uniform(-3, 3, 40)])
    point = np.array([0.05, -0.02])
    seen = se2.transform(scanner, np.tile(point, (40, 1))[:, None])[:, 0]
    track = 1.2 * se2.transform(np.array([3.0, -1.0, 2.0]), seen)
    view = camera_view(scanner, track)
    assert view.scale == pytest.approx(1.2, abs=1e-12)
    assert_allclose(view.point, point, atol=1e-12)
    assert_allclose(view.seen, track, atol=1e-12)


@pytest.mark.parametrize('scale', [0.9, 1.0])
def test_ranges_alone_tell_how_large_the_track_is(scale):
    rng = np.random.default_rng(2)
    landmarks, true = rng.uniform(-1.0, 1.0, (6, 2)), rng.uniform(-1.0, 1.0, (80, 2))
    T = np.array([0.2, -0.1, 0.3])
    track = (se2.transform(T, true) - true.mean(axis=0)) / scale
    k, j = np.divmod(np.arange(80 * 6), 6)
    d = np.hypot(*(landmarks[j] - true[k]).T)
    ranges = Ranges(d - 0.09 + 0.01 * rng.standard_normal(len(d)), j, k)
    free = fit_scale(track, landmarks, ranges)
    assert free.scale == pytest.approx(scale, abs=4.0 * free.sigma)
    assert free.sigma < 0.005
    assert free.offset == pytest.approx(0.09, abs=0.005)
    assert_allclose(free.places, true, atol=0.01)
    # 1 cm of noise; a track of the wrong size cannot be fitted as well
    rigid = fit_scale(track, landmarks, ranges, rigid=True)
    assert free.rms == pytest.approx(0.01, rel=0.15)
    assert rigid.rms > 2.0 * free.rms if scale != 1.0 else rigid.rms < 1.01 * free.rms


def test_ranges_and_headings_tell_which_point_the_camera_follows():
    rng = np.random.default_rng(4)
    landmarks, true = rng.uniform(-1.0, 1.0, (6, 2)), rng.uniform(-1.0, 1.0, (80, 2))
    headings, point = rng.uniform(-3.0, 3.0, 80), np.array([0.04, -0.01])
    followed = true + se2.rotation(headings) @ point
    track = followed.mean(axis=0) + 1.1 * (followed - followed.mean(axis=0))
    k, j = np.divmod(np.arange(80 * 6), 6)
    d = np.hypot(*(landmarks[j] - true[k]).T)
    ranges = Ranges(d - 0.09 + 0.01 * rng.standard_normal(len(d)), j, k)
    fit = fit_scale(track, landmarks, ranges, headings=headings)
    assert_allclose(fit.point, point, atol=4.0 * fit.point_sigma.max())
    assert fit.point_sigma.max() < 0.005
    assert_allclose(fit.places, true, atol=0.01)


@real_data
def test_all_cylinders_and_no_other_are_found(tmp_path, capsys):
    out = tmp_path / 'lego.png'
    assert main(['study', 'lego', str(SHARED), '--out', str(out), '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['cylinders_found'] == figures['cylinders'] == 6
    assert figures['landmarks_false'] == 0
    assert figures['landmark_rmse_m'] <= 0.02
    assert figures['position_rmse_track_corrected_m'] <= 0.03
    # 6.7 cm with the track as it is: its metre is larger than that of laser, wheels and map (docs)
    assert figures['track_scale_by_ranges'] - 1.0 > 20.0 * figures['track_scale_sigma']
    assert figures['position_rmse_by_ranges_m'] > 0.05
    assert figures['position_rmse_as_camera_m'] <= 0.03
    assert abs(figures['arena_scale'] - 1.0) < 0.01
    assert figures['camera_scale'] > 1.07
    assert out.read_bytes().startswith(b'\x89PNG')


@real_data
def test_the_text_says_what_is_met_and_what_is_not(capsys):
    assert main(['study', 'lego', str(SHARED)]) == 0
    text = capsys.readouterr().out
    assert re.search(r'the track as it is +6\.6\d cm, not met', text)
    assert re.search(r'the track 1\.1\d\d times smaller +3\.0\d cm, not met', text)
    assert re.search(r'of a point 2\.\d cm ahead +2\.\d\d cm, met', text)
