# SPDX-License-Identifier: Apache-2.0
"""Checks of measurements that scripts make: stamps are whole numbers, values are arrays."""

from __future__ import annotations

import operator
from dataclasses import fields, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.types import Detections, Imu, Odometry, Scan

LAST_STAMP = 2**63 - 1  # [ns]
Measurement: TypeAlias = Odometry | Imu | Scan | Detections

# kind and shape of each field that is an array; n is the length of the first one
ARRAYS: dict[type, dict[str, tuple[Any, tuple[int | str, ...]]]] = {
    Odometry: {'pose': (np.float64, (3,))},
    Imu: {'yaw_rate': (np.float64, ())},
    Scan: {'ranges': (np.float32, ('n',)), 'intensities': (np.float32, ('any',))},
    Detections: {
        'points': (np.float64, ('n', 2)),
        'cov': (np.float64, ('n', 2, 2)),
        'ids': (np.int64, ('n',)),
        'diameters': (np.float64, ('n',)),
    },
}


def checked(measurement: Measurement) -> Measurement:
    """The measurement with its stamp as int and its values as arrays.

    Raises InputError, with the name of the field, where that is not possible.
    """
    name = type(measurement).__name__
    if type(measurement) not in ARRAYS:
        raise InputError(
            f'{name} is no measurement; use Odometry, Imu, Scan or Detections of rlml_slam.types'
        )
    try:
        changes: dict[str, Any] = {'stamp': operator.index(measurement.stamp)}
    except TypeError:
        raise InputError(f'{name}.stamp: {measurement.stamp!r} is no whole number of ns') from None
    if abs(changes['stamp']) > LAST_STAMP:
        raise InputError(f'{name}.stamp: {measurement.stamp} ns is no time')
    n: int | None = None
    for field, (kind, shape) in ARRAYS[type(measurement)].items():
        array = _array(f'{name}.{field}', getattr(measurement, field), kind)
        if n is None and array.ndim:
            n = len(array)
        wanted = tuple({'n': n or 0, 'any': array.size}.get(str(s), s) for s in shape)
        if array.shape != wanted:
            raise InputError(f'{name}.{field}: its shape is {array.shape} instead of {wanted}')
        changes[field] = array if shape else float(array)
    for f in fields(measurement):
        if f.type == 'float' and f.name not in changes:
            changes[f.name] = float(_array(f'{name}.{f.name}', getattr(measurement, f.name)))
        elif f.type == 'str' and not isinstance(getattr(measurement, f.name), str):
            raise InputError(f'{name}.{f.name}: {getattr(measurement, f.name)!r} is no text')
    return replace(measurement, **changes)


def _array(name: str, value: Any, kind: Any = np.float64) -> NDArray[Any]:
    """The value as an array of a kind; InputError where that would change it."""
    try:
        given = np.asarray(value)
        if given.dtype.kind not in 'biuf':
            raise ValueError
        with np.errstate(invalid='ignore', over='ignore'):
            array = given.astype(kind)
        if kind is np.int64 and not (array == given).all():
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        text = 'whole numbers' if kind is np.int64 else 'numbers'
        raise InputError(f'{name}: {value!r:.60} is not of {text}') from None
    return np.asarray(array)
