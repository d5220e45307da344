# SPDX-License-Identifier: Apache-2.0
"""Whether the published covariance is true: pose NEES over the first loop, associations known.

Reflectors have ids, there are no ghosts, and the filters know the wheels' noise exactly;
what is left is the estimator. The NEES of N drives at one instant is chi^2 of 3 N degrees of
freedom over N if the covariance is right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rlml_lab.support.drives import observe, process, simulate
from rlml_lab.support.parallel_jobs import Workers, each
from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.metrics import nees
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import EkfParameters, SimulatorParameters, from_mapping
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Detections, Odometry

SYSTEMS = ('additive', 'invariant', 'rlml')  # the two errors of the EKF, and RLML
CONFIDENCE = 0.95
DURATION = 85.0  # [s] the first loop of the demo world and a little more
HEADER = ['drive, system', 'mean NEES', '95 % bounds', 'inside', 'above', 'heading [°]',
          'position [cm]', 'NEES, last third']  # fmt: skip


@dataclass(frozen=True)
class Case:
    """What differs from the demo: the wheels' turn noise [rad/s], and how far reflectors show."""

    turn_noise: float
    max_range: float
    bearing_noise: float


CASES = {
    'demo': Case(0.01, 25.0, 0.003),
    'poor wheels and bearings': Case(0.2, 8.0, 0.05),
}


@dataclass(frozen=True)
class Series:
    """NEES and errors (seeds, n) of one system in one case at the seconds ``times`` (n,)."""

    times: Array
    nees: Array
    heading: Array
    position: Array

    @property
    def bounds(self) -> tuple[float, float]:
        """Of the mean NEES over the seeds at one instant, two-sided."""
        n = len(self.nees)
        low, high = chi2.ppf([0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE], 3 * n) / n
        return float(low), float(high)

    @property
    def mean(self) -> Array:
        """Mean NEES over the seeds (n,)."""
        return np.asarray(self.nees.mean(axis=0))

    def summary(self) -> dict[str, Any]:
        """Figures of the series."""
        low, high = self.bounds
        above = self.times[self.mean > high]
        return {
            'seeds': len(self.nees),
            'nees_mean': float(self.nees.mean()),
            'bounds': [low, high],
            'share_inside': float(np.mean((self.mean >= low) & (self.mean <= high))),
            'share_above': float(np.mean(self.mean > high)),
            'first_above_s': float(above[0]) if len(above) else None,
            'last_third_nees': float(self.nees[:, -len(self.times) // 3 :].mean()),
            'heading_rmse_deg': float(np.degrees(np.sqrt((self.heading**2).mean()))),
            'position_rmse_m': float(np.sqrt((self.position**2).mean())),
        }


def rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """A row of cells per case and system."""
    return [
        [
            name,
            f'{s["nees_mean"]:.2f}',
            f'{s["bounds"][0]:.2f} to {s["bounds"][1]:.2f}',
            f'{s["share_inside"]:.0%}',
            f'{s["share_above"]:.0%}',
            f'{s["heading_rmse_deg"]:.3f}',
            f'{100 * s["position_rmse_m"]:.1f}',
            f'{s["last_third_nees"]:.2f}',
        ]
        for name, s in summary.items()
    ]


def run_all(seeds: int, workers: Workers, quiet: bool) -> dict[str, Series]:
    """All cases over all seeds, by '<case>, <system>'."""
    tasks = [(case, seed) for case in CASES for seed in range(seeds)]
    found: dict[str, dict[int, CaseErrors]] = {}
    with Progress('known associations', len(tasks), quiet) as progress:
        for k, ((case, seed), by_system) in enumerate(each(evaluate_case, tasks, workers), 1):
            for system, errors in by_system.items():
                found.setdefault(f'{case}, {system}', {})[seed] = errors
            progress.update(k, f'{case}, seed {seed}')
    order = [f'{case}, {system}' for case in CASES for system in SYSTEMS]
    return {name: series([found[name][s] for s in sorted(found[name])]) for name in order}


@dataclass(frozen=True)
class CaseErrors:
    """One run at its stamps: NEES, heading error [rad] and position error [m], each (n,)."""

    stamps: NDArray[np.int64]
    nees: Array
    heading: Array
    position: Array


def series(runs: Sequence[CaseErrors]) -> Series:
    """The runs at the instants that all of them know."""
    common = runs[0].stamps[np.isfinite(runs[0].nees)]
    for r in runs[1:]:
        common = np.intersect1d(common, r.stamps[np.isfinite(r.nees)])
    at = [np.searchsorted(r.stamps, common) for r in runs]
    return Series(
        (common - runs[0].stamps[0]) * 1e-9,
        np.array([r.nees[k] for r, k in zip(runs, at, strict=True)]),
        np.array([r.heading[k] for r, k in zip(runs, at, strict=True)]),
        np.array([r.position[k] for r, k in zip(runs, at, strict=True)]),
    )


def simulator(case: Case) -> SimulatorParameters:
    """The demo world as the case has it; the laser's beams are of no use here."""
    p: SimulatorParameters = from_mapping(
        {
            'world': 'hall',
            'duration': DURATION,
            'laser.beams': 8,
            'gyro.rate': 1.0,
            'wheels.turn_noise_floor': case.turn_noise,
            'markers.ids': True,
            'markers.false_detections': 0.0,
            'markers.max_range': case.max_range,
            'markers.sigma_bearing': case.bearing_noise,
        },
        SimulatorParameters,
    )
    return p


def knows(p: SimulatorParameters) -> EkfParameters:
    """Parameters of a system that knows the simulator's noise, and uses wheels and reflectors."""
    w = p.wheels
    values = {f'motion.{k}': getattr(w, k) for k in ('a', 'b', 'c', 'd', 'lateral', 'interval')}
    params: EkfParameters = from_mapping(
        {
            **values, 'motion.long_interval_noise': 0.0, 'motion.scale_error_sigma': (0.0, 0.0),
            'use_imu': False, 'use_scan': False,
            'ekf.min_sightings': 1, 'reflector.min_sightings': 1,
        },
        EkfParameters,
    )  # fmt: skip
    return params


def evaluate_case(name: str, seed: int) -> dict[str, CaseErrors]:
    """All systems on the first loop of one drive."""
    p = simulator(CASES[name])
    messages, truth = simulate(p, seed)
    end = first_loop(truth.trajectory)
    params = knows(p)
    used = [m for m in messages if m.stamp <= end and isinstance(m, Odometry | Detections)]
    observations = observe(used, params, p)
    out = {}
    for system in SYSTEMS:
        slam: Slam | EkfSlam = Slam(params)
        if system != 'rlml':
            slam = EkfSlam(replace(params, ekf=replace(params.ekf, error_model=system)))
        log = FrameLog()
        for frames in process(slam, observations):
            log.add(frames)
        errors = trajectory_errors(log.trajectory(), truth.trajectory)
        out[system] = CaseErrors(
            errors.stamps,
            nees(errors, np.array(log.covs)),
            errors.errors[:, 2],
            errors.distances,
        )
    return out


def first_loop(path: Trajectory, near: float = 1.0, far: float = 5.0) -> int:
    """Stamp at which the robot is first back within ``near`` of its start, having been far."""
    d = np.hypot(*(path.poses[:, :2] - path.poses[0, :2]).T)
    away = np.flatnonzero(d > far)
    back = np.flatnonzero(d[away[0] :] < near) if len(away) else away
    return int(path.stamps[away[0] + back[0]] if len(back) else path.stamps[-1])
