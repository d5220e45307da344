# SPDX-License-Identifier: Apache-2.0
"""Messages to core types and back, through both kinds of messages."""

from __future__ import annotations

import copy
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.motion import SECOND
from rlml_slam.params import Reflector
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import Make, make_bag, make_rclpy, rclpy_class
from rlml_slam.ros.codecs.point_cloud import build_cloud, read_cloud
from rlml_slam.sensing.deskew import project
from rlml_slam.types import ANONYMOUS, Detections, Health, Imu, Level, Scan

NOISE = Reflector()
STAMP = 1_700_000_000_123_456_789
MAKES = [
    pytest.param(make_bag, id='rosbags'),
    pytest.param(
        make_rclpy,
        id='rclpy',
        marks=pytest.mark.skipif(
            rclpy_class('sensor_msgs/msg/LaserScan') is None, reason='no ROS 2 messages installed'
        ),
    ),
]


@pytest.fixture(params=MAKES)
def make(request) -> Make:
    return request.param


def a_scan(**changes) -> Scan:
    ranges = np.array([1.0, np.nan, np.inf, -np.inf, 0.0, 5.5], dtype=np.float32)
    fields = {
        'stamp': STAMP, 'frame_id': 'laser', 'angle_min': -1.5, 'angle_increment': 0.5,
        'time_increment': 1e-4, 'range_min': 0.1, 'range_max': 30.0, 'ranges': ranges,
        'intensities': np.arange(6, dtype=np.float32),
    }  # fmt: skip
    return Scan(**{**fields, **changes})


def quaternion_of(make, roll, pitch, yaw):
    c, s = np.cos(np.array([roll, pitch, yaw]) / 2), np.sin(np.array([roll, pitch, yaw]) / 2)
    return make(
        'geometry_msgs/msg/Quaternion',
        x=float(s[0] * c[1] * c[2] - c[0] * s[1] * s[2]),
        y=float(c[0] * s[1] * c[2] + s[0] * c[1] * s[2]),
        z=float(c[0] * c[1] * s[2] - s[0] * s[1] * c[2]),
        w=float(c[0] * c[1] * c[2] + s[0] * s[1] * s[2]),
    )


def test_scan_survives_the_round_trip(make):
    want = a_scan()
    got = decode.scan(encode.laser_scan(make, want, 0.1))
    assert (got.stamp, got.frame_id) == (STAMP, 'laser')
    np.testing.assert_array_equal(got.ranges, want.ranges)
    np.testing.assert_array_equal(got.intensities, want.intensities)
    assert got.angle_min == want.angle_min
    # float32 on the wire: 1e-4 is not exact in it
    assert got.time_increment == pytest.approx(want.time_increment, rel=1e-7)


def test_scan_without_intensities_is_legal(make):
    msg = encode.laser_scan(make, a_scan(intensities=np.zeros(0, np.float32)))
    assert decode.scan(msg).intensities.shape == (0,)


def test_scan_with_other_number_of_intensities_is_used_without_them(make):
    scan = decode.scan(encode.laser_scan(make, a_scan(intensities=np.zeros(2, np.float32))))
    assert scan.intensities.shape == (0,)
    np.testing.assert_array_equal(scan.ranges, a_scan().ranges)


@pytest.mark.parametrize('longest', [0.0, -1.0, 0.1])
def test_range_max_that_leaves_no_range_is_not_known(make, longest):
    scan = decode.scan(encode.laser_scan(make, a_scan(range_max=longest, range_min=0.1)))
    assert scan.range_max == decode.FARTHEST
    assert scan.range_min == pytest.approx(0.1)


def test_range_max_that_is_nan_stays_so(make):
    assert np.isnan(decode.scan(encode.laser_scan(make, a_scan(range_max=np.nan))).range_max)


@pytest.mark.parametrize('last', [1.0, 1.5, 0.0, 1.9, np.nan, np.inf, 1.0 + 2.0 * np.pi])
def test_angle_max_may_count_a_beam_more_or_be_missing(make, last):
    msg = encode.laser_scan(make, a_scan())
    msg.angle_max = last
    assert decode.scan(msg).angle_increment == 0.5


@pytest.mark.parametrize(
    ('first', 'step', 'n', 'last'),
    [(-3.14, 0.00873, 360, 3.12), (2.36, 0.00436, 1081, -2.356), (-1.57, 0.0175, 181, 0.8)],
)
def test_angles_that_contradict_each_other_are_refused(make, first, step, n, last):
    ranges, none = np.ones(n, np.float32), np.zeros(0, np.float32)
    scan = a_scan(angle_min=first, angle_increment=step, ranges=ranges, intensities=none)
    msg = encode.laser_scan(make, scan)
    msg.angle_max = last
    with pytest.raises(InputError, match=rf'angle_max is {last:g} rad, but {n} beams end at'):
        decode.scan(msg)


@pytest.mark.parametrize('stamp', [0, -1_000_000_000])
def test_stamp_that_is_not_positive_is_refused(make, stamp):
    msg = encode.laser_scan(make, a_scan(stamp=stamp))
    with pytest.raises(InputError, match=rf'scan: header.stamp is {stamp} ns'):
        decode.scan(msg)


def test_stamp_that_no_message_can_answer_is_refused(make):
    msg = encode.laser_scan(make, a_scan(stamp=1))
    msg.header.stamp.sec, msg.header.stamp.nanosec = (1 << 31) - 1, 999_999_999
    with pytest.raises(InputError, match=r'header\.stamp is 2147483647999999999 ns'):
        decode.scan(msg)


@pytest.mark.parametrize('nanosec', [1_000_000_000, 2**32 - 1])
def test_nanoseconds_of_a_second_or_more_are_refused(make, nanosec):
    msg = encode.laser_scan(make, a_scan())
    msg.header.stamp.nanosec = nanosec
    with pytest.raises(InputError, match=f'scan: header.stamp.nanosec is {nanosec}, a second'):
        decode.scan(msg)


@pytest.mark.parametrize(
    ('sec', 'nanosec'), [(0, 0), (-5, 0), ((1 << 31) - 1, 0), (7, SECOND), (7, 2**32 - 1)]
)
def test_stamp_that_no_clock_has_orders_and_dates_nothing(make, sec, nanosec):
    msg = encode.laser_scan(make, a_scan())
    assert decode.known_stamp(msg) == decode.stamp_or_now(msg, 'scan') == STAMP
    msg.header.stamp.sec, msg.header.stamp.nanosec = sec, nanosec
    assert decode.known_stamp(msg) == 0
    for head, order in ((b'\0\1\0\0', '<'), (b'\0\0\0\0', '>')):
        data = head + struct.pack(f'{order}iI', sec, nanosec)
        assert decode.serialized_stamp(data) == 0
        assert decode.serialized_stamp(data[:-1]) == decode.serialized_stamp(b'') == 0
        good = head + struct.pack(f'{order}IiI', 1, *divmod(STAMP, SECOND))
        assert decode.serialized_stamp(good, 4) == STAMP
    if not sec and not nanosec:
        assert decode.stamp_or_now(msg, 'scan') == 0
        return
    with pytest.raises(InputError, match=r'scan: header\.stamp'):
        decode.stamp_or_now(msg, 'scan')


def test_leading_slash_of_a_frame_is_dropped(make):
    assert decode.scan(encode.laser_scan(make, a_scan(frame_id='/laser'))).frame_id == 'laser'


@given(
    x=st.floats(-1e3, 1e3),
    y=st.floats(-1e3, 1e3),
    theta=st.floats(-np.pi, np.pi, exclude_min=True),
)
def test_odometry_pose_survives_the_round_trip(x, y, theta):
    T = np.array([x, y, theta])
    msg = encode.odometry(make_bag, STAMP, ('odom', 'base_link'), T, np.zeros((3, 3)))
    got = decode.odometry(msg)
    assert got.stamp == STAMP
    # the quaternion of a double costs a few ulp of pi
    np.testing.assert_allclose(se2.between(T, got.pose), 0.0, atol=1e-12)


def test_covariance_survives_the_round_trip(make):
    A = np.array([[0.3, 0.1, 0.02], [0.0, 0.2, 0.01], [0.0, 0.0, 0.05]])
    cov, T = A @ A.T, np.array([1.0, -2.0, 3.0])
    got = decode.pose_estimate(encode.pose_with_covariance(make, STAMP, 'map', T, cov))
    assert (got.stamp, got.frame_id) == (STAMP, 'map')
    np.testing.assert_allclose(got.cov, cov, atol=1e-16)
    np.testing.assert_allclose(got.pose, T, atol=1e-12)


@pytest.mark.parametrize('wrong', [np.nan, -1.0])
def test_covariance_that_is_none_is_refused(make, wrong):
    cov = np.diag([1.0, wrong, 1.0])
    msg = encode.pose_with_covariance(make, STAMP, 'map', np.zeros(3), cov)
    with pytest.raises(InputError, match=r'initialpose: pose\.covariance'):
        decode.pose_estimate(msg, 'initialpose')


def start(cov, frame_id='map', stamp=STAMP):
    return encode.pose_with_covariance(
        make_bag, stamp, frame_id, np.array([1.0, 2.0, 0.5]), np.array(cov, dtype=float)
    )


@pytest.mark.parametrize(
    ('cov', 'why'),
    [
        ([[0.25, 5, 0], [5, 0.25, 0], [0, 0, 0.07]], r'has the eigenvalue -4\.75, below 0'),
        ([[0.25, 0.1, 0], [0, 0.25, 0], [0, 0, 0.07]], 'is not symmetric'),
        (np.diag([0.25, 1e300, 0.07]), r'has a variance of 1e\+300, above 1e\+06'),
        ([[0.25, np.inf, 0], [np.inf, 0.25, 0], [0, 0, 0.07]], 'is not a covariance'),
    ],
)
def test_start_with_a_covariance_that_is_none_is_refused(cov, why):
    with pytest.raises(InputError, match=rf'initialpose: pose\.covariance {why}'):
        decode.start_pose(start(cov), 'map')


def test_start_may_be_certain_and_very_uncertain():
    for cov in (np.zeros((3, 3)), np.diag([0.25, 0.25, 0.0]), decode.MAX_VARIANCE * np.eye(3)):
        np.testing.assert_array_equal(decode.start_pose(start(cov), 'map').cov, cov)


def test_start_is_in_the_map():
    with pytest.raises(InputError, match=r"header\.frame_id is 'odom' instead of 'map'"):
        decode.start_pose(start(np.eye(3), 'odom'), 'map')
    for frame_id in ('', 'map', '/map'):
        got = decode.start_pose(start(np.eye(3), frame_id), 'map')
        assert got.frame_id == 'map'
        np.testing.assert_allclose(got.pose, [1.0, 2.0, 0.5], atol=1e-12)


def test_start_without_a_stamp_is_of_now():
    assert decode.start_pose(start(np.eye(3), stamp=0), 'map').stamp == 0
    assert decode.start_pose(start(np.eye(3)), 'map').stamp == STAMP
    with pytest.raises(InputError, match=r'header\.stamp is -'):
        decode.start_pose(start(np.eye(3), stamp=-STAMP), 'map')


@pytest.mark.parametrize('wrong', [np.nan, np.inf])
def test_odometry_that_is_not_finite_is_refused(make, wrong):
    T = np.array([0.0, wrong, 0.0])
    msg = encode.odometry(make, STAMP, ('odom', 'base_link'), T, np.zeros((3, 3)))
    with pytest.raises(InputError, match=r'odom: pose\.position is not finite'):
        decode.odometry(msg)


@pytest.mark.parametrize('length', [0.0, 2.0, np.nan])
def test_quaternion_without_unit_length_is_refused(make, length):
    msg = encode.odometry(make, STAMP, ('odom', 'base_link'), np.zeros(3), np.zeros((3, 3)))
    msg.pose.pose.orientation = make(
        'geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=float(length)
    )
    with pytest.raises(InputError, match='odom: pose: quaternion has the length'):
        decode.odometry(msg)


def test_small_tilt_is_left_out_and_a_large_one_refused(make):
    msg = encode.odometry(make, STAMP, ('odom', 'base_link'), np.zeros(3), np.zeros((3, 3)))
    msg.pose.pose.orientation = quaternion_of(make, 0.05, -0.1, 2.0)
    assert decode.odometry(msg).pose[2] == pytest.approx(2.0, abs=1e-12)
    msg.pose.pose.orientation = quaternion_of(make, np.pi, 0.0, 0.3)
    with pytest.raises(InputError, match='is not planar: it tilts by 180 degrees'):
        decode.odometry(msg)


def test_yaw_rate_is_taken_about_the_base_axis(make):
    msg = encode.imu(make, Imu(STAMP, 0.7), 'imu')
    assert decode.imu(msg).yaw_rate == 0.7
    assert decode.imu(msg, up=np.array([0.0, 0.0, -1.0])).yaw_rate == -0.7


def test_imu_without_rates_is_refused(make):
    msg = encode.imu(make, Imu(STAMP, 0.7), 'imu')
    msg.angular_velocity_covariance[0] = -1.0
    with pytest.raises(InputError, match='imu: angular_velocity is marked'):
        decode.imu(msg)


def some_detections(n=5, seed=0) -> Detections:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20.0, 20.0, (n, 2)).astype(np.float32).astype(np.float64)
    cov = decode.detection_covariance(
        points, rng.uniform(0.01, 0.1, n), rng.uniform(0.001, 0.01, n), 1
    )
    return Detections(
        STAMP, 'laser', points, cov, np.arange(n) - 1, np.full(n, 0.08, np.float32).astype(float)
    )


def test_detections_survive_the_round_trip(make):
    want = some_detections()
    got = decode.detections(encode.detections(make, want), NOISE)
    assert (got.stamp, got.frame_id) == (STAMP, 'laser')
    np.testing.assert_array_equal(got.points, want.points)
    np.testing.assert_array_equal(got.ids, want.ids)
    np.testing.assert_array_equal(got.diameters, want.diameters)
    # sigmas travel as float32
    np.testing.assert_allclose(got.cov, want.cov, rtol=1e-5, atol=1e-9)


def test_id_that_several_reflectors_have_is_none(make):
    """Many drivers leave 0 in a field that they do not fill."""
    want = replace(some_detections(), ids=np.array([0, 0, 7, -1, 0]))
    got = decode.detections(encode.detections(make, want), NOISE)
    assert got.ids.tolist() == [ANONYMOUS, ANONYMOUS, 7, ANONYMOUS, ANONYMOUS]
    poses = [encode.pose(make, np.array([*at, 0.0])) for at in want.points]
    device = SimpleNamespace(header=encode.header(make, STAMP, 'laser'), poses=poses, ids=want.ids)
    assert decode.detections_of_poses(device, NOISE).ids.tolist() == got.ids.tolist()


def test_empty_cloud_means_looked_and_saw_none(make):
    got = decode.detections(encode.detections(make, some_detections(0)), NOISE)
    assert len(got) == 0
    assert got.points.shape == (0, 2)
    assert got.cov.shape == (0, 2, 2)


def test_cloud_without_any_field_may_be_empty_but_not_full(make):
    bare = np.zeros(2, dtype=[('intensity', '<f4')])
    header = encode.header(make, STAMP, 'laser')
    assert len(decode.detections(build_cloud(make, header, bare[:0]), NOISE)) == 0
    with pytest.raises(InputError, match='reflectors: cloud has no field x, y'):
        decode.detections(build_cloud(make, header, bare), NOISE)


def test_parameters_stand_in_for_missing_sigmas(make):
    points = np.zeros(3, dtype=[('x', '<f8'), ('y', '<f8'), ('sigma_range', '<f4')])
    points['x'], points['sigma_range'] = 10.0, [0.5, np.nan, 0.0]
    got = decode.detections(build_cloud(make, encode.header(make, STAMP, 'laser'), points), NOISE)
    across = (10.0 * NOISE.sigma_bearing) ** 2
    np.testing.assert_allclose(got.cov[0], np.diag([0.25, across]))
    np.testing.assert_allclose(got.cov[1:], [np.diag([NOISE.sigma_range**2, across])] * 2)
    assert (got.ids == ANONYMOUS).all()
    assert np.isnan(got.diameters).all()


def test_polar_covariance_turns_with_the_bearing():
    for bearing in np.linspace(-np.pi, np.pi, 7):
        R = se2.rotation(bearing)
        p = R @ [[4.0], [0.0]]
        cov = decode.detection_covariance(p.T, np.array([0.1]), np.array([0.02]), 1.0)
        np.testing.assert_allclose(cov[0], R @ np.diag([0.01, 0.0064]) @ R.T, atol=1e-15)


def test_sigmas_of_a_detection_have_a_floor():
    cov = decode.detection_covariance(
        np.array([[20.0, 0.0]]), np.full(1, 1e-9), np.full(1, 1e-9), 1
    )
    np.testing.assert_allclose(cov[0], np.diag([1e-4**2, (20.0 * 1e-5) ** 2]))


def test_detection_at_the_sensor_has_a_regular_covariance():
    cov = decode.detection_covariance(np.zeros((1, 2)), np.ones(1), np.ones(1), 0.025)
    np.testing.assert_array_equal(cov[0], 0.025**2 * np.eye(2))


def test_absent_points_are_left_out_of_a_cloud_that_is_not_dense(make):
    seen = some_detections()
    seen.points[2] = np.nan
    msg = encode.detections(make, seen)
    with pytest.raises(InputError, match='reflectors: 1 points of a dense cloud are not finite'):
        decode.detections(msg, NOISE)
    msg.is_dense = False
    np.testing.assert_array_equal(decode.detections(msg, NOISE).ids, [-1, 0, 2, 3])


def test_big_endian_cloud_with_padded_rows_is_read(make):
    points = np.zeros(4, dtype=[('x', '>f4'), ('y', '>f8'), ('id', '>i4')])
    points['x'], points['y'], points['id'] = [1, 2, 3, 4], [5, 6, 7, 8], [-1, 0, 70000, 3]
    msg = build_cloud(make, encode.header(make, STAMP, 'laser'), points.astype(points.dtype))
    row = 2 * points.dtype.itemsize
    padded = np.zeros((2, row + 7), np.uint8)
    padded[:, :row] = points.view(np.uint8).reshape(2, row)
    msg = make(
        'sensor_msgs/msg/PointCloud2', header=msg.header, height=2, width=2, fields=msg.fields,
        is_bigendian=True, point_step=points.dtype.itemsize, row_step=row + 7,
        data=padded.reshape(-1), is_dense=True,
    )  # fmt: skip
    got = decode.detections(msg, NOISE)
    np.testing.assert_array_equal(got.points, [[1, 5], [2, 6], [3, 7], [4, 8]])
    np.testing.assert_array_equal(got.ids, [-1, 0, 70000, 3])


def test_cloud_with_too_little_data_is_refused(make):
    msg = encode.detections(make, some_detections())
    msg.width = 6
    with pytest.raises(InputError, match='reflectors: 120 bytes of data do not hold 1 x 6 points'):
        decode.detections(msg, NOISE)


def test_cloud_with_fields_outside_its_points_is_refused(make):
    msg = encode.detections(make, some_detections())
    msg.point_step = 8
    with pytest.raises(InputError, match='fields do not fit point_step 8'):
        read_cloud(msg)


def test_cloud_whose_fields_overlap_is_refused(make):
    msg = encode.detections(make, some_detections())
    msg.fields = copy.deepcopy(msg.fields)
    msg.fields[1].offset = 2
    with pytest.raises(InputError, match="fields 'x' and 'y' overlap"):
        decode.detections(msg, NOISE)


def test_fields_that_nobody_reads_may_be_anywhere(make):
    msg = encode.detections(make, some_detections())
    msg.fields = copy.deepcopy(msg.fields)
    names = [f.name for f in msg.fields]
    z = msg.fields[names.index('z')] if 'z' in names else None
    other = copy.deepcopy(msg.fields[0])
    other.name, other.count = 'xyz', 3
    msg.fields = [*msg.fields, other]
    if z is not None:
        z.offset = 0
    got = decode.detections(msg, NOISE)
    np.testing.assert_allclose(got.points, some_detections().points, rtol=1e-6)


def test_empty_cloud_of_whole_numbers_saw_nothing(make):
    msg = encode.detections(make, some_detections())
    msg.fields = copy.deepcopy(msg.fields)
    msg.fields[0].datatype = 6  # UINT32
    msg.width = 0
    assert len(decode.detections(msg, NOISE).points) == 0


def test_cloud_whose_coordinates_are_whole_numbers_is_refused(make):
    msg = encode.detections(make, some_detections())
    msg.fields = copy.deepcopy(msg.fields)
    msg.fields[0].datatype = 6  # UINT32
    with pytest.raises(InputError, match='reflectors: x is uint32, not a float'):
        decode.detections(msg, NOISE)


def test_pose_array_is_read_by_position_alone(make):
    pose = encode.pose(make, np.array([3.0, 4.0, 0.0]))
    pose.orientation.w = 0.0  # as drivers leave it
    header = encode.header(make, STAMP, 'laser')
    got = decode.detections_of_poses(
        make('geometry_msgs/msg/PoseArray', header=header, poses=[pose]), NOISE
    )
    np.testing.assert_array_equal(got.points, [[3.0, 4.0]])
    assert len(decode.detections_of_poses(
        make('geometry_msgs/msg/PoseArray', header=header, poses=[]), NOISE
    )) == 0  # fmt: skip


def test_transforms_keep_their_frames(make):
    T = np.array([0.2, 0.0, 0.5])
    msg = encode.transform(make, 0, ('/base_link', 'laser'), T)
    (got,) = decode.transforms(msg)
    assert (got.parent, got.child) == ('base_link', 'laser')
    np.testing.assert_allclose(got.t, [0.2, 0.0, 0.0])
    np.testing.assert_allclose(got.R[:2, :2], se2.rotation(0.5), atol=1e-15)


def test_twist_is_read_stamped_or_not(make):
    plain = make(
        'geometry_msgs/msg/Twist',
        linear=encode.vector(make, 0.5, 0.0, 0.0), angular=encode.vector(make, 0.0, 0.0, -1.0),
    )  # fmt: skip
    stamped = make(
        'geometry_msgs/msg/TwistStamped', header=encode.header(make, STAMP, ''), twist=plain
    )
    assert decode.twist(plain) == decode.twist(stamped) == (0.5, -1.0)
    plain.linear.x = float('nan')
    with pytest.raises(InputError, match='cmd_vel: twist is not finite'):
        decode.twist(plain)


def test_occupancy_grid_is_written_row_by_row(make):
    grid = OccupancyGrid(0.05, (-1.0, 2.0), np.array([[0, 100, -1], [1, 2, 3]], dtype=np.int8))
    msg = encode.occupancy_grid(make, STAMP, 'map', grid)
    assert (msg.info.width, msg.info.height) == (3, 2)
    assert (msg.info.origin.position.x, msg.info.origin.position.y) == (-1.0, 2.0)
    assert list(msg.data) == [0, 100, -1, 1, 2, 3]


@pytest.mark.skipif(
    rclpy_class('diagnostic_msgs/msg/DiagnosticStatus') is None, reason='no ROS 2 installed'
)
def test_diagnostics_give_level_and_reasons():
    health = Health(Level.DEGRADED, ('scan is 210 ms late', 'saw 2 of 7 expected reflectors'))
    (status,) = encode.diagnostics(make_rclpy, STAMP, 'front_end', health, {'scans': 3}).status
    assert status.level == bytes([1])
    assert status.message == 'scan is 210 ms late; saw 2 of 7 expected reflectors'
    assert [(v.key, v.value) for v in status.values] == [('scans', '3')]


def test_ranges_below_zero_are_none_though_the_least_range_is_lower(make):
    """As far below 0 as a float goes, their end points had no cell that an integer holds."""
    msg = encode.laser_scan(make, a_scan())
    msg.range_min, msg.ranges[2] = -3.4e38, -3.3e38
    got = decode.scan(msg)
    assert got.range_min == 0.0
    assert np.abs(project(got, np.zeros(3), np.zeros((1, 3)), 30.0)).max() <= 30.0
