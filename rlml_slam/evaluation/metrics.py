# SPDX-License-Identifier: Apache-2.0
"""The figures of a run, as written to metrics.json."""

from __future__ import annotations

import resource
import sys
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.evaluation.ate import TrajectoryErrors, trajectory_errors
from rlml_slam.evaluation.run_record import Run
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS

MATCH_RADIUS = 0.5  # [m] an anonymous reflector farther from every true one is spurious


@dataclass(frozen=True)
class RunErrors:
    """Errors of a run against its truth: optimised and live, and the live poses' NEES.

    ``nees`` (n,) is NaN where a covariance is singular or the truth has no heading, and all of
    it where the truth was aligned: the covariance is about the first pose, the fit is not.
    """

    optimized: TrajectoryErrors
    live: TrajectoryErrors
    nees: Array


def run_errors(run: Run) -> RunErrors | None:
    """Errors, None where no truth is known at any of the stamps.

    A truth in a frame of its own is aligned to each trajectory first.
    """
    if run.truth is None or not len(run.trajectory) or not run.frames.stamps:
        return None
    truth, aligned = run.truth.trajectory, not run.truth.is_map
    try:
        optimized = trajectory_errors(run.trajectory, truth, aligned)
        live = trajectory_errors(run.frames.trajectory(), truth, aligned)
    except InputError:  # no pose between two of the truth that are near in time
        return None
    unknown = np.full(len(live.errors), np.nan)
    return RunErrors(
        optimized, live, unknown if aligned else nees(live, np.array(run.frames.covs))
    )


def nees(errors: TrajectoryErrors, covs: Array) -> Array:
    """Normalised squared errors e' P^-1 e (n,) of the matched poses, whose mean is ideally 3.

    ``covs`` (m, 3, 3) are of all poses of the trajectory, in the axes of the map. NaN where the
    covariance is singular.
    """
    R = np.eye(3)
    R[:2, :2] = se2.rotation(errors.T_truth_map[2])
    P = R @ covs[errors.indices] @ R.T
    out = np.full(len(P), np.nan)
    # the first pose defines the map: it has neither error nor covariance
    sound = np.linalg.det(P) > 1e-24
    e = errors.errors[sound]
    out[sound] = np.einsum('ni,ni->n', e, np.linalg.solve(P[sound], e[:, :, None])[:, :, 0])
    return out


def metrics(run: Run, errors: RunErrors | None = None) -> dict[str, Any]:
    """All figures of a run, ready for JSON; those of the truth only where it is known."""
    n, wall, duration = len(run.frames.stamps), run.wall_s, run.duration_s
    out: dict[str, Any] = {
        'scans': n,
        'duration_s': round(duration, 3),
        'wall_s': round(wall, 3),
        'real_time_factor': round(duration / wall, 2) if wall > 0.0 else None,
        'front_end_ms': distribution(run.frames.wall_ms),
        'back_end_ms': distribution(run.back_end_ms),
        'keyframes': len(run.keyframes),
        'closures': {'accepted': len(run.closures), 'rejected': run.rejected},
        'reflectors': len(run.reflectors),
        'reflector_states': dict(Counter(s.state for s in run.reflector_states)),
        'peak_rss_mb': round(peak_rss_mb(), 1),
        'inputs': {stream: dict(counts) for stream, counts in run.inputs.items()},
        'topics': dict(run.topics),
        'health': {k: round(v, 4) for k, v in run.health_share().items()},
        'health_reasons': {why: round(v, 4) for why, v in run.health_reasons()},
        'problem': run.problem,
        'about': run.origin.figures(),
    }
    errors = run_errors(run) if errors is None else errors
    if errors is not None and run.truth is not None:
        out |= _truth_figures(run, errors)
    return out | dict(run.extra)


def _truth_figures(run: Run, errors: RunErrors) -> dict[str, Any]:
    assert run.truth is not None
    optimized, live = errors.optimized.summary(), errors.live.summary()
    out: dict[str, Any] = {
        'alignment': 'none' if run.truth.is_map else 'se2',
        'truth_matched': optimized['matched'],
        'ate_rmse_m': optimized['rmse_m'],
        'live_ate_rmse_m': live['rmse_m'],
        'live_ate_max_m': live['max_m'],
    }
    if 'heading_rmse_deg' in optimized:
        out['heading_rmse_deg'] = optimized['heading_rmse_deg']
        out['live_heading_rmse_deg'] = live['heading_rmse_deg']
    if np.isfinite(errors.nees).any():
        out['nees_mean'] = float(np.nanmean(errors.nees))
    if len(run.truth.reflectors):
        out |= reflector_figures(run, errors.optimized.T_truth_map)
    return {k: round(v, 6) if isinstance(v, float) else v for k, v in out.items()}


def reflector_figures(run: Run, T_truth_map: Array) -> dict[str, Any]:
    """RMSE [m] of the mapped reflectors that are true ones; spurious ones are near none."""
    assert run.truth is not None
    points = se2.transform(T_truth_map, run.reflectors.points)
    true = run.truth.reflectors
    pairs = _match(points, run.reflectors.ids, true, run.truth.reflector_ids)
    d = np.hypot(*(points[pairs[:, 0]] - true[pairs[:, 1]]).T)
    found = len(np.unique(pairs[:, 1]))
    return {
        'reflector_rmse_m': float(np.sqrt(np.mean(d**2))) if len(d) else None,
        'reflectors_true': len(true),
        'reflectors_found': found,
        'reflectors_twice': len(pairs) - found,
        'reflectors_spurious': len(points) - len(pairs),
    }


def _match(
    points: Array, ids: NDArray[np.int64], true: Array, true_ids: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Pairs (n, 2) of mapped and true reflectors: by id, else the nearest within the radius."""
    pairs = []
    for k, (point, id_) in enumerate(zip(points, ids, strict=True)):
        if id_ != ANONYMOUS and (true_ids == id_).any():
            pairs.append((k, int(np.flatnonzero(true_ids == id_)[0])))
            continue
        d = np.hypot(*(true - point).T)
        j = int(np.argmin(d))
        if d[j] <= MATCH_RADIUS:
            pairs.append((k, j))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def distribution(values: Any) -> dict[str, float | None]:
    """Median, 99th percentile and maximum, None of nothing."""
    v = np.asarray(values, dtype=np.float64)
    if not len(v):
        return {'median': None, 'p99': None, 'max': None}
    figures = {'median': np.median(v), 'p99': np.percentile(v, 99), 'max': v.max()}
    return {name: round(float(f), 3) for name, f in figures.items()}


def peak_rss_mb() -> float:
    """Largest resident memory so far of this process and the largest that it started [MB]."""
    both = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    peak = sum(resource.getrusage(who).ru_maxrss for who in both)
    return peak / 1e6 if sys.platform == 'darwin' else peak * 1024 / 1e6
