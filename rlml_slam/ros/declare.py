# SPDX-License-Identifier: Apache-2.0
"""Declare the parameters of rlml_slam.params as ROS parameters, and read their values.

rclpy ignores names in a YAML file that nobody declares, and refuses a whole number where a
fraction is expected. Here an unknown name is warned about and numbers are numbers. Live parameters
may be set while the node runs, all others while it is unconfigured; the answer says so.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.parameter import Parameter

from rlml_slam.errors import FileFormatError, RlmlError
from rlml_slam.params import (
    NODES,
    ROS_OWN,
    Declaration,
    Parameters,
    declarations,
    from_mapping,
    read_yaml,
)

Check = Callable[[Any], object]
SHORT = 1_000_000  # [ns] shortest period of a timer


def declare(
    node: Any, of: type[Any] = Parameters, checks: Mapping[str, Check] | None = None
) -> Any:
    """Declare every parameter of ``of`` on the node; the values given to it, checked.

    Live ones change in the groups that are returned. ``checks``: by name, what is called with a
    new value before it is taken, and raises RlmlError against it.

    Raises ParameterError for a value that its field refuses. A name that no node of this package
    knows is warned about: one YAML file may serve them all.
    """
    known = {d.name: d for d in declarations(of)}
    given = {n: _word(known.get(n), p.value) for n, p in node._parameter_overrides.items()}
    parameters = from_mapping({n: v for n, v in given.items() if n in known}, of)
    everywhere = [d.name for other in NODES for d in declarations(other)]
    for name in sorted(given.keys() - set(everywhere)):
        if not name.startswith(ROS_OWN):
            near = difflib.get_close_matches(name, known, n=1)
            hint = f'is {near[0]!r} meant?' if near else '--help lists those that have one'
            node.get_logger().warning(f'unknown parameter {name!r} has no effect; {hint}')
    _warn_of_files(node, of)
    for d in known.values():
        value = getattr(getattr(parameters, d.group), d.field)
        node.declare_parameter(d.name, _ros_value(value), descriptor(d), ignore_override=True)
    node.add_on_set_parameters_callback(
        lambda given: _change(node, parameters, known, given, {} if checks is None else checks)
    )
    return parameters


def _word(d: Declaration | None, value: Any) -> Any:
    """The value as it was written: YAML takes on and off for booleans."""
    is_word = d is not None and isinstance(value, bool) and 'on' in d.choices
    return ('off', 'on')[value] if is_word else value


def _warn_of_files(node: Any, of: type[Any]) -> None:
    """Name parameter files of the command line without a section for this node: ROS does not."""
    for word, file in pairwise(sys.argv):
        if word == '--params-file' and node.get_name() in NODES[of]:
            try:
                read_yaml(file, of)
            except FileFormatError as e:
                if 'no section for' in str(e):  # ROS may well read what is refused otherwise
                    node.get_logger().warning(f'{e}: this file has no effect here')


def _change(
    node: Any,
    parameters: Any,
    known: Mapping[str, Declaration],
    given: list[Any],
    checks: Mapping[str, Check],
) -> SetParametersResult:
    """Take new values of live parameters, or none and say why."""
    before, is_running = [], getattr(node, 'is_configured', True)
    try:
        for p in given:
            d = known.get(p.name)
            if d is None or _is_same(node.get_parameter(p.name).value, p.value):
                continue  # rclpy's own, and what `ros2 param load` gives as it is
            group = getattr(parameters, d.group)
            before.append((group, d, getattr(group, d.field)))
            group.change(d.field, p.value, is_running)
        for p in given:  # some act on it: only once all are known to be right
            checks.get(p.name, lambda _: None)(p.value)
    except RlmlError as e:
        for group, d, value in before:
            object.__setattr__(group, d.field, value)
            with contextlib.suppress(RlmlError):
                checks.get(d.name, lambda _: None)(value)
        return SetParametersResult(successful=False, reason=str(e))
    for group, d, value in before:
        node.get_logger().info(f'{d.field}: {value} is now {getattr(group, d.field)}')
    return SetParametersResult(successful=True)


def _is_same(value: Any, given: Any) -> bool:
    """Whether two values of a parameter are equal; a list comes as an array over the wire."""
    if isinstance(value, str) or not isinstance(value, Sequence | array):
        return bool(value == given)
    return isinstance(given, Sequence | array) and list(value) == list(given)


def pace(timer: Any) -> Check:
    """What gives a timer another period [s]."""
    return lambda seconds: setattr(
        timer, 'timer_period_ns', max(int(1e9 * (seconds or 0.1)), SHORT)
    )


def _ros_value(value: Any) -> Any:
    """Lists as lists; an empty one by its type, which rclpy cannot guess."""
    if value == ():
        return Parameter.Type.DOUBLE_ARRAY
    return list(value) if isinstance(value, tuple) else value


def descriptor(d: Declaration) -> ParameterDescriptor:
    """Description with unit, choices and range.

    None is read-only for ROS, which would refuse a new value without a reason.
    """
    unit = f' [{d.unit}]' if d.unit else ''
    out = ParameterDescriptor(
        description=d.meaning + unit,
        additional_constraints='; '.join(
            [f'one of {", ".join(d.choices)}'] * bool(d.choices)
            + ['read when the node starts'] * (not d.live)
        ),
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
