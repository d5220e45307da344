# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 as a NumPy structured array, both ways."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.ros.messages import Make

# sensor_msgs/PointField: the constants INT8 = 1 .. FLOAT64 = 8
_DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_NUMBERS = {code: number for number, code in _DATATYPES.items()}


def read_cloud(msg: Any, topic: str = 'cloud') -> NDArray[np.void]:
    """The points (n,) with the cloud's own field names; row padding is skipped.

    Raises InputError if the layout contradicts itself.
    """
    dtype = _dtype(msg, topic)
    data = np.frombuffer(memoryview(msg.data), dtype=np.uint8)
    used = msg.width * msg.point_step
    row = msg.row_step or used
    if row < used or len(data) < (msg.height - 1) * row + used * (msg.height > 0):
        raise InputError(
            f'{topic}: {len(data)} bytes of data do not hold {msg.height} x {msg.width} points '
            f'of {msg.point_step} bytes in rows of {msg.row_step}'
        )
    if msg.width * msg.height == 0:
        return np.zeros(0, dtype)
    rows = [data[k * row : k * row + used] for k in range(msg.height)]
    return np.concatenate(rows).view(dtype)


def _dtype(msg: Any, topic: str) -> np.dtype[np.void]:
    order = '>' if msg.is_bigendian else '<'
    names, formats, offsets = [], [], []
    for f in msg.fields:
        if f.datatype not in _DATATYPES:
            raise InputError(f'{topic}: field {f.name!r} has the unknown datatype {f.datatype}')
        code = order + _DATATYPES[f.datatype]
        names.append(f.name)
        formats.append(code if f.count <= 1 else f'({f.count},){code}')
        offsets.append(int(f.offset))
    layout = {
        'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': int(msg.point_step)
    }  # fmt: skip
    try:
        return np.dtype(layout)  # type: ignore[call-overload]
    except ValueError as e:
        raise InputError(f'{topic}: fields do not fit point_step {msg.point_step}: {e}') from e


def column(points: NDArray[np.void], name: str, absent: float) -> NDArray[np.float64]:
    """One field (n,) as float64, ``absent`` everywhere if the cloud has no such field."""
    if name not in (points.dtype.names or ()):
        return np.full(len(points), absent)
    return points[name].astype(np.float64)


def build_cloud(make: Make, header: Any, points: NDArray[np.void]) -> Any:
    """A dense PointCloud2 of one row from a structured array (n,)."""
    packed = np.ascontiguousarray(points)
    fields = []
    for name in packed.dtype.names or ():
        kind, offset = packed.dtype.fields[name][:2]  # type: ignore[index]
        fields.append(
            make(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=int(offset),
                datatype=_NUMBERS[kind.base.str[1:]],
                count=int(np.prod(kind.shape)),
            )
        )
    return make(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=1,
        width=len(packed),
        fields=fields,
        is_bigendian=False,
        point_step=packed.dtype.itemsize,
        row_step=packed.dtype.itemsize * len(packed),
        data=packed.view(np.uint8).reshape(-1),
        is_dense=True,
    )
