# SPDX-License-Identifier: Apache-2.0
"""Checks of measurements that scripts make: stamps are whole numbers, values are arrays."""

from __future__ import annotations

import operator
from dataclasses import fields, replace
from typing import Any, TypeAlias

import numpy as np

from rlml_slam.errors import InputError
from rlml_slam.types import Detections, Imu, Odometry, Scan

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
    n = -1
    for field, (kind, shape) in ARRAYS[type(measurement)].items():
        value = getattr(measurement, field)
        try:
            array = np.asarray(value, dtype=kind)
        except (TypeError, ValueError):
            raise InputError(f'{name}.{field}: {value!r:.60} is not of numbers') from None
        n = len(array) if n < 0 and array.ndim else n
        wanted = tuple(n if s == 'n' else array.size if s == 'any' else s for s in shape)
        if array.shape != wanted:
            raise InputError(f'{name}.{field}: its shape is {array.shape} instead of {wanted}')
        changes[field] = array if shape else float(array)
    same = all(changes.get(f.name) is getattr(measurement, f.name) for f in fields(measurement)
               if f.name in changes)  # fmt: skip
    return measurement if same else replace(measurement, **changes)
