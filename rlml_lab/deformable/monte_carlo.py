# SPDX-License-Identifier: Apache-2.0
"""The study: every estimator on the same runs of every row, and what may be claimed from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.deformable.ekf import Estimate, dead_reckoning, run_ekf
from rlml_lab.deformable.experiment import (
    FEATURES,
    PATHS,
    ROWS,
    SENSINGS,
    STEPS,
    Measurements,
    Row,
    draw,
)
from rlml_lab.deformable.nls import Smoothed, run_nls
from rlml_lab.deformable.rts import run_rts
from rlml_lab.deformable.scoring import chi2_bounds, mean_ci, pose_error2, run_nees, step_nees
from rlml_lab.deformable.simulated_runs import simulate
from rlml_slam.deformable.model import Noise
from rlml_slam.se2 import Array

ESTIMATORS = ('ekf', 'nls', 'rts', 'dead_reckoning')


@dataclass(frozen=True)
class RowResult:
    """One row over S runs; ``error2`` (S, 4, 2) in the order of ESTIMATORS, as pose_error2."""

    error2: Array
    nees_ekf: Array  # (S, N-1)
    nees_nls: Array  # (S,)
    unseen: NDArray[np.int64]  # (S,) sightings missing of N M
    path: Array  # (S,) true length of the robot's path [m]
    iterations: NDArray[np.int64]  # (S,)
    converged: NDArray[np.bool_]  # (S,)

    def ss3(self, estimator: str) -> Array:
        """The note's pose error of each run, (S,)."""
        total: Array = self.error2[:, ESTIMATORS.index(estimator)].sum(-1)
        return total


@dataclass(frozen=True)
class Runs:
    """The truth of S runs of one row, what was measured, and every estimate of it."""

    truth: Array
    measurements: Measurements
    ekf: Estimate
    nls: Smoothed
    rts: Estimate
    reckoned: Array


def run_estimators(row: Row, seeds: range) -> Runs:
    """All estimators on the runs of ``seeds``; each run depends on its own seed alone."""
    truth, measurements = simulate(row, draw(seeds))
    noise = Noise()
    ekf = run_ekf(measurements, noise)
    return Runs(
        truth, measurements, ekf, run_nls(measurements, noise), run_rts(measurements, noise, ekf),
        dead_reckoning(measurements),
    )  # fmt: skip


def run_row(row: Row, seeds: range) -> RowResult:
    """The scores of all estimators on the runs of ``seeds``."""
    runs = run_estimators(row, seeds)
    truth = runs.truth
    means = (runs.ekf.mean, runs.nls.mean, runs.rts.mean, runs.reckoned)
    return RowResult(
        np.stack([pose_error2(truth, mean) for mean in means], 1),
        step_nees(truth, runs.ekf),
        run_nees(truth, runs.nls),
        np.isnan(runs.measurements.sigma).sum((1, 2)),
        np.linalg.norm(np.diff(truth[..., :2], axis=1), axis=-1).sum(-1),
        runs.nls.iterations,
        runs.nls.converged,
    )


def concatenate(parts: Iterable[RowResult]) -> RowResult:
    """Results of consecutive seed ranges as one."""
    columns = zip(*(dataclasses.astuple(p) for p in parts), strict=True)
    return RowResult(*(np.concatenate(c) for c in columns))


def summarize(results: Mapping[Row, RowResult]) -> dict[str, Any]:
    """Plain numbers of every row, the pairs of control, and the claims (JSON-ready)."""
    rows = {row.name: _summarize_row(row, results[row]) for row in ROWS if row in results}
    pairs = {
        f'{p} {s}': _compare_control(
            results[Row(p, s, 'predetermined')], results[Row(p, s, 'active')]
        )
        for s in SENSINGS
        for p in PATHS
        if Row(p, s, 'predetermined') in results and Row(p, s, 'active') in results
    }
    seeds = len(next(iter(results.values())).path)
    return {'seeds': seeds, 'rows': rows, 'active_minus_predetermined': pairs,
            'claims': _claims(rows, pairs)}  # fmt: skip


def _summarize_row(row: Row, r: RowResult) -> dict[str, Any]:
    S = len(r.path)
    degrees = STEPS * (3 + 2 * FEATURES) - 3
    steps = r.nees_ekf.mean(0)
    bounds, step_bounds = chi2_bounds(degrees, S), chi2_bounds(3 + 2 * FEATURES, S)
    reckoned = r.ss3('dead_reckoning').mean()
    return {
        'path': row.path, 'sensing': row.sensing, 'control': row.control,
        'ss3': {e: mean_ci(r.ss3(e)) for e in ESTIMATORS},
        'position_rmse_m': {
            e: float(np.sqrt(r.error2[:, k, 0].mean() / STEPS)) for k, e in enumerate(ESTIMATORS)
        },
        'heading_rmse_rad': {
            e: float(np.sqrt(r.error2[:, k, 1].mean() / STEPS)) for k, e in enumerate(ESTIMATORS)
        },
        'relative_to_dead_reckoning': {
            e: float(r.ss3(e).mean() / reckoned) for e in ESTIMATORS[:3]
        },
        'paired': {
            f'{a}-{b}': mean_ci(r.ss3(a) - r.ss3(b))
            for a, b in (('nls', 'ekf'), ('nls', 'rts'), ('rts', 'ekf'),
                         ('ekf', 'dead_reckoning'))
        },
        'share_nls_below_ekf': float((r.ss3('nls') < r.ss3('ekf')).mean()),
        'nees_nls': {'mean': float(r.nees_nls.mean()), 'degrees': degrees, 'bounds': bounds},
        'nees_ekf': {
            'mean': float(steps.mean()), 'lowest_step': float(np.min(steps)),
            'highest_step': float(np.max(steps)), 'last_step': float(steps[-1]),
            'degrees': 3 + 2 * FEATURES, 'bounds': step_bounds,
            'steps_outside': int(((steps < step_bounds[0]) | (steps > step_bounds[1])).sum()),
            'steps': len(steps),
        },
        'unseen': mean_ci(r.unseen.astype(np.float64)),
        'path_m': mean_ci(r.path),
        'mean_step_m': float(r.path.mean() / (STEPS - 1)),
        'converged': float(r.converged.mean()),
        'iterations': {'mean': float(r.iterations.mean()), 'max': int(np.max(r.iterations))},
    }  # fmt: skip


def _compare_control(before: RowResult, after: RowResult) -> dict[str, Any]:
    """Active minus predetermined on the same seeds."""
    return {
        **{f'ss3_{e}': mean_ci(after.ss3(e) - before.ss3(e)) for e in ESTIMATORS},
        **{
            f'relative_{e}': mean_ci(_relative(after, e) - _relative(before, e))
            for e in ESTIMATORS[:3]
        },
        'unseen': mean_ci((after.unseen - before.unseen).astype(np.float64)),
        'path_m': mean_ci(after.path - before.path),
    }


def _relative(r: RowResult, estimator: str) -> Array:
    """Per run, what the ratio of the means, estimator / dead reckoning, is the mean of.

    The delta method: ratio + (a - ratio d) / mean(d), whose spread is that of the ratio.
    """
    a, d = r.ss3(estimator), r.ss3('dead_reckoning')
    ratio = a.mean() / d.mean()
    relative: Array = ratio + (a - ratio * d) / d.mean()
    return relative


def _claims(rows: Mapping[str, Any], pairs: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What the study can be asked, each with the figures that answer it."""
    claims: list[dict[str, Any]] = []

    def claim(what: str, where: str, holds: bool, found: str) -> None:
        claims.append({'claim': what, 'where': where, 'holds': bool(holds), 'found': found})

    def below_zero(what: str, where: str, interval: tuple[float, float]) -> None:
        mean, half = interval
        claim(what, where, mean + half < 0.0, f'{mean:+.4f} ± {half:.4f}')

    for name, r in rows.items():
        below_zero('NLS < EKF (paired)', name, r['paired']['nls-ekf'])
        (n, dn), (e, de) = r['ss3']['nls'], r['ss3']['ekf']
        claim('NLS < EKF (separate intervals)', name, n + dn < e - de,
              f'{n:.3f} ± {dn:.3f}, {e:.3f} ± {de:.3f}')  # fmt: skip
        below_zero('EKF < dead reckoning (paired)', name, r['paired']['ekf-dead_reckoning'])
        below_zero('RTS < EKF (paired)', name, r['paired']['rts-ekf'])
        below_zero('NLS < RTS (paired)', name, r['paired']['nls-rts'])
        for key, title in (('nees_nls', 'NLS'), ('nees_ekf', 'EKF')):
            nees = r[key]
            inside = nees['bounds'][0] <= nees['mean'] <= nees['bounds'][1]
            claim(f'{title} consistent (99.9 % bounds of its NEES)', name,
                  inside and not nees.get('steps_outside', 0),
                  f'{nees["mean"]:.2f} in [{nees["bounds"][0]:.2f}, {nees["bounds"][1]:.2f}]'
                  + (f', {nees["steps_outside"]} of {nees["steps"]} steps outside'
                     if 'steps' in nees else ''))  # fmt: skip
        claim('Gauss-Newton converges in 99.9 % of runs', name, r['converged'] >= 0.999,
              f'{100 * r["converged"]:.2f} %, at most {r["iterations"]["max"]} '
              'iterations')  # fmt: skip
        if r['control'] == 'active':
            claim('mean step >= 1.8 m', name, r['mean_step_m'] >= 1.8,
                  f'{r["mean_step_m"]:.3f} m')  # fmt: skip
    for where, p in pairs.items():
        for e in ('ekf', 'nls'):
            below_zero(f'active < predetermined, {e.upper()} (paired)', where, p[f'ss3_{e}'])
            below_zero(f'active has less of the dead-reckoned error, {e.upper()} (paired)', where,
                       p[f'relative_{e}'])  # fmt: skip
        below_zero('active leaves fewer features unseen (paired)', where, p['unseen'])
    return claims
