# SPDX-License-Identifier: Apache-2.0
"""How a parameter is declared: default, unit, bounds and meaning, checked at construction.

A group is a frozen dataclass of :func:`param` fields. A value outside of its declaration raises
ParameterError, which names the parameter, the value and the meaning.
"""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from rlml_slam.errors import ParameterError

INF = math.inf


def param(
    default: Any,
    meaning: str,
    unit: str = '',
    low: float = -INF,
    high: float = INF,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """A dataclass field with its meaning, unit, inclusive bounds and choices.

    One that is ``live`` may change while a node runs: it is read where it is used.
    """
    return field(
        default=default,
        metadata={
            'meaning': meaning, 'unit': unit, 'low': low, 'high': high, 'choices': choices,
            'live': live,
        },
    )  # fmt: skip


@dataclass(frozen=True)
class Group:
    """A set of parameters; construction checks every value.

    ``prefix`` starts their ROS names; by default it is the class name in snake case.
    """

    _prefix: ClassVar[str]

    def __init_subclass__(cls, prefix: str | None = None) -> None:
        """Store the prefix, so that errors give the ROS name of a parameter."""
        of_class = re.sub('(?<=[a-z])(?=[A-Z])', '_', cls.__name__).lower() + '.'
        cls._prefix = of_class if prefix is None else prefix

    def __post_init__(self) -> None:
        """Check each field against its declared type, bounds and choices."""
        for f in dataclasses.fields(self):
            object.__setattr__(self, f.name, _checked(self._prefix, f, getattr(self, f.name)))

    def change(self, name: str, value: Any, is_running: bool = True) -> None:
        """Give a parameter another value, for all that read it from now on.

        Raises ParameterError for a value outside of its declaration, and while the node is running
        for a parameter that is not live.
        """
        f = next(f for f in dataclasses.fields(self) if f.name == name)
        if is_running and not f.metadata['live']:
            raise ParameterError(
                f'{self._prefix}{name} is read when the node starts: '
                'restart it, or clean it up first'
            )
        object.__setattr__(self, name, _checked(self._prefix, f, value))


def _text(value: Any) -> str:
    try:
        return repr(value)
    except ValueError:  # Python prints no whole number of thousands of digits
        return 'a number that is too long to print'


def _checked(prefix: str, f: dataclasses.Field[Any], value: Any) -> Any:
    """The value converted to the type of the default; ParameterError if it is not allowed."""
    m = f.metadata

    def refuse(why: str) -> ParameterError:
        return ParameterError(f'{prefix}{f.name} = {_text(value)} {why} ({m["meaning"]})')

    if isinstance(f.default, bool):
        if not isinstance(value, bool):
            raise refuse('is not true or false')
        return value
    if isinstance(f.default, str):
        if not isinstance(value, str):
            raise refuse('is not a string')
        if m['choices'] and value not in m['choices']:
            raise refuse(f'is not one of {", ".join(m["choices"])}')
        if not f.name.endswith('_frame'):
            return value
        if not value.strip('/'):
            raise refuse('is no name of a frame')
        return value.lstrip('/')  # ROS 1 allowed a slash
    if isinstance(f.default, tuple):
        if isinstance(value, str) or not isinstance(value, list | tuple):
            raise refuse('is not a list')
        if f.default and isinstance(f.default[0], str):
            if not all(isinstance(v, str) for v in value):
                raise refuse('is not a list of strings')
            return tuple(value)
        if not all(map(_is_finite, value)):
            raise refuse('is not a list of finite numbers')
        if len(value) != len(f.default):
            raise refuse(f'is not a list of {len(f.default)} numbers')
        if not all(m['low'] <= v <= m['high'] for v in value):
            raise refuse(f'has a number outside [{m["low"]:g}, {m["high"]:g}]')
        return tuple(float(v) for v in value)
    if not _is_finite(value):
        raise refuse('is not a finite number')
    if isinstance(f.default, int):
        if int(value) != value:
            raise refuse('is not a whole number')
        value = int(value)
    else:
        value = float(value)
    if not m['low'] <= value <= m['high']:
        raise refuse(f'is outside [{m["low"]:g}, {m["high"]:g}]')
    return value


def _is_finite(value: Any) -> bool:
    """Whether it is a number that a float can be; whole numbers have no end."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= sys.float_info.max


@dataclass(frozen=True)
class Declaration:
    """One parameter under its ROS name."""

    name: str
    group: str
    field: str
    default: Any
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]
    meaning: str
    live: bool


def declarations(of: type[Any]) -> Iterator[Declaration]:
    """All parameters of the groups of the set ``of``, in order of declaration."""
    for g in dataclasses.fields(of):
        prefix = '' if g.name == 'node' else f'{g.name}.'
        group: Any = g.default_factory
        for f in dataclasses.fields(group):
            yield Declaration(
                prefix + f.name,
                g.name,
                f.name,
                f.default,
                *(f.metadata[k] for k in ('unit', 'low', 'high', 'choices', 'meaning', 'live')),
            )


def changed(params: Any) -> dict[str, Any]:
    """The parameters of a set that differ from their defaults, by ROS name."""
    values = {
        d.name: (getattr(getattr(params, d.group), d.field), d.default)
        for d in declarations(type(params))
    }
    return {name: value for name, (value, default) in values.items() if value != default}
