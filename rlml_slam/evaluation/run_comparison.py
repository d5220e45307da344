# SPDX-License-Identifier: Apache-2.0
"""Two runs of one recording: how far apart their paths are, where they part, what else differs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.errors import ParameterError
from rlml_slam.evaluation.ate import MAX_GAP, TrajectoryErrors, trajectory_errors
from rlml_slam.evaluation.mounting_difference import Mounting, mounting_difference
from rlml_slam.evaluation.run_folder import LIVE, OPTIMIZED, RunFolder
from rlml_slam.types import Level

DISTANCES = (1e-8, 0.001, 0.01, 0.1, 1.0)  # [m] at which paths part; files have nanometres
DECIMALS = 8  # of metres and degrees: those of the files, and no rounding errors
SAME_STAMP = 50_000_000  # [ns] by which a scan's health may be found at another stamp


@dataclass(frozen=True)
class Figure:
    """A figure that is compared: its title, unit with factor, and by how much it may change.

    ``key`` leads through metrics.json. ``sign`` is +1 where more is worse, -1 where less is, 0
    where neither is.
    """

    title: str
    key: tuple[str, ...]
    sign: int
    limit: float
    unit: str = ''
    factor: float = 1.0


ANY = math.inf
# what --limit names: figures of the paths, whose sign is +1, and of metrics.json
FIGURES: Mapping[str, Figure] = {
    'path_m': Figure('largest distance of the paths', (), 1, 0.001, 'cm', 100.0),
    'heading_deg': Figure('largest difference of heading', (), 1, 0.05, '°'),
    'levels': Figure('scans with another health', (), 1, 0.0, '%', 100.0),
    'scans': Figure('scans', ('scans',), 0, 0.0),
    'ok_share': Figure('OK', ('health', 'OK'), -1, 0.0, '%', 100.0),
    'degraded_share': Figure('DEGRADED', ('health', 'DEGRADED'), 1, 0.0, '%', 100.0),
    'lost_share': Figure('LOST', ('health', 'LOST'), 1, 0.0, '%', 100.0),
    'keyframes': Figure('keyframes', ('keyframes',), 0, 0.0),
    'closures': Figure('loop closures', ('closures', 'accepted'), 0, 0.0),
    'closures_rejected': Figure('loop closures rejected', ('closures', 'rejected'), 0, 0.0),
    'reflectors': Figure('reflectors', ('reflectors',), 0, 0.0),
    'live_ate_rmse_m': Figure('error, live', ('live_ate_rmse_m',), 1, 0.0005, 'cm', 100.0),
    'ate_rmse_m': Figure('error, optimised', ('ate_rmse_m',), 1, 0.0005, 'cm', 100.0),
    'live_heading_rmse_deg': Figure(
        'heading error, live', ('live_heading_rmse_deg',), 1, 0.02, '°'
    ),
    'nees_mean': Figure('NEES', ('nees_mean',), 0, 0.1),
    'front_end_ms': Figure(
        'front end per scan, median', ('front_end_ms', 'median'), 1, ANY, 'ms'
    ),
    'back_end_ms': Figure(
        'back end per keyframe, median', ('back_end_ms', 'median'), 1, ANY, 'ms'
    ),
    'wall_s': Figure('time of the run', ('wall_s',), 1, ANY, 's'),
    'memory_mb': Figure('memory', ('peak_rss_mb',), 1, ANY, 'MB'),
}  # fmt: skip
OF_PATHS = ('path_m', 'heading_deg', 'levels')


@dataclass(frozen=True)
class Parting:
    """Where two paths are first ``distance`` [m] apart: at ``time`` [s] of the run and a place.

    ``health`` is that of A and B there, empty where it is not known.
    """

    distance: float
    time: float
    stamp: int
    place: tuple[float, float]
    health: tuple[str, str]


@dataclass(frozen=True)
class Row:
    """A figure of A and of B, None where there is none, and what becomes of the difference.

    ``verdict``: same, within the limit, no limit, worse, better, or differs.
    """

    name: str
    title: str
    a: float | None
    b: float | None
    limit: float
    verdict: str

    @property
    def is_beyond(self) -> bool:
        """Whether the difference counts."""
        return self.verdict in ('worse', 'better', 'differs')


@dataclass(frozen=True)
class RunComparison:
    """All that differs from A to B. ``paths`` has B's errors against A, by the path's name.

    ``is_fitted``: one path was moved onto the other first. ``settings`` are (what, of A, of B)
    of versions, systems and parameters that differ.
    """

    a: RunFolder
    b: RunFolder
    is_fitted: bool
    paths: Mapping[str, TrajectoryErrors]
    parting: tuple[Parting, ...]
    mounting: Mounting | None
    rows: tuple[Row, ...]
    settings: tuple[tuple[str, str, str], ...]

    @property
    def is_different(self) -> bool:
        """Whether a difference is beyond its limit."""
        return any(r.is_beyond for r in self.rows)


def limits_with(changes: Sequence[str], none: bool = False) -> dict[str, float]:
    """The limits by name, some changed as NAME=VALUE; ``none``: the others are not held.

    Raises ParameterError.
    """
    limits = {name: ANY if none else f.limit for name, f in FIGURES.items()}
    for text in changes:
        name, _, value = text.partition('=')
        if name not in limits:
            raise ParameterError(f'--limit {text}: {name!r} is none of {", ".join(limits)}')
        try:
            limits[name] = float(value)
        except ValueError:
            limits[name] = math.nan
        if not limits[name] >= 0.0:
            raise ParameterError(f'--limit {text}: is not NAME=VALUE with a value from 0 on')
    return limits


def compare_runs(
    a: RunFolder, b: RunFolder, limits: Mapping[str, float], fit: bool, max_gap: int = MAX_GAP
) -> RunComparison:
    """Compare B with A; ``fit`` moves the paths of B onto those of A first.

    Paths of the same name are compared, or A's first one with B's. Raises InputError where they
    share no time.
    """
    pairs = {n: (a.paths[n], b.paths[n]) for n in a.paths if n in b.paths}
    if not pairs:
        name = next(iter(a.paths))
        pairs = {name: (a.paths[name], next(iter(b.paths.values())))}
    paths = {n: trajectory_errors(q, p, fit, max_gap) for n, (p, q) in pairs.items()}
    levels = _other_levels(a, b)
    found = _path_figures(paths, levels)
    rows = [_row(n, 0.0 if n in found else None, found.get(n), limits[n]) for n in OF_PATHS]
    rows += [
        _row(n, _figure(a.figures, f.key), _figure(b.figures, f.key), limits[n])
        for n, f in FIGURES.items() if n not in OF_PATHS
    ]  # fmt: skip
    first = next(iter(paths))
    smooth = OPTIMIZED if OPTIMIZED in paths else first
    return RunComparison(
        a, b, fit, paths, tuple(_parting(a, b, pairs[first][1], paths[first])),
        _mounting(*pairs[smooth]), tuple(r for r in rows if (r.a, r.b) != (None, None)),
        tuple(_settings(a.figures, b.figures)),
    )  # fmt: skip


def _figure(figures: Mapping[str, Any], key: tuple[str, ...]) -> float | None:
    value: Any = figures
    for k in key:
        value = value.get(k) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) else None


def _path_figures(paths: Mapping[str, TrajectoryErrors], levels: float | None) -> dict[str, float]:
    out = {'path_m': round(max(float(e.distances.max()) for e in paths.values()), DECIMALS)}
    turned = [np.abs(e.errors[:, 2]) for e in paths.values() if np.isfinite(e.errors[:, 2]).any()]
    if turned:
        out['heading_deg'] = round(math.degrees(max(map(np.nanmax, turned))), DECIMALS)
    return out if levels is None else out | {'levels': levels}


def _other_levels(a: RunFolder, b: RunFolder) -> float | None:
    """Share of the scans of both whose level differs; None where it is not known."""
    if a.health is None or b.health is None:
        return None
    _, i, j = np.intersect1d(a.health.stamps, b.health.stamps, return_indices=True)
    if not len(i):
        return None
    return float(np.mean(a.health.levels[i] != b.health.levels[j]))


def _row(name: str, a: float | None, b: float | None, limit: float) -> Row:
    f = FIGURES[name]
    if a == b:
        verdict = 'same'
    elif a is None or b is None:
        verdict = 'no limit' if math.isinf(limit) else 'differs'
    elif abs(b - a) <= limit:
        verdict = 'no limit' if math.isinf(limit) else 'within the limit'
    elif name in OF_PATHS or not f.sign:
        verdict = 'differs'
    else:
        verdict = 'worse' if f.sign * (b - a) > 0.0 else 'better'
    return Row(name, f.title, a, b, limit, verdict)


def _parting(
    a: RunFolder, b: RunFolder, path: Trajectory, errors: TrajectoryErrors
) -> Iterator[Parting]:
    start = int(errors.stamps[0])
    for distance in DISTANCES:
        beyond = np.flatnonzero(errors.distances > distance)
        if not len(beyond):
            return
        k = int(beyond[0])
        stamp = int(errors.stamps[k])
        pose = path.poses[errors.indices[k]] if len(path) else np.zeros(3)
        x, y, _ = se2.compose(errors.T_truth_map, pose)
        health = _health_at(a, stamp), _health_at(b, stamp)
        yield Parting(distance, (stamp - start) * 1e-9, stamp, (float(x), float(y)), health)


def _health_at(run: RunFolder, stamp: int) -> str:
    """Level and reasons of the scan nearest in time, '' where there is none."""
    log = run.health
    if log is None or not len(log.stamps):
        return ''
    k = int(np.argmin(np.abs(log.stamps - stamp)))
    if abs(int(log.stamps[k]) - stamp) > SAME_STAMP:
        return ''
    why = f': {log.reasons[k]}' if log.reasons[k] else ''
    return f'{Level(int(log.levels[k])).name}{why}'


def _mounting(a: Trajectory, b: Trajectory) -> Mounting | None:
    stamps, i, j = np.intersect1d(a.stamps, b.stamps, return_indices=True)
    if len(stamps) < 2:
        return None
    return mounting_difference(stamps, a.poses[i], b.poses[j])


def _settings(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """What of metrics.json says how the runs were made, where it differs."""
    of_a, of_b = (f.get('about') or {} for f in (a, b))
    for name in ('version', 'system'):
        if name in of_a and name in of_b and of_a[name] != of_b[name]:
            yield name, str(of_a[name]), str(of_b[name])
    p, q = (of.get('parameters') or {} for of in (of_a, of_b))
    for name in sorted({*p, *q}):
        if p.get(name) != q.get(name):
            yield name, *(str(v[name]) if name in v else 'default' for v in (p, q))


def live_name(comparison: RunComparison) -> str:
    """The path whose parting is given: the published one where both have it."""
    return LIVE if LIVE in comparison.paths else next(iter(comparison.paths))
