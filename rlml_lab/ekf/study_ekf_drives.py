# SPDX-License-Identifier: Apache-2.0
"""Simulated drives of ``rlml-lab study ekf``: every system on the same one, and its errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rlml_lab.ekf.association_truth import AssociationLog, association_figures
from rlml_lab.support.drives import observe, process, simulate
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.estimation.landmark_models import POINT
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.metrics import metrics
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import EkfParameters, SimulatorParameters, from_mapping
from rlml_slam.recordings.products import collect
from rlml_slam.simulation.simulation import Message
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Odometry

SYSTEMS = ('rlml', 'reflectors', 'spikes', 'lines', 'dead_reckoning')
# figure -> heading of its column, factor and digits
COLUMNS: dict[str, tuple[str, float, int]] = {
    'ate_rmse_m': ('ATE [cm]', 100.0, 2),
    'live_ate_rmse_m': ('live [cm]', 100.0, 2),
    'heading_rmse_deg': ('heading [°]', 1.0, 3),
    'landmark_rmse_m': ('landmarks [cm]', 100.0, 2),
    'nees_mean': ('NEES (3)', 1.0, 2),
    'precision': ('precision [%]', 100.0, 2),
    'recall': ('recall [%]', 100.0, 2),
    'median_ms': ('median [ms]', 1.0, 2),
    'p99_ms': ('p99 [ms]', 1.0, 2),
}

HEADER = ['world, system', *(c[0] for c in COLUMNS.values())]


def evaluate_drive(
    world: str, seed: int, values: Mapping[str, Any], systems: Sequence[str], duration: float
) -> dict[str, dict[str, Any]]:
    """Figures of each system on one simulated drive."""
    p: SimulatorParameters = from_mapping(
        {'world': world, 'duration': duration}, SimulatorParameters
    )
    messages, truth = simulate(p, seed)
    params: EkfParameters = from_mapping(values, EkfParameters)
    observations = observe(messages, params, p)
    out: dict[str, dict[str, Any]] = {}
    for system in systems:
        if system == 'dead_reckoning':
            out[system] = dead_reckoning(messages, truth.trajectory)
            continue
        slam: Slam | EkfSlam = Slam(params)
        if system != 'rlml':
            slam = EkfSlam(replace(params, ekf=replace(params.ekf, extractor=system)))
        log, associations = FrameLog(), AssociationLog()
        for frames in process(slam, observations):
            log.add(frames)
            associations.add(frames)
        model = slam.estimator.model if isinstance(slam, EkfSlam) else POINT
        figures = metrics(collect(slam, log, f'{world}, {system}', truth))
        figures |= association_figures(associations, truth.trajectory, slam.reflectors(), model)
        figures |= {f'{k}_ms': figures['front_end_ms'][k] for k in ('median', 'p99')}
        out[system] = {k: figures.get(k) for k in COLUMNS}
    return out


def dead_reckoning(messages: Sequence[Message], truth: Trajectory) -> dict[str, Any]:
    """Errors of the odometry alone, which begins at the truth's start."""
    odometry = [m for m in messages if isinstance(m, Odometry)]
    poses = se2.between(odometry[0].pose, np.array([o.pose for o in odometry]))
    stamps = np.array([o.stamp for o in odometry], dtype=np.int64)
    errors = trajectory_errors(Trajectory(stamps, poses), truth).summary()
    return {
        'ate_rmse_m': errors['rmse_m'],
        'live_ate_rmse_m': errors['rmse_m'],
        'heading_rmse_deg': errors['heading_rmse_deg'],
    }


def summarize(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean, deviation, worst and values of each figure over the seeds; None where none has it."""
    out: dict[str, Any] = {}
    for key in COLUMNS:
        values = [None if r.get(key) is None else float(r[key]) for r in rows]
        known = [v for v in values if v is not None]
        worst = min if key in ('precision', 'recall') else max
        out[key] = {
            'mean': float(np.mean(known)) if known else None,
            'deviation': float(np.std(known)) if known else None,
            'worst': worst(known) if known else None,
            'per_seed': values,
        }
    return out


def rows(drives: Mapping[str, Any]) -> list[list[str]]:
    """A row of cells per world and system."""
    out = []
    for name, figures in drives.items():
        row = [name]
        for key, (_, factor, digits) in COLUMNS.items():
            if figures[key]['mean'] is None:
                row.append('-')
                continue
            mean, deviation, worst = (
                f'{factor * figures[key][k]:.{digits}f}' for k in ('mean', 'deviation', 'worst')
            )
            row.append(f'{mean} ± {deviation} ({worst})')
        out.append(row)
    return out
