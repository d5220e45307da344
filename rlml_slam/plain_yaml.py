# SPDX-License-Identifier: Apache-2.0
"""YAML without aliases, whose cost is bounded by the size of its text."""

from __future__ import annotations

import re
from typing import Any

import yaml

from rlml_slam.errors import FileFormatError

MAX_CHARACTERS = 1 << 20
MAX_EVENTS = 50_000  # values, beginnings and ends: 0.5 s with libyaml
MAX_DEPTH = 50  # lists and mappings in each other
MAX_SCALAR = 10_000  # characters of a value: 1:1:1... is a number to the base of 60


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """8e-5 is a number, as in YAML 1.2 and ROS; without libyaml it is slower."""


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$'),
    '-+.0123456789',
)


def _check(text: str) -> None:
    """ValueError for aliases: ten lines with nine each stand for a thousand million values.

    Also for too many values, too long ones, and too many in each other.
    """
    depth = 0
    for count, event in enumerate(yaml.parse(text, _Loader)):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f'an alias is not allowed here: line {event.start_mark.line + 1}')
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH or count > MAX_EVENTS:
            raise ValueError(f'more than {MAX_DEPTH} levels or {MAX_EVENTS} events')
        if len(getattr(event, 'value', '')) > MAX_SCALAR:
            raise ValueError(f'a value of more than {MAX_SCALAR} characters')


def parse_yaml(text: str, source: str) -> Any:
    """The value of a YAML text; FileFormatError names its ``source``."""
    if len(text) > MAX_CHARACTERS:
        raise FileFormatError(f'{source}: {len(text)} characters, more than {MAX_CHARACTERS}')
    try:
        _check(text)
        return yaml.load(text, _Loader)
    # some values (the 99th of a month) are errors of Python's own
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as e:
        reason = (str(e).splitlines() or [type(e).__name__])[0]
        if isinstance(e, yaml.MarkedYAMLError) and e.problem_mark is not None:
            reason = f'line {e.problem_mark.line + 1}: {e.problem}'
        raise FileFormatError(f'{source}: not YAML: {reason}') from e
