# SPDX-License-Identifier: Apache-2.0
"""Declare the parameters of rlml_slam.params as ROS parameters, and read their values.

rclpy ignores names in a YAML file that nobody declares, and refuses a whole number where a
fraction is expected. Here an unknown name is warned about and numbers are numbers.
"""

from __future__ import annotations

import difflib
import math
import sys
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.parameter import Parameter

from rlml_slam.params import (
    NODES,
    ROS_OWN,
    Declaration,
    Parameters,
    declarations,
    from_mapping,
)


def declare(node: Any, of: type[Any] = Parameters) -> Any:
    """Declare every parameter of ``of`` on the node; the values given to it, checked.

    Raises ParameterError for a value that its field refuses. A name that no node of this package
    knows is warned about: one YAML file may serve them all.
    """
    given = {name: p.value for name, p in node._parameter_overrides.items()}
    known = {d.name: d for d in declarations(of)}
    parameters = from_mapping({n: v for n, v in given.items() if n in known}, of)
    everywhere = [d.name for other in NODES for d in declarations(other)]
    for name in sorted(given.keys() - set(everywhere)):
        if not name.startswith(ROS_OWN):
            near = difflib.get_close_matches(name, known, n=1)
            hint = f'; is {near[0]!r} meant?' if near else ''
            node.get_logger().warning(f'unknown parameter {name!r} has no effect{hint}')
    for d in known.values():
        value = getattr(getattr(parameters, d.group), d.field)
        node.declare_parameter(d.name, _ros_value(value), descriptor(d), ignore_override=True)
    return parameters


def _ros_value(value: Any) -> Any:
    """Lists as lists; an empty one by its type, which rclpy cannot guess."""
    if value == ():
        return Parameter.Type.DOUBLE_ARRAY
    return list(value) if isinstance(value, tuple) else value


def descriptor(d: Declaration) -> ParameterDescriptor:
    """Description with unit, choices and range; values are fixed when the node starts."""
    unit = f' [{d.unit}]' if d.unit else ''
    out = ParameterDescriptor(
        description=d.meaning + unit,
        additional_constraints=f'one of {", ".join(d.choices)}' if d.choices else '',
        read_only=True,
    )
    if math.isinf(d.low) and math.isinf(d.high):
        return out
    if isinstance(d.default, int) and not isinstance(d.default, bool):
        start = -(2**63) if math.isinf(d.low) else int(d.low)
        end = 2**63 - 1 if math.isinf(d.high) else int(d.high)
        out.integer_range = [IntegerRange(from_value=start, to_value=end)]
    elif isinstance(d.default, float):
        most = sys.float_info.max
        bounds = FloatingPointRange(from_value=max(d.low, -most), to_value=min(d.high, most))
        out.floating_point_range = [bounds]
    return out
