# SPDX-License-Identifier: Apache-2.0
"""The LEGO robot: its files, the camera's view of it, and spikes with the EKF on the real log."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_lab.datasets.lego import (
    BEAM,
    BEAM_TIME,
    CAMERA_LAG,
    METRES_PER_TICK,
    MIDDLE,
    MOUNTING,
    SCAN_LAG,
    T_BASE_LASER,
    WHEEL_BASE,
    Lego,
    read_lego,
)
from rlml_lab.lego.lego_scale import Ranges, fit_scale
from rlml_lab.lego.lego_time import camera_lag, scan_lag
from rlml_lab.lego.study_lego import camera_view
from rlml_lab.main import main
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import FileFormatError
from rlml_slam.types import Odometry

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


def test_all_streams_are_in_the_clock_of_the_first_beams(folder):
    data = read_lego(folder)
    middle = round((SCAN_LAG + MIDDLE * BEAM_TIME) * 1e9)
    # what was scanned before the wheels were asked is left out
    assert [s.stamp for s in data.scans] == [
        t * 1_000_000 for t in range(0, 1000, 200) if t * 1_000_000 > middle
    ]
    assert [o.stamp - middle for o in data.odometry] == [
        t * 1_000_000 for t in range(10, 1010, 200)
    ]
    lag = round(CAMERA_LAG * 1e9)
    assert_allclose(data.track.stamps - middle + lag, np.arange(30, 1030, 200) * 1e6, atol=1)
    assert_allclose(data.track.poses[:, :2], np.tile([1.0, 2.0], (5, 1)))
    assert_allclose(data.landmarks, [[1.291, 1.881]])


def test_a_row_that_is_there_twice_counts_once(folder):
    path = folder / 'robot4_motors.txt'
    rows = path.read_text().splitlines(keepends=True)
    whole = read_lego(folder).odometry
    path.write_text(''.join([*rows[:3], rows[2], *rows[3:]]))
    again = read_lego(folder).odometry
    assert [o.stamp for o in again] == [o.stamp for o in whole]
    assert_allclose([o.pose for o in again], [o.pose for o in whole])


def test_a_file_without_its_rows_is_refused(folder):
    (folder / 'robot4_reference.txt').write_text('X 1 2 3\n')
    with pytest.raises(FileFormatError, match='no P lines'):
        read_lego(folder)


def driven(scans_late=0.0, camera_late=0.0):
    """A robot on a winding way among cylinders, of which all streams but the wheels' are late."""
    t = np.arange(0.0, 40.0, 0.2)
    heading = 1.5 * np.sin(0.5 * t) + 0.1 * t
    speed = 0.2 + 0.1 * np.sin(0.9 * t)
    xy = np.cumsum(0.2 * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1), axis=0)
    base = np.column_stack([xy, heading])
    landmarks = np.array([[1.0, 0.5], [2.0, -1.0], [3.0, 1.0], [0.0, -1.0]])

    def base_at(times):
        return np.stack([np.interp(times, t, base[:, i]) for i in range(3)], -1)

    log = np.arange(2.0, 38.0, 0.23)
    laser = se2.compose(base_at(log - scans_late), T_BASE_LASER)
    p = np.einsum('nji,nmj->nmi', se2.rotation(laser[:, 2]), landmarks - laser[:, None, :2])
    k, j = np.divmod(np.arange(len(log) * 4), 4)
    d = np.hypot(*p[k, j].T)
    ranges = Ranges(d - 0.1, np.arctan2(*p[k, j].T[::-1]), j, k, log[k])
    followed = se2.compose(base_at(log - camera_late), np.append(T_BASE_LASER[:2], 0.0))
    odometry = [
        Odometry(round(s * 1e9), q)
        for s, q in zip(t, np.column_stack([base[:, :2], se2.wrap(heading)]), strict=True)
    ]
    track = Trajectory((log * 1e9).astype(np.int64), 1.1 * followed)
    scans = [None] * len(log)
    return Lego(odometry, scans, track, landmarks), ranges


@pytest.mark.parametrize('late', [0.0, 0.3])
def test_turns_tell_how_late_scans_are(late):
    data, ranges = driven(scans_late=late)
    found = scan_lag(data, ranges, offset=0.1)
    assert found.seconds == pytest.approx(late, abs=0.02)
    assert found.factor == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize('late', [0.0, 0.3])
def test_ways_tell_how_late_and_how_large_the_camera_s_track_is(late):
    found = camera_lag(driven(camera_late=late)[0])
    assert found.seconds == pytest.approx(late, abs=0.02)
    assert found.factor == pytest.approx(1.1, abs=0.01)


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
    above = np.array([0.3, 0.1])  # where the camera hangs
    t = np.arange(80)
    track = Trajectory(
        t * 1_000_000_000, np.column_stack([above + (true - above) / scale, np.full(80, np.nan)])
    )
    k, j = np.divmod(np.arange(80 * 6), 6)
    d = np.hypot(*(landmarks[j] - true[k]).T)
    measured = d - 0.09 + 0.01 * rng.standard_normal(len(d))
    ranges = Ranges(measured, np.zeros(len(d)), j, k, t[k].astype(float))
    free = fit_scale(track, landmarks, ranges)
    assert free.scale == pytest.approx(scale, abs=4.0 * free.sigma)
    assert free.sigma < 0.005
    assert free.offset == pytest.approx(0.09, abs=0.005)
    if scale != 1.0:
        assert_allclose(free.centre, above, atol=0.03)
    # 1 cm of noise; a track of the wrong size cannot be fitted as well
    rigid = fit_scale(track, landmarks, ranges, rigid=True)
    assert free.rms == pytest.approx(0.01, rel=0.15)
    assert rigid.rms > 2.0 * free.rms if scale != 1.0 else rigid.rms < 1.01 * free.rms


@real_data
def test_all_cylinders_and_no_other_are_found(tmp_path, capsys):
    out = tmp_path / 'lego.png'
    assert main(['study', 'lego', str(SHARED), '--out', str(out), '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['cylinders_found'] == figures['cylinders'] == 6
    assert figures['landmarks_false'] == 0
    assert figures['landmark_rmse_m'] <= 0.02
    assert figures['position_rmse_track_scaled_m'] <= 0.02
    # 6.2 cm with the track as it is: its metre is larger than that of laser, wheels and map (docs)
    assert figures['track_scale_by_ranges'] - 1.0 > 20.0 * figures['track_scale_sigma']
    assert figures['position_rmse_with_scale_m'] <= 0.02
    # it follows the scanner, as the data set says
    assert np.hypot(*figures['camera_point_m']) < 0.01
    assert abs(figures['arena_scale'] - 1.0) < 0.01
    assert figures['track_scale'] > 1.07
    for stream, taken in (('scan', SCAN_LAG), ('camera', CAMERA_LAG)):
        assert abs(figures[f'{stream}_lag_s'] - taken) < 2.0 * figures[f'{stream}_lag_sigma_s']
    assert out.read_bytes().startswith(b'\x89PNG')


@real_data
def test_the_text_says_what_is_met_and_what_is_not(capsys):
    assert main(['study', 'lego', str(SHARED)]) == 0
    text = capsys.readouterr().out
    assert re.search(r'the track as it is +6\.[0-4]\d cm, not met', text)
    assert re.search(r'the track 1\.\d\d\d times smaller +1\.[56]\d cm, met', text)
    assert re.search(r'Scans are stamped 0\.4\d s late .*\(0\.46 is taken\)', text)
