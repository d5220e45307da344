# SPDX-License-Identifier: Apache-2.0
"""Reflectors in the messages of devices and programs of others.

    visualization_msgs/MarkerArray      ``nav_reflectors`` of sick_scan_xd (NAV350): DELETEALL and
                                        then a CYLINDER and a text for each; marker.id counts
    sensor_msgs/PointCloud2             a whole scan with the field ``reflector`` (picoScan,
                                        multiScan): points whose bit is set
    sick_safetyscanners2_interfaces/ExtendedLaserScan       beams with ``reflektor_status``
    cartographer_ros_msgs/LandmarkList  landmarks with ids, in the tracking frame

The packages of the last two are not part of ROS 2; where they are not installed, nothing is
subscribed (message_types.rclpy_class).
"""

from __future__ import annotations

import zlib
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs.point_cloud import column, read_cloud
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS

ADD, CYLINDER = 0, 3  # of visualization_msgs/Marker
# [m] between neighbouring points of one reflector; two reflectors are farther apart
GAP = 0.15
BIT = 'reflector'


def header_of(msg: Any) -> Any:
    """The header of a message; that of the first marker, or of the scan inside."""
    if hasattr(msg, 'header'):
        return msg.header
    if hasattr(msg, 'laser_scan'):
        return msg.laser_scan.header
    if not len(msg.markers):
        raise InputError('a MarkerArray without markers has no stamp')
    return msg.markers[0].header


def is_device(msg: Any) -> bool:
    """Whether a message has to be read by :func:`read`."""
    if hasattr(msg, 'point_step'):
        return any(f.name == BIT for f in msg.fields)
    return any(hasattr(msg, name) for name in ('markers', 'landmarks', 'reflektor_status'))


def read(msg: Any, most: int) -> tuple[Array, NDArray[np.int64]]:
    """Positions (n, 2) [m] and ids (n,) of the reflectors, in the frame of the header.

    Raises InputError; also for more than ``most`` points, beams, markers or landmarks.
    """
    for name in ('markers', 'landmarks', 'reflektor_status'):
        if len(getattr(msg, name, ())) > most:
            raise InputError(f'{len(getattr(msg, name))} {name}, more than {most}')
    if hasattr(msg, 'markers'):
        return _anonymous(_of_markers(msg))
    if hasattr(msg, 'landmarks'):
        return _of_landmarks(msg)
    if hasattr(msg, 'reflektor_status'):
        return _anonymous(grouped(_of_beams(msg)))
    if int(msg.width) * int(msg.height) > most:
        raise InputError(f'{msg.width} x {msg.height} points, more than {most}')
    cloud = read_cloud(msg)
    points = np.stack([column(cloud, 'x', np.nan), column(cloud, 'y', np.nan)], -1)
    return _anonymous(grouped(points[column(cloud, BIT, 0.0) > 0.5]))


def as_poses(msg: Any, most: int) -> Any:
    """The same as a PoseArray, with ``ids`` besides."""
    points, ids = read(msg, most)
    poses = [SimpleNamespace(position=SimpleNamespace(x=x, y=y)) for x, y in points.tolist()]
    return SimpleNamespace(header=header_of(msg), poses=poses, ids=ids)


def grouped(points: Array) -> Array:
    """Means (k, 2) of the groups of ``points`` (n, 2) around the sensor that are GAP apart."""
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points) < 2:
        return points
    points = points[np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind='stable')]
    apart = np.hypot(*(points - np.roll(points, 1, axis=0)).T) > GAP
    if not apart.any():
        return points.mean(axis=0)[None]
    # begin where a group begins, so that none is cut at the back of the sensor
    first = int(np.argmax(apart))
    points, starts = np.roll(points, -first, axis=0), np.flatnonzero(np.roll(apart, -first))
    counts = np.diff([*starts, len(points)])
    return np.asarray(np.add.reduceat(points, starts, axis=0) / counts[:, None])


def _anonymous(points: Array) -> tuple[Array, NDArray[np.int64]]:
    return points, np.full(len(points), ANONYMOUS, dtype=np.int64)


def _of_markers(msg: Any) -> Array:
    frame = header_of(msg).frame_id
    shown = [m for m in msg.markers if m.action == ADD and m.type == CYLINDER]
    if any(m.header.frame_id != frame for m in shown):
        raise InputError(f'the markers are in several frames, the first is {frame!r}')
    at = [(m.pose.position.x, m.pose.position.y) for m in shown]
    return np.array(at, dtype=np.float64).reshape(-1, 2)


def _of_beams(msg: Any) -> Array:
    scan = msg.laser_scan
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    status = np.asarray(msg.reflektor_status, dtype=np.bool_)
    if len(status) != len(ranges):
        raise InputError(f'{len(status)} reflektor_status for {len(ranges)} ranges')
    bearing = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    used = status & np.isfinite(ranges) & (ranges >= scan.range_min) & (ranges <= scan.range_max)
    r, a = ranges[used], bearing[used]
    return np.stack([r * np.cos(a), r * np.sin(a)], -1)


def _of_landmarks(msg: Any) -> tuple[Array, NDArray[np.int64]]:
    """A landmark of weight 0 is ignored, as by Cartographer."""
    seen = [m for m in msg.landmarks if m.translation_weight > 0.0]
    at = [(m.tracking_from_landmark_transform.position.x,
           m.tracking_from_landmark_transform.position.y) for m in seen]  # fmt: skip
    ids = [_number(str(m.id)) for m in seen]
    return np.array(at, dtype=np.float64).reshape(-1, 2), np.array(ids, dtype=np.int64)


def _number(name: str) -> int:
    """A landmark's name as an id: a number as it is, other names by their checksum."""
    if not name:
        return ANONYMOUS
    short = name.isascii() and name.isdecimal() and len(name) < 10
    return int(name) if short else zlib.crc32(name.encode('utf-8', 'replace'))
