# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study deformable --window``: the sliding window of deformable_slam over a long drive.

Independent runs beside a simulated train and a simulated conveyor, through all that the node does
but DDS. The normalised error (NEES) is averaged over the runs, whose errors are independent: its
mean over time varies less than one sample does, so one sample's bounds hold for it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from rlml_lab.carrier.carrier import CarrierStep, simulate_carrier, true_features
from rlml_lab.carrier.carrier_parameters import Carrier
from rlml_lab.deformable.scoring import chi2_bounds
from rlml_lab.support.parallel_jobs import Workers, each
from rlml_slam.deformable.slam import DeformableSlam
from rlml_slam.deformable.window import CarrierVelocity, WindowEstimate
from rlml_slam.params import DeformableParameters
from rlml_slam.se2 import Array, wrap
from rlml_slam.types import Observation

KINDS = ('train', 'conveyor')
MINUTE = 60.0
WARM = 100  # updates in which the window fills and memory is allocated


@dataclass(frozen=True)
class WindowRun:
    """One drive of n updates: per update NEES of the pose and of the whole state.

    ``degrees`` (n,) of the latter; ``error`` (n, 3) of the pose; ``wall`` and ``cpu`` (n,)
    seconds of an update; ``rss`` bytes after WARM updates and at the end, 0 where unknown.
    """

    pose: Array
    whole: Array
    degrees: Array
    error: Array
    wall: Array
    cpu: Array
    rss: tuple[int, int]


def run_window(kind: str, minutes: float, seed: int, ids: bool) -> WindowRun:
    """Drive one system beside one carrier; anonymous detections come with ghosts."""
    settings = Carrier(kind=kind, ids=ids, false_detections=0.0 if ids else 0.05)
    count = round(minutes * MINUTE * settings.rate)
    slam, owner = DeformableSlam(DeformableParameters()), dict[int, int]()
    rows = np.full((count, 8), np.nan)  # filled, so that its memory is there from the start
    previous = memory = 0
    for k, step in enumerate(islice(simulate_carrier(settings, seed), count)):
        slam.announce(previous, CarrierVelocity(step.linear, step.angular))
        previous = step.stamp
        observation = Observation(step.stamp, step.motion, detections=step.detections)
        wall, cpu = time.perf_counter(), time.thread_time()
        frame = slam.process(observation)
        rows[k, :2] = time.perf_counter() - wall, time.thread_time() - cpu
        assert slam.estimate is not None
        for key, seen in zip(frame.landmarks.tolist(), step.seen.tolist(), strict=True):
            if key >= 0:
                owner[key] = seen
        rows[k, 2:] = _score(slam.estimate, step, owner)
        if k == WARM:
            memory = resident()
    return WindowRun(
        rows[:, 2], rows[:, 3], rows[:, 4], rows[:, 5:], rows[:, 0], rows[:, 1],
        (memory, resident()),
    )  # fmt: skip


def _score(
    estimate: WindowEstimate, step: CarrierStep, owner: dict[int, int]
) -> tuple[float, float, int, float, float, float]:
    """NEES of the pose, of the whole state, its degrees, and the pose's error."""
    true = true_features(step)
    f = estimate.features
    known = [k for k, key in enumerate(f.keys.tolist()) if owner.get(key) in true]
    state = [0, 1, 2, *(3 + 2 * k + r for k in known for r in range(2))]
    d = estimate.pose - step.pose
    d[2] = wrap(d[2])
    e = np.concatenate([d, *(f.points[k] - true[owner[int(f.keys[k])]] for k in known)])
    P = estimate.joint_cov[np.ix_(state, state)]
    pose = float(d @ np.linalg.solve(P[:3, :3], d))
    return pose, float(e @ np.linalg.solve(P, e)), len(e), *d.tolist()


def resident() -> int:
    """Memory of this process in RAM [bytes], 0 where the system does not say."""
    try:
        status = Path('/proc/self/status').read_text(encoding='ascii')
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in status.splitlines()
                 if line.startswith('VmRSS')), 0)  # fmt: skip


def run_all(minutes: float, runs: int, ids: bool, workers: Workers) -> dict[str, list[WindowRun]]:
    """Runs with seeds 0 .. runs-1 beside each kind of carrier; a bar on stderr shows them."""
    tasks = [(kind, minutes, seed, ids) for seed in range(runs) for kind in KINDS]
    done: dict[tuple[str, int], WindowRun] = {}
    with Progress(
        '{task.description}', BarColumn(), MofNCompleteColumn(), 'runs', TimeElapsedColumn(),
        console=Console(stderr=True),
    ) as progress:  # fmt: skip
        bar = progress.add_task('driving', total=len(tasks))
        for (kind, _, seed, _), run in each(run_window, tasks, workers):
            done[kind, seed] = run
            progress.advance(bar)
    return {kind: [done[kind, seed] for seed in range(runs)] for kind in KINDS}


def summarize(results: dict[str, list[WindowRun]]) -> dict[str, Any]:
    """Figures of each kind: NEES with its bounds, errors, time per update, memory."""
    return {kind: _figures(runs) for kind, runs in results.items()}


def _figures(runs: list[WindowRun]) -> dict[str, Any]:
    settled = slice(WARM, None)
    degrees = float(np.mean([r.degrees[settled] for r in runs]))
    minutes = list(_minutes(len(runs[0].wall)))
    wall = np.concatenate([r.wall[settled] for r in runs])
    cpu = np.concatenate([r.cpu[settled] for r in runs])
    return {
        'runs': len(runs),
        'updates': len(runs[0].wall),
        'nees_pose': float(np.mean([r.pose[settled] for r in runs])),
        'nees_pose_bounds': chi2_bounds(3, len(runs)),
        'nees': float(np.mean([r.whole[settled] for r in runs])),
        'nees_degrees': degrees,
        'nees_bounds': chi2_bounds(round(degrees), len(runs)),
        'nees_by_minute': [float(np.mean([r.whole[m] for r in runs])) for m in minutes],
        'position_rmse_m_at_end': _rms(np.array([r.error[-1, :2] for r in runs]) * np.sqrt(2.0)),
        'heading_rmse_rad_at_end': _rms(np.array([r.error[-1, 2] for r in runs])),
        'wall_ms': {p: 1e3 * float(np.percentile(wall, q)) for p, q in _SHARES},
        'cpu_ms': {p: 1e3 * float(np.percentile(cpu, q)) for p, q in _SHARES},
        'cpu_ms_by_minute': [
            1e3 * float(np.median([r.cpu[m] for r in runs])) for m in minutes
        ],
        'rss_growth_kB': [(r.rss[1] - r.rss[0]) // 1024 for r in runs],
    }  # fmt: skip


_SHARES = (('p50', 50.0), ('p99', 99.0), ('max', 100.0))


def _minutes(count: int) -> Iterator[slice]:
    """Updates of each whole minute at 10 Hz, or of all where there is none."""
    step = min(round(MINUTE * Carrier().rate), count)
    for k in range(0, count - step + 1, step):
        yield slice(k, k + step)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def claims(summary: dict[str, Any]) -> list[tuple[str, bool]]:
    """What the window must show, and whether it does."""
    out = []
    for kind, f in summary.items():
        low, high = f['nees_pose_bounds']
        out.append((f'{kind}: NEES of the pose is consistent', low < f['nees_pose'] < high))
        low, high = f['nees_bounds']
        out.append((f'{kind}: NEES of the whole state is consistent', low < f['nees'] < high))
        # one thread that never waits: its CPU time is the wall time of a machine that is free
        out.append((f'{kind}: p99 of an update is at most 10 ms', f['cpu_ms']['p99'] <= 10.0))
        by_minute = f['cpu_ms_by_minute']
        out.append((f'{kind}: the last minute costs what the second does',
                    by_minute[-1] < 1.2 * by_minute[min(1, len(by_minute) - 1)]))  # fmt: skip
        # the arena of the allocator breathes by some hundred kB
        grown = max(f['rss_growth_kB'])
        out.append((f'{kind}: memory grows by less than 4 MB', grown < 4096))
    return out


def lines(f: dict[str, Any]) -> dict[str, str]:
    """The table's column of one kind."""
    pose, whole = f['nees_pose_bounds'], f['nees_bounds']
    rmse = f['position_rmse_m_at_end'], 1e3 * f['heading_rmse_rad_at_end']
    return {
        'NEES of the pose (3), 99.9 % bounds': (
            f'{f["nees_pose"]:.2f} ({pose[0]:.2f} … {pose[1]:.2f})'
        ),
        'NEES of the whole state, bounds': (
            f'{f["nees"]:.2f} of {f["nees_degrees"]:.1f} ({whole[0]:.2f} … {whole[1]:.2f})'
        ),
        'the same by minute': _series(f['nees_by_minute'], 1),
        'error at the end: position, heading': f'{rmse[0]:.2f} m, {rmse[1]:.0f} mrad',
        'CPU time of an update, ms: p50, p99, max': _series(f['cpu_ms'].values(), 2),
        'wall time of it, on the machine as loaded': _series(f['wall_ms'].values(), 2),
        'median CPU time by minute, ms': _series(f['cpu_ms_by_minute'], 2),
        'growth of memory, kB, each run': ' '.join(map(str, f['rss_growth_kB'])),
    }


def _series(values: Iterable[float], digits: int) -> str:
    return ' '.join(f'{v:.{digits}f}' for v in values)
