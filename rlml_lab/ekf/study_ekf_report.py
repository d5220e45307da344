# SPDX-License-Identifier: Apache-2.0
"""The page of ``rlml-lab study ekf``: tables, errors of all systems, and NEES."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rlml_lab.ekf import study_ekf_drives as drives
from rlml_lab.ekf import study_ekf_speed as speed
from rlml_lab.ekf.study_ekf_consistency import CASES, HEADER, SYSTEMS, Series, rows
from rlml_lab.support import page
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.report.outputs import make_folder
from rlml_slam.report.pictures import CLOSURE, LIVE, PATH, TRUTH, png

COLORS = {'additive': LIVE, 'invariant': CLOSURE, 'rlml': PATH}
NAMES = {'additive': "EKF, the note's error", 'invariant': 'EKF, invariant error', 'rlml': 'RLML'}


def write_report(folder: Path, summary: Mapping[str, Any], series: Mapping[str, Series]) -> None:
    """Write report.html, results.json and the pictures as PNG into a folder."""
    folder = make_folder(folder)
    pictures = {'errors': draw_errors(summary)}
    parts = [
        page.heading('Drives'),
        page.paragraph(
            'Anonymous detections, the odometry and IMU of the simulator, default parameters; '
            'mean ± standard deviation over the seeds (worst seed).'
        ),
        page.table(drives.HEADER, drives.rows(summary['drives'])),
        page.picture(pictures['errors'], 'Position RMSE as published live, every seed'),
    ]
    if series:
        pictures['consistency'] = draw_consistency(series)
        parts += [
            page.heading('Consistency over the first loop, associations known'),
            page.paragraph(
                'Wheels and reflectors only, each with the noise that the systems believe. '
                + '; '.join(describe(name) for name in CASES)
                + '.'
            ),
            page.table(HEADER, rows(summary['consistency'])),
            *map(page.paragraph, verdicts(summary['consistency'])),
            page.picture(
                pictures['consistency'],
                'Mean NEES of the live pose over the seeds, with its two-sided 95 % bounds, and '
                'RMS heading error',
            ),
        ]
    parts += [page.heading('Speed'), *map(page.paragraph, speed.lines(summary['speed']))]
    for name, data in pictures.items():
        write_atomically(folder / f'{name}.png', data)
    write_atomically(folder / 'results.json', (json.dumps(summary, indent=1) + '\n').encode())
    lead = f'{summary["seeds"]} seeds; {summary["wall_s"]:.0f} s.'
    write_atomically(folder / 'report.html', page.page('EKF-SLAM and RLML', lead, parts).encode())


def describe(name: str) -> str:
    """A case in words."""
    c = CASES[name]
    return (
        f'{name}: turn noise {c.turn_noise} rad/s, reflectors seen within {c.max_range:.0f} m '
        f'to {c.bearing_noise} rad'
    )


def verdicts(consistency: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """For each case and system: whether its covariance is that of its errors, in words."""
    out = []
    for name, s in consistency.items():
        case, system = name.rsplit(', ', 1)
        low, high = s['bounds']
        inside = f'{s["share_inside"]:.0%} of the instants lie inside {low:.2f} to {high:.2f}'
        if low <= s['nees_mean'] <= high:
            verdict = f'consistent: mean NEES {s["nees_mean"]:.2f}, {inside}'
        elif s['nees_mean'] > high:
            verdict = (
                f'inconsistent, it believes too much: mean NEES {s["nees_mean"]:.2f}, {inside}, '
                f'first above at {s["first_above_s"]:.1f} s'
            )
        else:
            verdict = f'believes too little: mean NEES {s["nees_mean"]:.2f}, {inside}'
        out.append(f'{NAMES[system]}, {case}: {verdict}.')
    return out


def draw_errors(summary: Mapping[str, Any]) -> bytes:
    """Live position RMSE of every seed by world and system, on a logarithmic scale."""
    names = list(summary['drives'])
    figure = Figure(figsize=(9, 0.38 * len(names) + 1.2), layout='constrained')
    axes = figure.add_subplot()
    for k, name in enumerate(names):
        values = [v for v in summary['drives'][name]['live_ate_rmse_m']['per_seed'] if v]
        y = np.full(len(values), len(names) - 1 - k)
        axes.plot(100 * np.array(values), y, 'o', ms=4, alpha=0.5, color=PATH, mew=0)
    axes.set_yticks(range(len(names))[::-1], names)
    axes.set(xscale='log', xlabel='live position RMSE [cm]')
    axes.grid(True, axis='x', alpha=0.4)
    return png(figure)


def draw_consistency(series: Mapping[str, Series]) -> bytes:
    """NEES and heading error over time, a column for each case."""
    figure = Figure(figsize=(12, 6), layout='constrained')
    panels = figure.subplots(2, len(CASES), sharex='col', squeeze=False)
    for k, case in enumerate(CASES):
        top, bottom = panels[0, k], panels[1, k]
        for system in SYSTEMS:
            s = series[f'{case}, {system}']
            label = {'color': COLORS[system], 'lw': 1.1, 'label': NAMES[system]}
            top.plot(s.times, s.mean, **label)
            rms = np.degrees(np.sqrt((s.heading**2).mean(axis=0)))
            bottom.plot(s.times, rms, **label)
        low, high = s.bounds
        top.axhspan(low, high, color=TRUTH, alpha=0.15, lw=0, label='95 % bounds')
        top.axhline(3.0, color=TRUTH, lw=0.7)
        top.set(title=case, yscale='log')
        bottom.set(xlabel='time [s]')
        for axes in (top, bottom):
            axes.grid(True, alpha=0.3)
    panels[0, 0].set_ylabel('mean NEES')
    panels[1, 0].set_ylabel('RMS heading error [°]')
    panels[0, 0].legend(fontsize=8, loc='upper right')
    return png(figure)
