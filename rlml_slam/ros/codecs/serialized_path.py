# SPDX-License-Identifier: Apache-2.0
"""A nav_msgs/Path as the bytes that go over the wire: hours of poses in a few milliseconds.

As objects, each pose of the path would be made, and made into bytes, by itself: a second for every
hour of driving, again and again. The layout is CDR (OMG CDR 1.0, little-endian), in which a number
lies at a multiple of its size, counted from behind the encapsulation.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array

LITTLE_ENDIAN = b'\x00\x01\x00\x00'  # the encapsulation
SECOND = 1_000_000_000


def serialized_path(stamp: int, frame_id: str, stamps: NDArray[np.int64], poses: Array) -> bytes:
    """Path of poses (n, 3) with their stamps (n,) [ns], serialized."""
    name = frame_id.encode() + b'\0'
    text = struct.pack('<I', len(name)) + name

    def header(of: int) -> bytes:
        return struct.pack('<iI', *divmod(int(of), SECOND)) + text

    first = _padded(header(stamp), 4) + struct.pack('<I', len(poses))
    if not len(poses):
        return LITTLE_ENDIAN + first
    # a row: the numbers of one pose, and the header of the next, behind which numbers begin again
    text = _padded(text, 8)
    row = np.dtype(
        [
            ('position', '<f8', (3,)), ('orientation', '<f8', (4,)),
            ('sec', '<i4'), ('nanosec', '<u4'), ('frame_id', f'V{len(text)}'),
        ]
    )  # fmt: skip
    rows = np.zeros(len(poses), dtype=row)
    rows['position'][:, :2] = poses[:, :2]
    rows['orientation'][:, 2] = np.sin(0.5 * poses[:, 2])
    rows['orientation'][:, 3] = np.cos(0.5 * poses[:, 2])
    rows['sec'][:-1], rows['nanosec'][:-1] = np.divmod(stamps[1:], SECOND)
    rows['frame_id'] = np.void(text)
    first = _padded(first + header(stamps[0]), 8)
    return LITTLE_ENDIAN + first + rows.tobytes()[: -8 - len(text)]


def _padded(data: bytes, size: int) -> bytes:
    return data + bytes(-len(data) % size)
