# SPDX-License-Identifier: Apache-2.0
"""``--help`` of an executable, and what its words may be."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from rclpy._rclpy_pybind11 import UnknownROSArgsError
from rclpy.utilities import remove_ros_args

from rlml_slam.params import NODES, Parameters, declarations
from rlml_slam.version import __version__


def answered(factory: Callable[[], Any], argv: Sequence[str]) -> int | None:
    """Exit code where the words asked for help or are wrong; None where the node is to run."""
    name = Path(inspect.getsourcefile(factory) or 'node').stem
    if {'-h', '--help'} & set(argv[1:]):  # after --ros-args as well
        print(help_text(name, inspect.getmodule(factory).__doc__ or ''))
        return 0
    for option, value in pairwise(argv):
        if option in ('-p', '--param') and ':=' not in value:
            print(f'{name}: -p {value}: a parameter is given as NAME:=VALUE', file=sys.stderr)
            return 2
    try:
        words = remove_ros_args(list(argv))[1:]
    except UnknownROSArgsError as e:  # whose text is the list of them
        words = ast.literal_eval(str(e))
    if not words:
        return None
    if '--version' in words:
        print(f'rlml_slam {__version__}')
        return 0
    print(
        f'{name}: what is {words[0]!r}? Parameters follow --ros-args, as in\n'
        f'  {name} --ros-args -p use_imu:=false --params-file my.yaml -r scan:=front/scan\n'
        f'{name} --help lists them',
        file=sys.stderr,
    )
    return 2


def help_text(name: str, about: str) -> str:
    """What the executable is for, how it is called, and its parameters with their defaults."""
    of = next((s for s, names in NODES.items() if name in names), Parameters)
    lines = [
        f'usage: {name} [--help] [--version] [--ros-args [-p NAME:=VALUE] [--params-file FILE] '
        '[-r FROM:=TO]]',
        '', about.strip(), '', 'parameters (* may change while it runs):',
    ]  # fmt: skip
    for d in declarations(of):
        unit = f' [{d.unit}]' if d.unit else ''
        choices = f' ({", ".join(d.choices)})' if d.choices else ''
        default = list(d.default) if isinstance(d.default, tuple) else d.default
        lines.append(f'  {d.name}{"*" * d.live} = {default}{unit}')
        lines.append(f'      {d.meaning}{choices}')
    return '\n'.join(lines)
