# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study plan-real``: what the plan says of real layouts beside what the runs show.

The plan has the layout, the sensor's noise, range and field of view, and no wall. At the true pose
of each look it says which reflectors are in view, and the sigma of a pose by them. The run shows
which were seen, the error of a pose by them alone, as in ``study plan-bound``, and innovations.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rlml_lab.layout.real_runs import Look, RealRun, read_all
from rlml_lab.layout.study_plan_bound import estimate
from rlml_slam import se2
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.bound import bound
from rlml_slam.planning.driving import schur
from rlml_slam.planning.plan import square_size
from rlml_slam.planning.visibility import in_sight
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance
from rlml_slam.simulation.world import ReflectorSet
from rlml_slam.types import Detections

FEW = 30  # poses below which an area is left out
HELD = 0.3  # [m] sigma


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study plan-real``."""
    parser = subparsers.add_parser(
        'plan-real', help='plans of real layouts beside what recorded runs show, area by area'
    )
    parser.add_argument('folder', metavar='DIR', type=Path, help='has reflector-r2000, '
                        'lego-cylinders and mrclam')  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Compare and print; there is no bound to be met."""
    rows = [row for real in read_all(args.folder) for row in areas(real)]
    print(json.dumps({'areas': rows}) if args.json else text(rows))
    return 0


def areas(real: RealRun) -> list[dict[str, Any]]:
    """The whole run, then each area of it: RMS of sigmas, errors and innovations."""
    found = compared(real)
    places = np.array([look.pose[:2] for look in real.looks])
    size = square_size(places)
    cell = (np.floor(places / size) - np.floor(places.min(axis=0) / size)).astype(int)
    rows = [_row(real.name, 'all', found)]
    squares = np.unique(cell, axis=0).tolist()
    for j, i in squares if len(squares) > 1 else []:
        mine = (cell == (j, i)).all(axis=1)
        row = _row(real.name, f'{chr(65 + j)}{i + 1}', {k: v[mine] for k, v in found.items()})
        if row['poses'] >= FEW:
            rows.append(row)
    return rows


def compared(real: RealRun) -> dict[str, Array]:
    """Of each look (n,): reflectors in view and seen, planned sigma by either, error [m].

    ``median``: of nu^T S^-1 nu of its detections, by which ``outside`` of the gate are left out.
    NaN where two are not seen or, as the bound is linear, hold the pose to less than HELD.
    """
    poses = np.array([look.pose for look in real.looks])
    m, p = len(real.points), real.sensor
    r = ReflectorSet(real.points, np.full(m, real.width), np.full(m, np.nan), np.arange(m))
    params, none, rows = Parameters(reflector=p), np.zeros((m, 2, 2)), range(m)
    view = in_sight(poses[:, :2], r, r.geometry(), params, SimulatorParameters())
    d = real.points - poses[:, None, :2]
    bearing = se2.wrap(np.arctan2(d[..., 1], d[..., 0]) - poses[:, 2:])
    view &= np.abs(bearing) <= 0.5 * real.field
    distances = [_distance2(look, real) for look in real.looks]
    gate = float(chi2.ppf(p.gate, 2))
    used = [_part(look.seen, d2 <= gate) for look, d2 in zip(real.looks, distances, strict=True)]
    seen = np.zeros_like(view)
    for k, detections in enumerate(used):
        seen[k, detections.ids] = True
    by_view, by_seen = (bound(poses[:, :2], v, real.points, none, p) for v in (view, seen))
    a, b, c = schur(by_seen.information)
    worst = 0.5 * np.arctan2(-2.0 * b, c - a)
    error = np.full(len(poses), np.nan)
    for k in np.flatnonzero(by_seen.position < HELD).tolist():
        e, _ = estimate(poses[k], used[k], real.points, rows, params)
        error[k] = e[:2] @ [np.cos(worst[k]), np.sin(worst[k])]
    return {
        'view': view.sum(axis=1), 'seen': seen.sum(axis=1), 'planned': by_view.position,
        'planned_seen': by_seen.position, 'error': error,
        'median': np.array([np.median(d2) if len(d2) else np.nan for d2 in distances]),
        'outside': np.array([np.sum(d2 > gate) for d2 in distances]),
    }  # fmt: skip


def _distance2(look: Look, real: RealRun) -> Array:
    """nu^T S^-1 nu (k,) of the detections at the true pose, by the planned noise."""
    z = se2.transform(se2.inverse(look.pose), real.points[look.seen.ids])
    d, s = np.hypot(*z.T), real.sensor
    S = polar_covariance(z / d[:, None], s.sigma_range**2, (d * s.sigma_bearing) ** 2)
    nu = look.seen.points - z
    return np.asarray(np.einsum('ki,kij,kj->k', nu, np.linalg.inv(S), nu))


def _part(d: Detections, mine: NDArray[np.bool_]) -> Detections:
    return replace(d, points=d.points[mine], cov=d.cov[mine], ids=d.ids[mine],
                   diameters=d.diameters[mine])  # fmt: skip


def _row(run: str, area: str, found: dict[str, Array]) -> dict[str, Any]:
    """Shares of all looks; sigmas and errors of those that hold a pose."""
    held = np.isfinite(found['error'])
    sigma, error = _rms(found['planned_seen'][held]), _rms(found['error'][held])
    seen, outside = float(found['seen'].sum()), float(found['outside'].sum())
    return {
        'run': run, 'area': area, 'looks': len(held), 'in_view': float(found['view'].mean()),
        'seen': float(found['seen'].mean()), 'outside_share': outside / max(seen + outside, 1.0),
        'innovation': float(np.sqrt(np.nanmedian(found['median']) / chi2.median(2))),
        'poses': int(held.sum()),
        'planned_m': _rms(found['planned'][held & (found['planned'] < HELD)]),
        'planned_of_seen_m': sigma, 'rms_m': error, 'ratio': error / max(sigma, 1e-9),
    }  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def text(rows: Sequence[dict[str, Any]]) -> str:
    """A row for each run and each area of it."""
    head = ('run', 'area', 'looks', 'in view', 'seen', 'outside', 'innovation', 'poses',
            'planned [cm]', 'of seen [cm]', 'RMS [cm]', 'ratio')  # fmt: skip
    lines = [
        (r['run'], r['area'], str(r['looks']), f'{r["in_view"]:.1f}', f'{r["seen"]:.1f}',
         f'{r["outside_share"]:.1%}', f'{r["innovation"]:.2f}', str(r['poses']),
         f'{100 * r["planned_m"]:.2f}', f'{100 * r["planned_of_seen_m"]:.2f}',
         f'{100 * r["rms_m"]:.2f}', f'{r["ratio"]:.2f}')
        for r in rows
    ]  # fmt: skip
    return aligned([head, *lines])
