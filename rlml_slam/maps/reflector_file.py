# SPDX-License-Identifier: Apache-2.0
"""The reflector map as a table of comma-separated values, map frame."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.types import Reflectors

COLUMNS = (
    'key', 'id', 'x_m', 'y_m', 'cov_xx_m2', 'cov_xy_m2', 'cov_yy_m2', 'sightings', 'diameter_m'
)  # fmt: skip


LARGEST = 2.0**53  # of a key, an id, a count; no place is that far away


def reflector_table(r: Reflectors) -> str:
    """One row per reflector; an unknown diameter is left empty."""
    rows = [','.join(COLUMNS)]
    for k in range(len(r)):
        c = r.cov[k]
        diameter = f'{r.diameters[k]:.4f}' if np.isfinite(r.diameters[k]) else ''
        rows.append(
            f'{r.keys[k]},{r.ids[k]},{r.points[k, 0]:.6f},{r.points[k, 1]:.6f},'
            f'{c[0, 0]:.6e},{c[0, 1]:.6e},{c[1, 1]:.6e},{r.sightings[k]},{diameter}'
        )
    return '\n'.join(rows) + '\n'


def save(reflectors: Reflectors, path: str | Path) -> None:
    """Write the table, whole or not at all; raises MapError if it cannot be written."""
    write_atomically(Path(path), reflector_table(reflectors).encode())


def load(path: str | Path) -> Reflectors:
    """Read a table. Raises MapError if there is none, FileFormatError naming the line if bad."""
    try:
        text = Path(path).read_text(encoding='utf-8-sig')
    except OSError as e:
        raise MapError(f'{path}: cannot be read: {e.strerror}') from e
    except UnicodeDecodeError as e:
        raise FileFormatError(f'{path}: not text') from e
    lines = text.splitlines()
    if not lines or tuple(lines[0].split(',')) != COLUMNS:
        raise FileFormatError(f'{path}: line 1: not the columns of a reflector map')
    try:
        table = enumerate(csv.reader(lines[1:]), 2)
        rows = {k: _row(f'{path}: line {k}', row) for k, row in table if row}
    except csv.Error as e:
        raise FileFormatError(f'{path}: {e}') from e
    values = np.array(list(rows.values())).reshape(-1, len(COLUMNS))
    cov = values[:, [4, 5, 5, 6]].reshape(-1, 2, 2)
    if len(cov) and (np.linalg.eigvalsh(cov) < -1e-9).any():
        bad = list(rows)[int(np.argmax(np.linalg.eigvalsh(cov).min(-1) < -1e-9))]
        raise FileFormatError(f'{path}: line {bad}: covariance has a negative variance')
    return Reflectors(
        values[:, 0].astype(np.int64),
        values[:, 2:4].copy(),
        cov,
        values[:, 1].astype(np.int64),
        values[:, 7].astype(np.int64),
        values[:, 8].copy(),
    )


def _row(where: str, row: list[str]) -> list[float]:
    if len(row) != len(COLUMNS):
        raise FileFormatError(f'{where}: {len(row)} values instead of {len(COLUMNS)}')
    try:
        numbers = [float(v) for v in row[:-1]]
        diameter = float(row[-1]) if row[-1] else float('nan')
    except ValueError as e:
        raise FileFormatError(f'{where}: {e}') from e
    if not (np.abs(numbers) < LARGEST).all():
        raise FileFormatError(f'{where}: a value is not finite, or beyond {LARGEST:g}')
    return [*numbers, diameter]
