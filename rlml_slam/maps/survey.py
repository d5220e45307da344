# SPDX-License-Identifier: Apache-2.0
"""Surveyed reflectors: where somebody measured them to be, in the frame of the plant.

By the suffix of the file's name:

    .csv    columns ``x`` and ``y`` [m], and if need be ``id`` and ``diameter`` [m], between
            commas, semicolons, tabs or blanks, by the names of COLUMNS or without a header
    .json   a list of objects with the same names
    .imk    layout of a SICK NAV scanner: ``globID x y type subtype size layer…`` [mm] per line
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS

MM = 1e-3
FARTHEST = 1e7  # [m]
WIDEST = 2.0  # [m], below which a diameter is
# what a survey's column may be called, in small letters and without the unit [m]
COLUMNS = {
    'id': ('id', 'nr', 'no', 'number', 'global_id', 'globalid'),
    'x': ('x', 'east', 'easting', 'e', 'pos_x', 'x_map', 'position_x'),
    'y': ('y', 'north', 'northing', 'n', 'pos_y', 'y_map', 'position_y'),
    'diameter': ('diameter', 'd', 'size', 'width'),
}
IMK_FIELDS = 6  # before the layers


class Survey(NamedTuple):
    """``ids`` (n,) or ANONYMOUS, ``points`` (n, 2) and ``diameters`` (n,) or NaN."""

    ids: NDArray[np.int64]
    points: Array
    diameters: Array


def same(a: Survey, b: Survey) -> bool:
    """Whether two surveys say the same of where which reflector is."""
    return np.array_equal(a.ids, b.ids) and np.array_equal(a.points, b.points)


def load(path: str | Path) -> Survey:
    """Read a survey. Raises MapError if there is none, FileFormatError saying what is wrong."""
    path = Path(path)
    try:
        text = path.read_text(encoding='utf-8-sig')
    except OSError as e:
        raise MapError(f'{path}: cannot be read: {e.strerror}') from e
    except UnicodeDecodeError as e:
        raise FileFormatError(f'{path}: not text') from e
    readers = {'.csv': _csv, '.json': _json, '.imk': _imk}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FileFormatError(f'{path}: a survey is one of {", ".join(readers)}')
    try:
        rows = [_checked(where, row) for where, row in reader(text)]
    except (ValueError, TypeError, KeyError, RecursionError, csv.Error) as e:
        raise FileFormatError(f'{path}: {e}') from e
    if not rows:
        raise FileFormatError(f'{path}: no reflector in it')
    values = np.array(rows)
    ids = values[:, 0].astype(np.int64)
    known = ids[ids != ANONYMOUS]
    if len(np.unique(known)) != len(known):
        raise FileFormatError(f'{path}: two reflectors have the same id')
    return Survey(ids, values[:, 1:3].copy(), values[:, 3].copy())


def _checked(where: str, row: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """Id, x, y and diameter; ValueError says where one is wrong."""
    read: dict[str, Any] = {'id': ANONYMOUS, 'diameter': math.nan}
    for name, kind in (('id', int), ('x', float), ('y', float), ('diameter', float)):
        value = row.get(name)
        try:
            read[name] = read[name] if value in (None, '') else kind(value)
        except KeyError as e:
            raise ValueError(f'{where}: {name} is missing') from e
        except (ValueError, TypeError, OverflowError) as e:
            raise ValueError(f'{where}: {name} is no number: {str(value)[:50]}') from e
    id_, x, y, diameter = (read[name] for name in ('id', 'x', 'y', 'diameter'))
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST):
        raise ValueError(f'{where}: the place is not finite, or beyond {FARTHEST:g} m')
    diameter = diameter or math.nan  # 0: flat, or not known
    if not (math.isnan(diameter) or 0.0 < diameter < WIDEST):
        raise ValueError(f'{where}: a diameter of {diameter:g} m is not in (0, {WIDEST:g})')
    if abs(id_) >= 1 << 53:
        raise ValueError(f'{where}: {id_} is no id')
    return float(id_), x, y, diameter


def _csv(text: str) -> Iterable[tuple[str, Mapping[str, Any]]]:
    lines = [
        (number, line.rstrip().lstrip(' '))  # an empty first word may precede a tab
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith('#')
    ]
    if not lines:
        return
    separator = next((s for s in (';', '\t', ',') if s in lines[0][1]), None)
    rows = [(number, _words(line, separator)) for number, line in lines]
    if separator in (';', '\t'):  # then the comma may be that of decimals
        rows = [(number, [word.replace(',', '.') for word in words]) for number, words in rows]
    names, width = [_column(word) for word in rows[0][1]], len(rows[0][1])
    if _is_number(rows[0][1][-1]):
        names = _unnamed([words for _, words in rows])
    elif not {'x', 'y'} <= set(names):
        read = ', '.join(rows.pop(0)[1])
        raise ValueError(f'no columns of x and y; the header has {read}')
    elif twice := [name for name in COLUMNS if names.count(name) > 1]:
        read = ', '.join(rows[0][1])
        raise ValueError(f'more than one column of {twice[0]}; the header has {read}')
    else:
        rows = rows[1:]
    for number, words in rows:
        yield f'line {number}', _row(number, words, names, width)


def _words(line: str, separator: str | None) -> list[str]:
    """The words of a line, without quotes; a separator inside of them is part of the word."""
    text = line if separator else ' '.join(line.split())
    (words,) = csv.reader([text], delimiter=separator or ' ', skipinitialspace=True)
    return [word.strip() for word in words]


def _row(number: int, words: list[str], names: list[str], width: int) -> dict[str, str]:
    """Words by column; ValueError where they may be meant otherwise."""
    if any(words[width:]):
        raise ValueError(f'line {number}: {len(words)} values, {width} expected')
    row = dict(zip(names, words, strict=False))
    for name in COLUMNS:
        if ',' in row.get(name, ''):
            raise ValueError(f'line {number}: {row[name]}: write 1.5, or 1,5 between semicolons')
    return row


def _unnamed(rows: list[list[str]]) -> list[str]:
    """What the columns of a file without a header are: x y, id x y, or a name x y; maybe more."""
    first = [words[0] for words in rows]
    if len(rows[0]) < 3:
        return ['x', 'y']
    if all(word.lstrip('-').isdecimal() for word in first) and len(set(first)) == len(first):
        return ['id', 'x', 'y', 'diameter']
    return ['x', 'y'] if _is_number(first[0]) else ['name', 'x', 'y', 'diameter']


def _column(name: str) -> str:
    """What a column is, by its name, with its unit or without; the name itself otherwise."""
    plain = re.sub(r'[\s_\-]*[\[(]?\bm(eter|etre)?s?\b[\])]?$|_m$', '', name.strip().lower())
    plain = plain.strip(' _-')
    return next((column for column, names in COLUMNS.items() if plain in names), plain)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _json(text: str) -> Iterable[tuple[str, Mapping[str, Any]]]:
    for number, row in enumerate(json.loads(text), 1):
        if not isinstance(row, dict):
            raise ValueError(f'entry {number}: not an object')
        yield f'entry {number}', row


def _imk(text: str) -> Iterable[tuple[str, Mapping[str, Any]]]:
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith(('#', 'globID')):
            continue
        if len(words) < IMK_FIELDS:
            raise ValueError(f'line {number}: {len(words)} fields, {IMK_FIELDS} expected')
        id_, x, y, _, _, size = words[:IMK_FIELDS]
        yield f'line {number}', {
            'id': id_, 'x': MM * float(x), 'y': MM * float(y), 'diameter': MM * float(size)
        }  # fmt: skip
