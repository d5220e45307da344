# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows, as columns by name of their source; the same for a report and live.

Units are those of the page: m, cm, degrees, seconds since the first frame, ms.
"""

from __future__ import annotations

import base64
import io
import itertools
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rlml_slam import se2
from rlml_slam.evaluation.metrics import RunErrors
from rlml_slam.evaluation.run_record import FrameLog, Run
from rlml_slam.evaluation.scan_log import ScanLog
from rlml_slam.maps.occupancy import UNKNOWN, OccupancyGrid
from rlml_slam.se2 import Array
from rlml_slam.types import Level, Reflectors

Columns: TypeAlias = dict[str, Any]  # arrays or lists of one length, by name

CHI2_95 = 5.991  # of two degrees of freedom: the 95 % ellipse
MAX_SIDE = 1400  # pixels of the picture of a grid
MAX_CLOSURES = 4000
# of occupied cells and of unknown ones: (red, green, blue, alpha)
LIGHT = ((31, 38, 48, 255), (102, 113, 128, 34))
DARK = ((214, 221, 230, 255), (150, 161, 174, 30))
# every source and its columns
SOURCES: Mapping[str, tuple[str, ...]] = {
    'frames': (
        't', 'x', 'y', 'theta', 'sigma', 'sigma_theta', 'error', 'error_theta', 'bound',
        'bound_theta', 'level', 'seen', 'used', 'ms', 'reason',
    ),
    'path': ('t', 'x', 'y'),
    'path_error': ('t', 'error', 'error_theta'),
    'truth': ('t', 'x', 'y'),
    'true_reflectors': ('x', 'y', 'name'),
    'reflectors': ('x', 'y', 'width', 'height', 'angle', 'sigma', 'name', 'sightings'),
    'closures': ('xs', 'ys'),
    'keyframes': ('x', 'y'),
    'grid': ('x', 'y', 'width', 'height', 'angle', 'light', 'dark'),
    'health': ('left', 'right', 'level', 'name', 'reason'),
    'scans': ('t', 'count'),
    'points': ('x', 'y'),
}  # fmt: skip


def empty() -> dict[str, Columns]:
    """Every source without any data."""
    return {name: {c: [] for c in columns} for name, columns in SOURCES.items()}


def columns_of(run: Run, errors: RunErrors | None) -> dict[str, Columns]:
    """Every source of a finished run."""
    out = empty()
    start = run.frames.stamps[0] if run.frames.stamps else 0
    out['frames'] = frames(run.frames, start, errors)
    out['path'] = path(run.trajectory.stamps, run.trajectory.poses, start)
    out['health'] = spells(out['frames'])
    if errors is not None:
        o = errors.optimized
        out['path_error'] = {
            't': seconds(o.stamps, start), 'error': single(100.0 * o.distances),
            'error_theta': single(np.degrees(o.errors[:, 2])),
        }  # fmt: skip
    if run.truth is not None and (run.truth.is_map or errors is not None):
        truth, ids = run.truth, run.truth.reflector_ids
        # a truth in a frame of its own is shown where the optimised path was aligned to it
        T = np.zeros(3)
        if not truth.is_map and errors is not None:
            T = se2.inverse(errors.optimized.T_truth_map)
        points = se2.transform(T, truth.trajectory.poses[:, :2])
        out['truth'] = path(truth.trajectory.stamps, points, start)
        known = se2.transform(T, truth.reflectors)
        names = [str(i) for i in ids.tolist()] or [''] * len(known)
        out['true_reflectors'] = {'x': known[:, 0], 'y': known[:, 1], 'name': names}
    out['reflectors'] = reflectors(run.reflectors)
    out['closures'] = closures(run.closures)
    out['keyframes'] = {'x': single(run.keyframes[:, 0]), 'y': single(run.keyframes[:, 1])}
    if run.grid is not None:
        out['grid'] = grid(run.grid)
    out['scans'], out['points'] = scans(run.frames.scans, start)
    return out


def frames(log: FrameLog, start: int, errors: RunErrors | None = None) -> Columns:
    """Poses as published, their uncertainty, errors, health and cost; NaN where unknown.

    ``bound`` is the published 3 sigma of the position along its worst direction [cm].
    """
    n = len(log.stamps)
    poses = np.array(log.poses, dtype=np.float64).reshape(-1, 3)
    covs = np.array(log.covs, dtype=np.float64).reshape(-1, 3, 3)
    sigma = 100.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(covs[:, :2, :2])[:, 1], 0.0))
    sigma_theta = np.degrees(np.sqrt(np.maximum(covs[:, 2, 2], 0.0)))
    error, error_theta = np.full(n, np.nan), np.full(n, np.nan)
    if errors is not None:
        error[errors.live.indices] = 100.0 * errors.live.distances
        error_theta[errors.live.indices] = np.degrees(errors.live.errors[:, 2])
    ms = np.array(log.wall_ms) if len(log.wall_ms) == n else np.full(n, np.nan)
    counts = {
        k: np.array(v if len(v) == n else np.full(n, np.nan))
        for k, v in (('seen', log.seen), ('used', log.used))
    }
    numbers = {
        'x': poses[:, 0], 'y': poses[:, 1], 'theta': np.degrees(poses[:, 2]),
        'sigma': sigma, 'sigma_theta': sigma_theta, 'error': error, 'error_theta': error_theta,
        'bound': 3.0 * sigma, 'bound_theta': 3.0 * sigma_theta, 'ms': ms, **counts,
    }  # fmt: skip
    return {
        't': seconds(np.array(log.stamps, dtype=np.int64), start),
        **{k: single(v) for k, v in numbers.items()},
        'level': np.array(log.levels, dtype=np.uint8),
        'reason': ['; '.join(r) for r in log.reasons],
    }


def spells(of: Columns) -> Columns:
    """Spells of one level of health and one reason, from columns of ``frames``."""
    t = of['t']
    states = list(zip(of['level'].tolist(), of['reason'], strict=True))
    begins = [k for k in range(len(states)) if k == 0 or states[k] != states[k - 1]]
    ends = [*begins[1:], len(states) - 1] if begins else []
    return {
        'left': [float(t[k]) for k in begins],
        'right': [float(t[k]) for k in ends],
        'level': [states[k][0] for k in begins],
        'name': [Level(states[k][0]).name for k in begins],
        'reason': [states[k][1] for k in begins],
    }


def path(stamps: NDArray[np.int64], poses: Array, start: int) -> Columns:
    """A trajectory of poses (n, 3) or points (n, 2)."""
    return {
        't': seconds(stamps, start), 'x': single(poses[:, 0]), 'y': single(poses[:, 1]),
    }  # fmt: skip


def reflectors(of: Reflectors) -> Columns:
    """Reflectors with the axes of their 95 % ellipses [m] and their angle [rad]."""
    values, vectors = np.linalg.eigh(of.cov.reshape(-1, 2, 2))
    values = np.maximum(values, 0.0)
    axes = 2.0 * np.sqrt(CHI2_95 * values)
    ids = zip(of.ids.tolist(), of.keys.tolist(), strict=True)
    return {
        'x': of.points[:, 0], 'y': of.points[:, 1],
        'width': axes[:, 1], 'height': axes[:, 0],
        'angle': np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]),
        'sigma': 100.0 * np.sqrt(values[:, 1]),
        'name': [f'id {i}' if i >= 0 else f'no id, key {key}' for i, key in ids],
        'sightings': of.sightings,
    }  # fmt: skip


def closures(ends: Array) -> Columns:
    """Loop closures (c, 2, 2) as lines, MAX_CLOSURES of them at most."""
    kept = ends[:: max(1, -(-len(ends) // MAX_CLOSURES))]
    return {'xs': kept[:, :, 0].tolist(), 'ys': kept[:, :, 1].tolist()}


def grid(of: OccupancyGrid, is_small: bool = True) -> Columns:
    """The grid as a picture: occupied cells and unknown ones, on paper that is light or dark.

    ``is_small``: as few bytes as possible, which takes ten times as long.
    """
    rows, columns = of.cells.shape
    centre = 0.5 * of.resolution * np.array([[columns, rows]])
    x, y = se2.transform(of.T_map_grid, centre)[0].tolist()
    light, dark = grid_pictures(of.cells, is_small)
    return {
        'x': [x], 'y': [y], 'width': [columns * of.resolution], 'height': [rows * of.resolution],
        'angle': [of.yaw], 'light': [light], 'dark': [dark],
    }  # fmt: skip


def grid_pictures(cells: NDArray[np.int8], is_small: bool = True) -> list[str]:
    """Data URLs of PNG files with a palette, of at most MAX_SIDE pixels a side."""
    cells, _ = coarser(cells, MAX_SIDE)
    # 16 steps: 0 is free, 15 occupied, 16 unknown
    index = np.where(cells < 0, 16, np.round(np.clip(cells, 0, 100) * 0.15)).astype(np.uint8)
    image = Image.fromarray(index[::-1], mode='P')
    out = []
    for occupied, unknown in (LIGHT, DARK):
        shades = [(*occupied[:3], round(occupied[3] * k / 15)) for k in range(16)]
        rgba = np.array([*shades, unknown], dtype=np.uint8)
        image.putpalette(rgba[:, :3].tobytes())
        file = io.BytesIO()
        level = {'optimize': True} if is_small else {'compress_level': 1}
        image.save(file, 'png', transparency=rgba[:, 3].tobytes(), **level)
        out.append('data:image/png;base64,' + base64.b64encode(file.getvalue()).decode('ascii'))
    return out


def coarser(cells: NDArray[np.int8], most: int) -> tuple[NDArray[np.int8], int]:
    """At most ``most`` cells a side, and how many of those given are a side of one.

    The most occupied cell of each block, so that walls stay.
    """
    k = -(-max(cells.shape) // most) or 1
    rows, columns = (-(-n // k) for n in cells.shape)
    beyond = [(0, k * m - n) for m, n in zip((rows, columns), cells.shape, strict=True)]
    padded = np.pad(cells, beyond, constant_values=UNKNOWN)
    return padded.reshape(rows, k, columns, k).max(axis=(1, 3)), k


def scans(log: ScanLog, start: int) -> tuple[Columns, Columns]:
    """Time and number of points of each scan, and all their points [cm] in the base frame."""
    stamps = np.array(log.stamps, dtype=np.int64)
    counts = np.array([len(p) for p in log.points], dtype=np.int32)
    points = np.concatenate([np.zeros((0, 2), np.int16), *log.points])
    return (
        {'t': seconds(stamps, start), 'count': counts},
        {'x': np.ascontiguousarray(points[:, 0]), 'y': np.ascontiguousarray(points[:, 1])},
    )


def seconds(stamps: NDArray[np.int64], start: int) -> NDArray[np.float64]:
    """Seconds since the start."""
    return np.asarray((stamps - start) * 1e-9, dtype=np.float64)


def single(values: Array) -> NDArray[np.float32]:
    """Single precision: half of the page."""
    return np.ascontiguousarray(values, dtype=np.float32)


def extent(of: Mapping[str, Columns]) -> tuple[Array, Array]:
    """Corners (2,) of the area that anything of the map is in, with a margin."""
    points = [np.zeros((1, 2))]
    for name in ('frames', 'path', 'reflectors', 'keyframes'):
        points.append(np.column_stack([of[name]['x'], of[name]['y']]).reshape(-1, 2))
    g = of['grid']
    for x, y, w, h, a in zip(*(g[k] for k in ('x', 'y', 'width', 'height', 'angle')), strict=True):
        corners = list(itertools.product((-0.5 * w, 0.5 * w), (-0.5 * h, 0.5 * h)))
        points.append(se2.transform(np.array([x, y, a]), np.array(corners)))
    every = np.concatenate(points)
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    margin = 0.02 * float((high - low).max()) + 0.2
    return low - margin, high + margin


def as_lists(of: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Columns as JSON has them: lists, with None in the place of NaN."""
    out: dict[str, list[Any]] = {}
    for name, values in of.items():
        if isinstance(values, np.ndarray):
            values = values.tolist()
        out[name] = [
            v if not isinstance(v, float) else round(v, 4) if isfinite(v) else None
            for v in values
        ]  # fmt: skip
    return out
