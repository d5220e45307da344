# SPDX-License-Identifier: Apache-2.0
"""Reads a world file (YAML); anything unexpected in it is refused with the place where it is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.errors import FileFormatError
from rlml_slam.plain_yaml import parse_yaml
from rlml_slam.se2 import Array
from rlml_slam.simulation.world import (
    NO_REFLECTOR,
    Geometry,
    Mover,
    ReflectorSet,
    World,
    box_corners,
)

WORLDS = resources.files('rlml_slam.simulation') / 'worlds'
MATT_REFLECTANCE = 0.6
WORLD_KEYS = ('description', 'start', 'route', 'walls', 'boxes', 'pillars', 'reflectors', 'movers')


def world_names() -> list[str]:
    """Names of the worlds that come with the package."""
    return sorted(p.name[:-5] for p in WORLDS.iterdir() if p.name.endswith('.yaml'))


def load_world(name_or_path: str | Path) -> World:
    """A world of the package by name, or any world file by its path (``*.yaml``).

    Raises FileFormatError that names file, place and what is wrong.
    """
    text = str(name_or_path)
    if text in world_names():
        return parse_world((WORLDS / f'{text}.yaml').read_text(encoding='utf-8'), text)
    path = Path(name_or_path)
    if path.suffix not in ('.yaml', '.yml'):
        known = ', '.join(world_names())
        raise FileFormatError(f'{text}: no such world; there are {known}, or give a .yaml file')
    try:
        return parse_world(path.read_text(encoding='utf-8'), path.stem, text)
    except (OSError, UnicodeDecodeError) as e:
        reason = e.strerror if isinstance(e, OSError) else 'not UTF-8'
        raise FileFormatError(f'{path}: cannot be read: {reason}') from e


def parse_world(text: str, name: str, source: str = '') -> World:
    """A world from the text of its file; ``source`` is what errors call the file."""
    source = source or f'world {name!r}'
    root = _Place(parse_yaml(text, source), source)
    root.allow(*WORLD_KEYS)
    static = _static(root)
    return World(
        name,
        root.text('description', ''),
        static,
        _reflectors(root),
        tuple(_mover(p) for p in root.items('movers')),
        root.vector('start', 3),
        root.points('route', 1),
    )


class _Place:
    """A mapping in the file that knows where it is, for errors that name the place."""

    def __init__(self, tree: Any, where: str) -> None:
        if not isinstance(tree, Mapping):
            raise FileFormatError(f'{where}: is not a mapping')
        self.tree = tree
        self.where = where

    def refuse(self, key: str, why: str) -> FileFormatError:
        return FileFormatError(f'{self.where}: {key} {why}')

    def allow(self, *keys: str) -> None:
        for key in self.tree:
            if key not in keys:
                raise self.refuse(repr(key), f'is unknown; known are {", ".join(keys)}')

    def items(self, key: str) -> list[_Place]:
        value = self.tree.get(key, [])
        if not isinstance(value, list):
            raise self.refuse(key, 'is not a list')
        return [_Place(v, f'{self.where}: {key}[{k}]') for k, v in enumerate(value)]

    def text(self, key: str, default: str, choices: tuple[str, ...] = ()) -> str:
        value = self.tree.get(key, default)
        if not isinstance(value, str):
            raise self.refuse(key, f'= {value!r} is not text')
        if choices and value not in choices:
            raise self.refuse(key, f'= {value!r} is none of {", ".join(choices)}')
        return value

    def flag(self, key: str) -> bool:
        value = self.tree.get(key, False)
        if not isinstance(value, bool):
            raise self.refuse(key, f'= {value!r} is not true or false')
        return value

    def number(self, key: str, low: float, high: float, default: float | None = None) -> float:
        value = self.tree.get(key, default)
        if value is None:
            raise self.refuse(key, 'is missing')
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(key, f'= {value!r} is not a number')
        if not low <= value <= high:
            shown = f'= {value:g}' if abs(value) < 1e300 else ''  # of any length
            raise self.refuse(key, f'{shown} is outside [{low:g}, {high:g}]'.strip())
        return float(value)

    def array(self, key: str, shape: tuple[int, ...]) -> Array:
        """Finite numbers; -1 in ``shape`` stands for any length."""
        if key not in self.tree:
            raise self.refuse(key, 'is missing')
        try:
            value = np.array(self.tree[key], dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as e:
            raise self.refuse(key, 'is not an array of numbers') from e
        fits = value.ndim == len(shape) and all(
            want in (-1, have) for want, have in zip(shape, value.shape, strict=True)
        )
        if not fits or not np.isfinite(value).all():
            wanted = ' x '.join('n' if n < 0 else str(n) for n in shape)
            raise self.refuse(key, f'is not {wanted} finite numbers')
        return value

    def vector(self, key: str, n: int) -> Array:
        return self.array(key, (n,))

    def points(self, key: str, least: int) -> Array:
        value = self.array(key, (-1, 2))
        if len(value) < least:
            raise self.refuse(key, f'has fewer than {least} points')
        steps = np.diff(value, axis=0)
        if (np.hypot(steps[:, 0], steps[:, 1]) < 1e-6).any():
            raise self.refuse(key, 'has the same point twice in a row')
        return value


def _material(place: _Place) -> list[float]:
    """One row of the surface table."""
    gloss = 0.8 if place.flag('glossy') else 0.0
    return [place.number('reflectance', 0.0, 1.0, MATT_REFLECTANCE), gloss, 0.0, NO_REFLECTOR]


def _static(root: _Place) -> Geometry:
    """Walls (polylines), boxes and pillars."""
    segments: list[list[float]] = []
    discs: list[list[float]] = []
    rows: list[list[float]] = []
    for place in root.items('walls'):
        place.allow('points', 'closed', 'reflectance', 'glossy')
        p = place.points('points', 2)
        p = np.concatenate([p, p[:1]]) if place.flag('closed') else p
        segments += [[*a, *b, 0.0, 0.0] for a, b in itertools.pairwise(p)]
        rows += [_material(place)] * (len(p) - 1)
    for place in root.items('boxes'):
        place.allow('at', 'size', 'yaw', 'reflectance', 'glossy')
        yaw = place.number('yaw', -7.0, 7.0, 0.0)
        corners = box_corners(np.array([*place.vector('at', 2), yaw]), _size(place))
        ends = np.roll(corners, -1, axis=0)
        segments += [[*a, *b, 0.0, 0.0] for a, b in zip(corners, ends, strict=True)]
        rows += [_material(place)] * 4
    for place in root.items('pillars'):
        place.allow('at', 'diameter', 'reflectance')
        radius = 0.5 * place.number('diameter', 0.01, 10.0)
        discs.append([*place.vector('at', 2), radius, 0.0, 0.0])
        rows.append(_material(place))
    return Geometry(
        np.array(segments).reshape(-1, 6),
        np.array(discs).reshape(-1, 5),
        np.array(rows).reshape(-1, 4),
    )


def _size(place: _Place) -> tuple[float, float]:
    length, width = place.vector('size', 2)
    if not (length > 0.0 and width > 0.0):
        raise place.refuse('size', 'is not positive')
    return float(length), float(width)


def _reflectors(root: _Place) -> ReflectorSet:
    """Cylinders (``diameter``) and flat ones (``width`` and ``normal``)."""
    points, widths, normals, ids = [], [], [], []
    for k, place in enumerate(root.items('reflectors')):
        place.allow('at', 'diameter', 'width', 'normal', 'id')
        points.append(place.vector('at', 2))
        if ('diameter' in place.tree) == ('width' in place.tree):
            raise place.refuse('diameter', 'or else width (of a flat one) is needed')
        if 'width' in place.tree:
            normal = place.vector('normal', 2)
            if not normal.any():
                raise place.refuse('normal', 'is zero')
            widths.append(place.number('width', 0.005, 5.0))
            normals.append(math.atan2(normal[1], normal[0]))
        else:
            widths.append(place.number('diameter', 0.005, 5.0))
            normals.append(math.nan)
        ids.append(int(place.number('id', 0, 2**31 - 1, float(k))))
        if ids[-1] in ids[:-1]:
            raise place.refuse('id', f'= {ids[-1]} is used twice')
    return ReflectorSet(
        np.array(points).reshape(-1, 2),
        np.array(widths),
        np.array(normals),
        np.array(ids, dtype=np.int64),
    )


def _mover(place: _Place) -> Mover:
    place.allow('shape', 'diameter', 'size', 'route', 'speed', 'start', 'reflectance')
    shape = place.text('shape', 'disc', ('disc', 'box'))
    if shape == 'disc':
        diameter = place.number('diameter', 0.01, 10.0)
        size = (diameter, diameter)
    else:
        size = _size(place)
    route = place.points('route', 2)
    if np.hypot(*(route[0] - route[-1])) < 1e-6:
        raise place.refuse('route', 'closes by itself; leave the last point out')
    return Mover(
        shape,
        size,
        route,
        place.number('speed', 0.0, 10.0),
        place.number('start', 0.0, 1e6, 0.0),
        place.number('reflectance', 0.0, 1.0, MATT_REFLECTANCE),
    )
