# SPDX-License-Identifier: Apache-2.0
"""The folder that a run was written into, read again: paths, health by scan, and figures."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.datasets.text_file import format_stamp, parse_stamp, read_lines
from rlml_slam.datasets.tum import Trajectory, read_tum
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.types import Level

HEALTH, METRICS = 'health.csv', 'metrics.json'
LIVE, OPTIMIZED = 'published live', 'optimised'
COLUMNS = (
    'stamp_s', 'level', 'sigma_x_m', 'sigma_y_m', 'sigma_yaw_rad', 'seen', 'used', 'reasons'
)  # fmt: skip


@dataclass(frozen=True)
class HealthLog:
    """What was published with each scan: ``stamps`` (n,) [ns], ``levels`` (n,), ``reasons``."""

    stamps: NDArray[np.int64]
    levels: NDArray[np.int64]
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class RunFolder:
    """One side of a comparison. ``paths`` by name, ``health`` and ``figures`` where known.

    ``is_run``: it is the folder of a run, so that its map begins at the robot's first pose or is
    a map that was given.
    """

    name: str
    paths: Mapping[str, Trajectory]
    health: HealthLog | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    is_run: bool = False


def health_table(frames: FrameLog) -> str:
    """One row per scan: health, sigma in the map, reflectors seen and used, reasons."""
    rows = [','.join(COLUMNS)]
    for k, stamp in enumerate(frames.stamps):
        x, y, yaw = (math.sqrt(max(v, 0.0)) for v in np.diag(frames.covs[k]))
        seen, used = (v[k] if k < len(v) else 0 for v in (frames.seen, frames.used))
        why = '; '.join(frames.reasons[k]).replace('"', "'")
        quoted = f'"{why}"' if why else ''
        level = Level(frames.levels[k]).name
        rows.append(
            f'{format_stamp(stamp)},{level},{x:.6f},{y:.6f},{yaw:.7f},{seen},{used},{quoted}'
        )
    return '\n'.join(rows) + '\n'


def read_health(path: Path) -> HealthLog:
    """Read the table. Raises FileFormatError with the line."""
    stamps, levels, reasons = [], [], []
    for number, line in read_lines(path):
        if number == 1 and line == ','.join(COLUMNS):
            continue
        try:
            (row,) = csv.reader([line])
            if len(row) != len(COLUMNS):
                raise ValueError(f'{len(row)} cells, {len(COLUMNS)} expected')
            stamps.append(parse_stamp(row[0]))
            levels.append(int(Level[row[1]]))
        except (ValueError, KeyError, csv.Error) as e:
            raise FileFormatError(f'{path}:{number}: {e}') from e
        reasons.append(row[-1])
    return HealthLog(np.array(stamps, np.int64), np.array(levels, np.int64), tuple(reasons))


def read_run(folder: Path) -> RunFolder:
    """A folder that replay, live or demo wrote. Raises MapError, FileFormatError."""
    if not (folder / METRICS).is_file():
        raise MapError(f'{folder}: no {METRICS}: not the folder of a replay')
    try:
        figures = json.loads((folder / METRICS).read_text(encoding='utf-8'))
    except (OSError, ValueError) as e:
        raise FileFormatError(f'{folder / METRICS}: cannot be read: {e}') from e
    if not isinstance(figures, dict):
        raise FileFormatError(f'{folder / METRICS}: not the figures of a run')
    paths = {
        LIVE: read_tum(folder / 'front_end.tum'), OPTIMIZED: read_tum(folder / 'trajectory.tum')
    }  # fmt: skip
    health = read_health(folder / HEALTH) if (folder / HEALTH).exists() else None
    return RunFolder(folder.name, paths, health, figures, is_run=True)
