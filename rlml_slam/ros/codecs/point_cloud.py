# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 as a NumPy structured array, both ways."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs.message_types import Make

# sensor_msgs/PointField: the constants INT8 = 1 .. FLOAT64 = 8
_DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
LARGEST = 1e7  # [m]: no place on a floor is that far from another
MAX_FIELDS = 100  # of a point
_NUMBERS = {code: number for number, code in _DATATYPES.items()}


def read_cloud(msg: Any, topic: str = 'cloud') -> NDArray[np.void]:
    """The points (n,) with the cloud's own field names; row padding is skipped.

    Raises InputError if the layout contradicts itself.
    """
    dtype = _dtype(msg, topic)
    data = np.frombuffer(memoryview(msg.data), dtype=np.uint8)
    rows, used = int(msg.height), int(msg.width) * int(msg.point_step)
    row = int(msg.row_step) or used
    if rows * int(msg.width) == 0:
        return np.zeros(0, dtype)
    if used == 0 or row < used or len(data) < (rows - 1) * row + used:
        raise InputError(
            f'{topic}: {len(data)} bytes of data do not hold {rows} x {msg.width} points '
            f'of {msg.point_step} bytes in rows of {msg.row_step}'
        )
    packed = np.lib.stride_tricks.as_strided(data, (rows, used), (row, 1), writeable=False)
    return np.ascontiguousarray(packed).reshape(-1).view(dtype)


def read_table(
    msg: Any, dtype: np.dtype[np.void], topic: str, one: bool = False
) -> NDArray[np.void]:
    """The points (n,) of a cloud of this package, which has the fields of ``dtype``.

    Raises InputError if it has others, or where it should have ``one`` point and has not.
    """
    cloud = read_cloud(msg, topic)
    check_fields(cloud, dtype, topic)
    if one and len(cloud) != 1:
        raise InputError(f'{topic}: {len(cloud)} points, not one')
    return cloud


def check_fields(cloud: NDArray[np.void], dtype: np.dtype[np.void], topic: str) -> None:
    """Raise InputError where a cloud has not all fields of ``dtype``, or of other types."""
    names = cloud.dtype.names or ()
    missing = [n for n in dtype.names or () if n not in names or cloud.dtype[n] != dtype[n]]
    if missing:
        raise InputError(f'{topic}: {len(cloud)} points; missing fields: {", ".join(missing)}')


def bounded(values: ArrayLike, where: str, largest: float = LARGEST) -> None:
    """Raise InputError where a value is not finite, or larger than any that makes sense."""
    if not (np.abs(values) <= largest).all():  # NaN as well
        raise InputError(f'{where} is not finite, or beyond {largest:.3g}')


def _dtype(msg: Any, topic: str) -> np.dtype[np.void]:
    if len(msg.fields) > MAX_FIELDS:
        raise InputError(f'{topic}: {len(msg.fields)} fields, more than {MAX_FIELDS}')
    fields = tuple((f.name, int(f.offset), int(f.datatype), int(f.count)) for f in msg.fields)
    for name, _, datatype, _ in fields:
        if datatype not in _DATATYPES:
            raise InputError(f'{topic}: field {name!r} has the unknown datatype {datatype}')
    try:
        return _layout(fields, int(msg.point_step), bool(msg.is_bigendian))
    except (ValueError, TypeError, OverflowError, MemoryError) as e:
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


def check_disjoint(points: NDArray[np.void], names: Iterable[str], topic: str) -> None:
    """Raise InputError where two of the fields share bytes; those that are absent are none."""
    fields: Mapping[str, tuple[Any, ...]] = points.dtype.fields or {}
    spans = sorted((fields[n][1], fields[n][0].itemsize, n) for n in names if n in fields)
    for (start, size, name), (after, _, other) in pairwise(spans):
        if start + size > after:
            raise InputError(f'{topic}: fields {name!r} and {other!r} overlap')


def column(points: NDArray[np.void], name: str, absent: float) -> NDArray[np.float64]:
    """One field (n,) as float64, ``absent`` everywhere if the cloud has no such field."""
    if name not in (points.dtype.names or ()):
        return np.full(len(points), absent)
    if points[name].ndim != 1:
        raise InputError(f'cloud: field {name!r} has several values in a point')
    with np.errstate(invalid='ignore'):  # of a NaN with a payload
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
