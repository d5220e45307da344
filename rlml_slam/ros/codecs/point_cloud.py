# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 as a NumPy structured array, both ways."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs.message_types import Make

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
    fields = tuple((f.name, int(f.offset), int(f.datatype), int(f.count)) for f in msg.fields)
    for name, _, datatype, _ in fields:
        if datatype not in _DATATYPES:
            raise InputError(f'{topic}: field {name!r} has the unknown datatype {datatype}')
    try:
        return _layout(fields, int(msg.point_step), bool(msg.is_bigendian))
    except ValueError as e:
        raise InputError(f'{topic}: fields do not fit point_step {msg.point_step}: {e}') from e


@lru_cache(maxsize=64)
def _layout(
    fields: tuple[tuple[str, int, int, int], ...], point_step: int, is_bigendian: bool
) -> np.dtype[np.void]:
    """A topic's layout is the same in every message, and numpy takes long to make one."""
    order = '>' if is_bigendian else '<'
    codes = [np.dtype(order + _DATATYPES[datatype]) for _, _, datatype, _ in fields]
    layout = {
        'names': [name for name, *_ in fields],
        'formats': [
            code if count <= 1 else (code, (count,))
            for code, (*_, count) in zip(codes, fields, strict=True)
        ],
        'offsets': [offset for _, offset, *_ in fields],
        'itemsize': point_step,
    }
    return np.dtype(layout)  # type: ignore[call-overload]


def column(points: NDArray[np.void], name: str, absent: float) -> NDArray[np.float64]:
    """One field (n,) as float64, ``absent`` everywhere if the cloud has no such field."""
    if name not in (points.dtype.names or ()):
        return np.full(len(points), absent)
    return points[name].astype(np.float64)


def build_cloud(make: Make, header: Any, points: NDArray[np.void]) -> Any:
    """A dense PointCloud2 of one row from a structured array (n,)."""
    packed = np.ascontiguousarray(points)
    return make(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=1,
        width=len(packed),
        fields=_fields(make, packed.dtype),
        is_bigendian=False,
        point_step=packed.dtype.itemsize,
        row_step=packed.dtype.itemsize * len(packed),
        data=packed.view(np.uint8).reshape(-1),
        is_dense=True,
    )


@lru_cache(maxsize=64)
def _fields(make: Make, dtype: np.dtype[np.void]) -> list[Any]:
    out = []
    for name in dtype.names or ():
        kind, offset = dtype.fields[name][:2]  # type: ignore[index]
        out.append(
            make(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=int(offset),
                datatype=_NUMBERS[kind.base.str[1:]],
                count=int(np.prod(kind.shape)),
            )
        )
    return out
