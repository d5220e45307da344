# SPDX-License-Identifier: Apache-2.0
"""The two messages that bags are full of, read as far as ros/convert.py asks for their fields.

The library makes an object of every part of a message; an Odometry has nine of them, and two
arrays that nobody reads. Layout: the CDR of OMG's DDSI-RTPS, little-endian, where each number is
aligned to its size, counted from the end of the four bytes of the encoding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from struct import Struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ENCODING = b'\x00\x01'  # plain, little-endian
START = 4  # bytes of the encoding
_HEADER = Struct('<iII')  # sec, nanosec, bytes of the frame id
_LENGTH = Struct('<I')
_POSE = Struct('<7d')
_SWEEP = Struct('<7f')
_ODOMETRY_END = 8 * (7 + 36 + 6 + 36)  # pose and twist, each with its covariance


class Time(NamedTuple):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


class Point(NamedTuple):
    """geometry_msgs/Point."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class Pose(NamedTuple):
    """geometry_msgs/Pose."""

    position: Point
    orientation: Quaternion


class UncertainPose(NamedTuple):
    """geometry_msgs/PoseWithCovariance without the covariance."""

    pose: Pose


class Odometry(NamedTuple):
    """nav_msgs/Odometry without what it says of errors and speeds."""

    header: Header
    pose: UncertainPose


class LaserScan(NamedTuple):
    """sensor_msgs/LaserScan; the arrays are views of the bag's bytes."""

    header: Header
    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32]


def odometry(raw: bytes) -> Odometry:
    """Raises ValueError or struct.error where the bytes are too few."""
    header, at = _header(raw)
    (length,) = _LENGTH.unpack_from(raw, at)  # of the child frame's name
    at = START + (at + _LENGTH.size + length - START + 7) // 8 * 8
    if at + _ODOMETRY_END > len(raw):
        raise ValueError('it ends within its numbers')
    x, y, z, qx, qy, qz, qw = _POSE.unpack_from(raw, at)
    pose = Pose(Point(x, y, z), Quaternion(qx, qy, qz, qw))
    return Odometry(header, UncertainPose(pose))


def laser_scan(raw: bytes) -> LaserScan:
    """Raises ValueError or struct.error where the bytes are too few."""
    header, at = _header(raw)
    first, last, step, ray, sweep, nearest, farthest = _SWEEP.unpack_from(raw, at)
    ranges, at = _floats(raw, at + _SWEEP.size)
    intensities, _ = _floats(raw, at)
    return LaserScan(header, first, last, step, ray, sweep, nearest, farthest, ranges, intensities)


READERS: Mapping[str, Callable[[bytes], Odometry | LaserScan]] = {
    'nav_msgs/msg/Odometry': odometry,
    'sensor_msgs/msg/LaserScan': laser_scan,
}


def _header(raw: bytes) -> tuple[Header, int]:
    """It, and where the next number of four bytes is."""
    if raw[:2] != ENCODING:
        raise ValueError('it is encoded in another way')
    sec, nanosec, length = _HEADER.unpack_from(raw, START)
    at = START + _HEADER.size
    frame_id = bytes(raw[at : at + length - 1]).decode()  # a zero ends it
    return Header(Time(sec, nanosec), frame_id), at + (length + 3) // 4 * 4


def _floats(raw: bytes, at: int) -> tuple[NDArray[np.float32], int]:
    (length,) = _LENGTH.unpack_from(raw, at)
    at += _LENGTH.size
    return np.frombuffer(raw, '<f4', length, at), at + 4 * length
