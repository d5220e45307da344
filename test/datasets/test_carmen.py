# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: each kind of line, what the lines leave unsaid, and broken ones."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rlml_slam.datasets.carmen import read_carmen
from rlml_slam.errors import FileFormatError

SHARED = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'slam-benchmark'


def flaser(n, stamp, laser=(0.0, 0.0, 0.0), robot=(0.0, 0.0, 0.0), ranges=None):
    r = [1.5] * n if ranges is None else ranges
    words = ['FLASER', n, *r, *laser, *robot, stamp, 'host', 0.1]
    return ' '.join(map(str, words))


def odom(stamp, x=0.0, y=0.0, theta=0.0):
    return f'ODOM {x} {y} {theta} 0.1 0.2 0 {stamp} host 0.1'


def robotlaser(ranges, remissions, stamp, laser=(0.1, 0, 0), robot=(0, 0, 0)):
    words = [
        'ROBOTLASER1', 0, -1.0, 2.0, 0.5, 20.0, 0.01, 0, len(ranges), *ranges,
        len(remissions), *remissions, *laser, *robot, 0.3, 0.1, 1, 2, 3, stamp, 'host', 0.5,
    ]  # fmt: skip
    return ' '.join(map(str, words))


def read(tmp_path, *lines, **options):
    path = tmp_path / 'x.log'
    path.write_text('\n'.join(['# a comment', *lines]) + '\n')
    return read_carmen(path, **options)


def test_flaser_and_odom(tmp_path):
    log = read(
        tmp_path,
        odom('976052857.337284', 1.0, 2.0, 0.5),
        flaser(4, '976052857.337530', ranges=[1.25, 81.83, 0.0, 2.0]),
    )
    (o,), (s,) = log.odometry, log.scans
    assert o.stamp == 976052857_337284000
    assert_allclose(o.pose, [1.0, 2.0, 0.5])
    assert s.stamp == 976052857_337530000
    # "no return" is +Inf (REP-117); zero is left, below range_min
    assert_array_equal(s.ranges, np.array([1.25, np.inf, 0.0, 2.0], np.float32))
    assert s.range_min > 0.0
    assert len(s.intensities) == 0


@pytest.mark.parametrize(
    ('n', 'first', 'step'),
    [(180, -90.0, 1.0), (181, -90.0, 1.0), (360, -90.0, 0.5), (361, -90.0, 0.5),
     (400, -50.0, 0.25), (401, -50.0, 0.25), (91, -90.0, 2.0)],
)  # fmt: skip
def test_angles_that_old_lines_do_not_say(tmp_path, n, first, step):
    (s,) = read(tmp_path, flaser(n, 1.0)).scans
    assert np.degrees(s.angle_min) == pytest.approx(first)
    assert np.degrees(s.angle_increment) == pytest.approx(step)


def test_given_field_of_view_and_range_win(tmp_path):
    log = read(tmp_path, flaser(181, 1.0), field_of_view=np.pi / 2, max_range=1.5)
    assert log.scans[0].angle_min == pytest.approx(-np.pi / 4)
    assert log.scans[0].angle_increment == pytest.approx(np.pi / 360)
    assert np.isinf(log.scans[0].ranges).all()


def test_robotlaser_says_its_angles(tmp_path):
    log = read(tmp_path, robotlaser([1.0, 25.0, 3.0], [7, 8, 9], 5.5))
    (s,) = log.scans
    assert (s.angle_min, s.angle_increment, s.range_max) == (-1.0, 0.5, 20.0)
    assert_array_equal(s.ranges, np.array([1.0, np.inf, 3.0], np.float32))
    assert_array_equal(s.intensities, np.array([7, 8, 9], np.float32))
    assert s.stamp == 5_500_000_000
    assert_allclose(log.T_base_laser, [0.1, 0.0, 0.0])


def test_rawlaser_needs_odometry_lines(tmp_path):
    raw = 'RAWLASER1 0 -1.5 3.0 1.5 10.0 0.01 0 3 1 2 3 0 2.0 host 0.1'
    old = 'RAWLASER 3 1 2 3 2.5 host 0.1'
    log = read(tmp_path, odom(1.9), raw, odom(2.1, x=0.5), old)
    assert [s.stamp for s in log.scans] == [2_000_000_000, 2_500_000_000]
    assert len(log.odometry) == 2


def test_laser_line_poses_serve_where_there_is_no_odometry(tmp_path):
    log = read(tmp_path, *(flaser(4, 1.0 + k, robot=(k, 0, 0), laser=(k, 0, 0)) for k in range(3)))
    assert_allclose([o.pose[0] for o in log.odometry], [0.0, 1.0, 2.0])


def test_laser_offset_is_that_of_the_two_poses(tmp_path):
    # the laser 4 cm behind the robot, whichever way it looks
    lines = []
    for k, theta in enumerate((0.0, 1.0, 3.0)):
        robot = np.array([2.0, 1.0, theta])
        laser = robot - [0.04 * np.cos(theta), 0.04 * np.sin(theta), 0.0]
        lines.append(flaser(4, 1.0 + k, laser=np.round(laser, 6), robot=robot))
    assert_allclose(read(tmp_path, *lines).T_base_laser, [-0.04, 0.0, 0.0], atol=1e-5)


def test_stated_offset_wins_and_corrected_poses_say_nothing(tmp_path):
    corrected = [
        flaser(4, 1.0, laser=(0, 0, 0), robot=(0, 0, 0)),
        flaser(4, 2.0, laser=(1.3, 0, 0), robot=(1, 0, 0)),
    ]
    assert_allclose(read(tmp_path, *corrected).T_base_laser, 0.0)
    stated = 'PARAM robot_frontlaser_offset 0.17 0 host 0'
    assert_allclose(read(tmp_path, stated, *corrected).T_base_laser, [0.17, 0.0, 0.0])
    left = 'PARAM robot_frontlaser_side_offset -0.05'
    turned = 'PARAM robot_frontlaser_angular_offset 0.1'
    laser = read(tmp_path, stated, left, turned, *corrected).T_base_laser
    assert_allclose(laser, [0.17, -0.05, 0.1])


def test_lines_out_of_order_are_sorted_and_counted(tmp_path):
    stamps = (1.0, 3.0, 2.0, 4.0, 4.0)
    log = read(tmp_path, *(flaser(4, t) for t in stamps), odom(2.0), odom(1.0))
    assert [s.stamp * 1e-9 for s in log.scans] == sorted(stamps)
    assert log.counts['out_of_order'] == 2
    assert log.odometry[0].stamp < log.odometry[1].stamp


def test_clock_that_was_set_back_is_told(tmp_path):
    ordered = read(tmp_path, *(flaser(4, t) for t in (1.0, 2.0, 3.0)))
    assert ordered.set_back == 0
    back = read(tmp_path, *(flaser(4, t) for t in (1.0, 31.0, 2.0, 3.0, 4.0)))
    assert back.set_back == 29_000_000_000


def test_time_of_the_logger_serves_where_there_is_no_other(tmp_path):
    lines = [flaser(4, 0), odom(0), robotlaser([1.0], [], 0)]
    log = read(tmp_path, *lines)
    assert [scan.stamp for scan in log.scans] == [100_000_000, 500_000_000]
    assert [sample.stamp for sample in log.odometry] == [100_000_000]
    # one line that has its time is not set beside another clock
    assert [scan.stamp for scan in read(tmp_path, *lines, flaser(4, 7.0)).scans] == [7 * 10**9]


def test_log_without_any_time_is_refused(tmp_path):
    untimed = flaser(4, 0).removesuffix('0.1') + '0'
    with pytest.raises(FileFormatError, match=r'x\.log: no scan in it has a stamp'):
        read(tmp_path, untimed)


def test_stamp_zero_is_left_out(tmp_path):
    log = read(tmp_path, odom(0), odom(1.0), flaser(4, 1.0))
    assert len(log.odometry) == 1
    assert log.counts['invalid_stamp'] == 1


BROKEN = [
    ('FLASER 180 1.0 2.0', 'too short for 180 beams'),
    ('FLASER', 'number of beams is missing'),
    ('FLASER 0 0 0 0 0 0 0 1.0 host 1.0', 'without beams'),
    ('ODOM 1 2', 'cut short'),
    ('ODOM 1 nan 0 0 0 0 1.0 host 1.0', 'not finite'),
    ('ODOM 1 0 0 0 0 0 abc host 1.0', 'not a time'),
    ('ROBOTLASER1 0 -1 2', 'cut short'),
    ('ROBOTLASER1 0 -1.0 2.0 0.0 20.0 0.01 0 1 5.0 0 0 0 0 0 0 0 0 0 0 0 0 1.0 h 1', 'is wrong'),
]


@pytest.mark.parametrize(('line', 'why'), BROKEN)
def test_broken_line_is_named_if_strict(tmp_path, line, why):
    with pytest.raises(
        FileFormatError, match=rf'x\.log:3: broken {line.split()[0]} line: .*{why}'
    ):
        read(tmp_path, flaser(4, 1.0), line, strict=True)


def test_one_broken_line_costs_nothing_else(tmp_path):
    log = read(tmp_path, *(flaser(4, 1.0 + k) for k in range(5)), 'FLASER 180 1.0')
    assert len(log.scans) == 5
    assert log.counts['broken'] == 1
    assert 'x.log:7: broken FLASER line' in log.first_error


def test_file_of_broken_lines_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match=r'x\.log:3: .*\(2 broken lines\)'):
        read(tmp_path, flaser(4, 1.0), 'ODOM 1', 'ODOM 2')


def test_file_without_scans_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match='no FLASER, ROBOTLASER1 or RAWLASER'):
        read(tmp_path, odom(1.0))


def test_compressed_log_is_read(tmp_path):
    path = tmp_path / 'x.clf.gz'
    path.write_bytes(gzip.compress(flaser(180, 1.0).encode()))
    assert len(read_carmen(path).scans) == 1


@pytest.mark.skipif(not SHARED.exists(), reason=f'the data set is not at {SHARED}')
def test_fr079_offset_and_counts():
    log = read_carmen(SHARED / 'fr079' / 'fr079.rebuilt.log.xz')
    assert len(log.scans) == 4934
    assert len(log.odometry) == 8951
    # the laser poses of the log are 4 cm behind the odometry
    assert_allclose(log.T_base_laser, [-0.04, 0.0, 0.0])
    assert log.counts['broken'] == 0
