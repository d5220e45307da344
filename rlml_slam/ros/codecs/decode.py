# SPDX-License-Identifier: Apache-2.0
"""Messages become core types. Fields are read by name, whoever made the message.

So the same functions read rclpy's messages and those that rosbags reads from ROS 1 and ROS 2
bags. Each raises InputError that names topic and field where a message cannot be believed; what
can be checked only in context (order of stamps, known frames) is left to the sequencer.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.motion import MAX_VARIANCE, SECOND
from rlml_slam.params import Reflector
from rlml_slam.ros.codecs.point_cloud import bounded, check_disjoint, column, read_cloud
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.types import ANONYMOUS, Detections, Imu, Odometry, Scan

MAX_TILT = 0.35  # [rad] a larger roll or pitch is not a planar pose
MIN_UPRIGHT = math.cos(MAX_TILT)
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])  # (x, y, yaw) of ROS's 6 x 6 covariances
_ROUNDING = 1e-9  # of the largest variance
LARGEST_VARIANCE = 1e15  # [m^2], [rad^2] of what another node of this package sends
DETECTED = ('x', 'y', 'id', 'diameter', 'sigma_range', 'sigma_bearing')  # fields
LARGEST_SIGMA = 100.0  # [m], [rad] of a detection
MIN_SIGMA_R, MIN_SIGMA_B = 1e-4, 1e-5  # [m], [rad] of range and bearing of a detection
# [ns] seconds are 32 bits in a message; transforms are published some seconds ahead
LAST_STAMP = ((1 << 31) - 60) * SECOND
FASTEST = 1e3  # [m/s], [rad/s]
FARTHEST = 1e4  # [m] beyond any laser
END = 0.1  # of the view: drivers round where the last beam is, or count one more
LARGE = 50  # rows of a covariance whose eigenvalues are not computed
_NEAR = 1e-3  # [m] nearer than this a bearing has no meaning


@dataclass(frozen=True)
class PoseEstimate:
    """A pose (3,) with covariance (3, 3) in ``frame_id`` at a stamp."""

    stamp: int
    frame_id: str
    pose: Array
    cov: Array


@dataclass(frozen=True)
class Transform:
    """Where ``child`` sits in ``parent``: ``R`` (3, 3) and ``t`` (3,) of T_parent_child."""

    parent: str
    child: str
    R: Array
    t: Array


def covariances(cov: Array, where: str) -> None:
    """Raise InputError unless every matrix (..., n, n) is symmetric positive semidefinite."""
    bounded(cov, where, LARGEST_VARIANCE)
    most = float(np.abs(cov).max(initial=0.0))
    symmetric = 0.5 * (cov + np.swapaxes(cov, -1, -2))
    if np.abs(cov - symmetric).max(initial=0.0) > 1e-4 * most:
        raise InputError(f'{where} is not symmetric')
    if cov.shape[-1] > LARGE:  # of a map: eigenvalues would take seconds, pairs take milliseconds
        variances = np.diagonal(symmetric, axis1=-2, axis2=-1)
        limit = variances[..., None] * variances[..., None, :] + (1e-4 * most) ** 2
        wrong = (variances < -1e-4 * most).any() or (symmetric**2 > limit).any()
    else:
        wrong = np.linalg.eigvalsh(symmetric).min(initial=0.0) < -1e-4 * most
    if wrong:
        raise InputError(f'{where} is not positive semidefinite')


def frame(frame_id: str) -> str:
    """A frame id without the leading slash that ROS 1 allowed."""
    return frame_id.lstrip('/')


def stamp(msg: Any, topic: str) -> int:
    """The header's stamp [ns]; InputError if no clock can have it."""
    return _stamp(int(msg.header.stamp.sec), int(msg.header.stamp.nanosec), topic)


def stamp_or_now(msg: Any, topic: str) -> int:
    """The same; 0 of a message that is about now, whose stamp is not set."""
    return stamp(msg, topic) if msg.header.stamp.sec or msg.header.stamp.nanosec else 0


def known_stamp(msg: Any) -> int:
    """The same; 0 where no clock can have it."""
    try:
        return stamp(msg, '')
    except InputError:
        return 0


def _stamp(sec: int, nanosec: int, topic: str) -> int:
    if nanosec >= SECOND:  # a stamp up to 3.3 s ahead, which would be believed
        raise InputError(f'{topic}: header.stamp.nanosec is {nanosec}, a second or more')
    ns = sec * SECOND + nanosec
    if not 0 < ns < LAST_STAMP:
        raise InputError(f'{topic}: header.stamp is {ns} ns')
    return ns


def size(msg: Any) -> int:
    """How many beams or points a message of a sensor says that it has; 0 of any other message."""
    if hasattr(msg, 'ranges'):
        return len(msg.ranges)
    if hasattr(msg, 'poses'):
        return len(msg.poses)
    return int(msg.width) * int(msg.height) if hasattr(msg, 'point_step') else 0


def scan(msg: Any, topic: str = 'scan') -> Scan:
    """LaserScan; ranges are passed on as they are, NaN and Inf included.

    A range_max of Inf, or one that leaves no range at all, as 0 does, says that the driver does
    not know it, not that Inf is a range; a range_min below 0 makes no range of what is below 0.
    Intensities of which there are not as many as ranges are left out. InputError where angles
    contradict each other.
    """
    ranges = np.array(msg.ranges, dtype=np.float32)
    intensities = np.array(msg.intensities, dtype=np.float32)
    if intensities.shape != ranges.shape:  # nobody knows which beams they are of
        intensities = intensities[:0]
    _check_angle_max(msg, len(ranges), topic)
    least, most = max(float(msg.range_min), 0.0), min(float(msg.range_max), FARTHEST)
    return Scan(
        stamp(msg, topic), frame(msg.header.frame_id), float(msg.angle_min),
        float(msg.angle_increment), float(msg.time_increment), least,
        FARTHEST if most <= least else most, ranges, intensities,
    )  # fmt: skip


def _check_angle_max(msg: Any, n: int, topic: str) -> None:
    """Raise InputError where the last of n beams looks elsewhere than the message says.

    An ``angle_max`` of 0, or one that is not finite, is not set; whole turns do not count.
    """
    step, last = float(msg.angle_increment), float(msg.angle_max)
    view = step * (n - 1)
    end = float(msg.angle_min) + view
    if n < 2 or 0.0 in (last, view) or not math.isfinite(last - end):
        return
    if abs(math.remainder(last - end, 2.0 * math.pi)) > 2.0 * abs(step) + END * abs(view):
        raise InputError(
            f'{topic}: angle_max is {last:.4g} rad, but {n} beams end at angle_min + {n - 1} * '
            f'angle_increment = {end:.4g} rad'
        )


def odometry(msg: Any, topic: str = 'odom') -> Odometry:
    """Odometry: its planar pose."""
    return Odometry(stamp(msg, topic), planar_pose(msg.pose.pose, f'{topic}: pose'))


def imu(msg: Any, topic: str = 'imu', up: Array | None = None) -> Imu:
    """Imu: the yaw rate about the base z axis, which is ``up`` (3,) in the IMU's frame."""
    if msg.angular_velocity_covariance[0] == -1.0:
        raise InputError(f'{topic}: angular_velocity is marked as not measured')
    w = np.array([msg.angular_velocity.x, msg.angular_velocity.y, msg.angular_velocity.z])
    used = w[2:] if up is None else w
    bounded(used, f'{topic}: angular_velocity', FASTEST)
    return Imu(stamp(msg, topic), float(w[2] if up is None else up @ w))


def detections(msg: Any, noise: Reflector, topic: str = 'reflectors') -> Detections:
    """PointCloud2 of reflectors in the sensor's frame; an empty cloud is "looked and saw none".

    x, y are required; id, diameter, sigma_range [m] and sigma_bearing [rad] are optional, and
    ``noise`` stands in for the sigmas where they are missing, NaN or not positive. Points that
    are not finite are absent points in a cloud that is not dense, and an error in a dense one.
    An id that several points have is none.
    """
    cloud = read_cloud(msg, topic)
    missing = {'x', 'y'} - set(cloud.dtype.names or ())
    if missing and len(cloud):
        raise InputError(f'{topic}: cloud has no field {", ".join(sorted(missing))}')
    check_disjoint(cloud, DETECTED, topic)
    for name in {'x', 'y'} - missing:
        if len(cloud) and cloud.dtype[name].base.kind != 'f':
            raise InputError(f'{topic}: {name} is {cloud.dtype[name]}, not a float')
    points = np.stack([column(cloud, 'x', np.nan), column(cloud, 'y', np.nan)], -1)
    finite = np.isfinite(points).all(-1)
    if msg.is_dense and not finite.all():
        raise InputError(f'{topic}: {np.sum(~finite)} points of a dense cloud are not finite')
    bounded(points[finite], f'{topic}: a position', FARTHEST)
    ids = column(cloud, 'id', ANONYMOUS)[finite]
    known = (ids >= 0) & (ids < 2**53)
    diameters = column(cloud, 'diameter', np.nan)[finite]
    sigma_r = _positive(column(cloud, 'sigma_range', np.nan)[finite], noise.sigma_range)
    sigma_b = _positive(column(cloud, 'sigma_bearing', np.nan)[finite], noise.sigma_bearing)
    points = points[finite]
    return Detections(
        stamp(msg, topic),
        frame(msg.header.frame_id),
        points,
        detection_covariance(points, sigma_r, sigma_b, noise.sigma_fallback),
        _unique(np.where(known, ids, ANONYMOUS).astype(np.int64)),
        _positive(diameters, np.nan),
    )


def detections_of_poses(msg: Any, noise: Reflector, topic: str = 'reflector_poses') -> Detections:
    """PoseArray of reflectors, anonymous but for ``ids``; only the positions are read."""
    points = np.array([[p.position.x, p.position.y] for p in msg.poses], dtype=np.float64)
    points = points.reshape(-1, 2)
    bounded(points, f'{topic}: a position', FARTHEST)
    n = len(points)
    sigma_r, sigma_b = np.full(n, noise.sigma_range), np.full(n, noise.sigma_bearing)
    return Detections(
        stamp(msg, topic),
        frame(msg.header.frame_id),
        points,
        detection_covariance(points, sigma_r, sigma_b, noise.sigma_fallback),
        _unique(getattr(msg, 'ids', np.full(n, ANONYMOUS, dtype=np.int64))),
        np.full(n, np.nan),
    )


def _unique(ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """The ids (n,), ANONYMOUS where several reflectors have one: it is a default of the driver."""
    _, which, times = np.unique(ids, return_inverse=True, return_counts=True)
    return np.where(times[which] == 1, ids, ANONYMOUS)


def _positive(values: Array, otherwise: float) -> Array:
    return np.where((values > 0.0) & (values < LARGEST_SIGMA), values, otherwise)


def detection_covariance(points: Array, sigma_r: Array, sigma_b: Array, fallback: float) -> Array:
    """Covariances (n, 2, 2); at the sensor itself, where there is no bearing, fallback^2 I."""
    r = np.hypot(points[:, 0], points[:, 1])
    near = r < _NEAR
    u = points / np.where(near, 1.0, r)[:, None]
    sigma_r, sigma_b = np.maximum(sigma_r, MIN_SIGMA_R), np.maximum(sigma_b, MIN_SIGMA_B)
    cov = polar_covariance(u, sigma_r**2, (r * sigma_b) ** 2)
    cov[near] = fallback**2 * np.eye(2)
    return cov


def pose_estimate(msg: Any, topic: str = 'pose') -> PoseEstimate:
    """PoseWithCovarianceStamped or Odometry: planar pose and covariance."""
    cov = _planar_covariance(msg, topic)
    return PoseEstimate(
        stamp(msg, topic),
        frame(msg.header.frame_id),
        planar_pose(msg.pose.pose, f'{topic}: pose'),
        0.5 * (cov + cov.T),
    )


def start_pose(msg: Any, map_frame: str, topic: str = 'initialpose') -> PoseEstimate:
    """The pose_estimate to begin at: stamp 0 means now, an empty frame_id ``map_frame``.

    InputError also for any other frame, and for a covariance that is not symmetric positive
    semidefinite or has a variance above MAX_VARIANCE.
    """
    in_frame, map_frame = frame(msg.header.frame_id), frame(map_frame)
    if in_frame not in ('', map_frame):
        raise InputError(f'{topic}: header.frame_id is {in_frame!r} instead of {map_frame!r}')
    cov, where = _planar_covariance(msg, topic), f'{topic}: pose.covariance'
    most = float(np.diag(cov).max())
    if most > MAX_VARIANCE:
        raise InputError(f'{where} has a variance of {most:.3g}, above {MAX_VARIANCE:.3g}')
    if np.abs(cov - cov.T).max() > _ROUNDING * most:
        raise InputError(f'{where} is not symmetric')
    cov = 0.5 * (cov + cov.T)
    least = float(np.linalg.eigvalsh(cov)[0])
    if least < -_ROUNDING * most:
        raise InputError(f'{where} has the eigenvalue {least:.3g}, below 0')
    pose = planar_pose(msg.pose.pose, f'{topic}: pose')
    return PoseEstimate(stamp_or_now(msg, topic), map_frame, pose, cov)


def _planar_covariance(msg: Any, topic: str) -> Array:
    """(3, 3) of x, y and yaw: finite, without a negative variance."""
    full = np.asarray(msg.pose.covariance, dtype=np.float64)
    cov = np.array(full.reshape(6, 6)[_PLANAR])
    if not np.isfinite(cov).all() or (np.diag(cov) < 0.0).any():
        raise InputError(f'{topic}: pose.covariance is not a covariance')
    return cov


def twist(msg: Any, topic: str = 'cmd_vel') -> tuple[float, float]:
    """Speed [m/s] and turn rate [rad/s] of a Twist or TwistStamped."""
    t = getattr(msg, 'twist', msg)
    v, w = float(t.linear.x), float(t.angular.z)
    bounded((v, w), f'{topic}: twist', FASTEST)
    return v, w


def transforms(msg: Any, topic: str = '/tf_static') -> list[Transform]:
    """The transforms of a TFMessage, or the one of a TransformStamped."""
    out = []
    for m in msg.transforms if hasattr(msg, 'transforms') else [msg]:
        where = f'{topic}: {m.header.frame_id} to {m.child_frame_id}'
        v = m.transform.translation
        t = np.array([v.x, v.y, v.z], dtype=np.float64)
        bounded(t, f'{where}: translation', FARTHEST)
        R = rotation_matrix(m.transform.rotation, where)
        out.append(Transform(frame(m.header.frame_id), frame(m.child_frame_id), R, t))
    return out


def planar_pose(pose: Any, where: str) -> Array:
    """(x, y, yaw) of a Pose; z and a small tilt are left out, a large tilt is an InputError."""
    x, y = float(pose.position.x), float(pose.position.y)
    bounded((x, y), f'{where}.position')
    return np.array([x, y, yaw(rotation_matrix(pose.orientation, where), where)])


def yaw(R: NDArray[np.float64], where: str) -> float:
    """Angle of a rotation (3, 3) about z; InputError if it tilts by more than MAX_TILT."""
    if R[2, 2] < MIN_UPRIGHT:
        tilt = np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0)))
        raise InputError(f'{where} is not planar: it tilts by {tilt:.0f} degrees')
    return math.atan2(R[1, 0], R[0, 0])


def rotation_matrix(q: Any, where: str) -> Array:
    """R (3, 3) of a quaternion of about unit length; InputError otherwise."""
    x, y, z, w = float(q.x), float(q.y), float(q.z), float(q.w)
    norm = math.hypot(x, y, z, w)
    if not abs(norm - 1.0) < 0.01:  # also true for NaN
        raise InputError(f'{where}: quaternion has the length {norm:.3g} instead of 1')
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def occupancy_grid(msg: Any, topic: str) -> OccupancyGrid | None:
    """The grid of a message; None where it has no cells."""
    info, cells = msg.info, np.asarray(msg.data, dtype=np.int8)
    rows, columns = int(info.height), int(info.width)
    if rows * columns == 0:
        return None
    x, y, turn = planar_pose(info.origin, f'{topic}: info.origin').tolist()
    resolution = float(info.resolution)
    if len(cells) != rows * columns or not 1e-3 <= resolution <= 1e3:
        raise InputError(f'{topic}: {len(cells)} cells do not fill {rows} x {columns} of a map')
    # the message has 32 bits for it, of 0.05 m as well
    return OccupancyGrid(round(resolution, 7), (x, y), cells.reshape(rows, columns), turn)


def serialized_stamp(data: bytes, skipped: int = 0) -> int:
    """Stamp [ns] of a serialized message that begins with a header, after ``skipped`` bytes.

    0 where there is none, or none that a clock can have.
    """
    try:
        # CDR: four bytes of encapsulation, then the header's stamp (int32 sec, uint32 nanosec)
        order = '<' if data[1] & 1 else '>'
        sec, nanosec = struct.unpack_from(f'{order}iI', data, 4 + skipped)
        return _stamp(sec, nanosec, '')
    except (struct.error, IndexError, InputError):
        return 0
