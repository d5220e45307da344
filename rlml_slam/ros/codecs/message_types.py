# SPDX-License-Identifier: Apache-2.0
"""Message classes by name, so that one builder serves rclpy and rosbags (and neither is needed).

A ``Make`` turns a type name and all of its fields into a message. Arrays are given as NumPy arrays
of the field's element type; rclpy gets them as array.array, which it takes over without a loop.
"""

from __future__ import annotations

import array
import importlib
from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias

import numpy as np

Make: TypeAlias = Callable[..., Any]


@cache
def rclpy_class(msgtype: str) -> Any:
    """The Python class of a type such as ``sensor_msgs/msg/LaserScan``; None if not installed."""
    package, _, rest = msgtype.partition('/')
    kind, _, name = rest.rpartition('/')
    try:
        return getattr(importlib.import_module(f'{package}.{kind or "msg"}'), name, None)
    except ModuleNotFoundError:
        return None


@cache
def _sequences(msgtype: str) -> frozenset[str]:
    fields = rclpy_class(msgtype).get_fields_and_field_types()
    return frozenset(name for name, kind in fields.items() if kind.startswith('sequence'))


def make_rclpy(msgtype: str, **fields: Any) -> Any:
    """A message of the installed ROS 2."""
    for name in _sequences(msgtype) & fields.keys():
        value = fields[name]
        if isinstance(value, np.ndarray):
            fields[name] = array.array(value.dtype.char, value.tobytes())
    return rclpy_class(msgtype)(**fields)


@cache
def bag_types() -> Any:
    """The type store that bags are written with."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def make_bag(msgtype: str, **fields: Any) -> Any:
    """A message that a bag can be written from, without any ROS installed."""
    return bag_types().types[msgtype](**fields)
