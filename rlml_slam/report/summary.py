# SPDX-License-Identifier: Apache-2.0
"""The figures of a run as a table for people."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlml_slam.evaluation.run_record import Run

RARE = 0.005  # share of the frames, from which on a reason is a row


def summary_rows(f: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(what, figure) of the figures of metrics.json that a person looks at first."""
    sent = f' of {f["scans_published"]}' if 'scans_published' in f else ''
    rows = [('scans', f'{f["scans"]}{sent} in {f["duration_s"]:.1f} s')]
    if f['real_time_factor']:
        rows.append(('speed', f'{f["real_time_factor"]:.1f} × real time ({f["wall_s"]:.1f} s)'))
    for name, key, decimals in (
        ('front end per scan', 'front_end_ms', 2),
        ('back end per keyframe', 'back_end_ms', 2),
        ('scan to pose', 'latency_ms', 1),
    ):
        ms = f.get(key, {'median': None})
        if ms['median'] is not None:
            median = f'median {ms["median"]:.{decimals}f} ms'
            rows.append((name, f'{median}, p99 {ms["p99"]:.1f}, max {ms["max"]:.1f}'))
    c = f['closures']
    rows.append(('keyframes', f'{f["keyframes"]}'))
    rows.append(('loop closures', f'{c["accepted"]} accepted, {c["rejected"]} rejected'))
    rows.append(('reflectors', f'{f["reflectors"]}'))
    if 'survey' in f:
        rows.append(('survey', survey_row(f['survey'])))
    rows.append(('health', ', '.join(f'{v:.1%} {k}' for k, v in f['health'].items() if v > 0.0)))
    rows += [('', f'{v:.1%} {why}') for why, v in f.get('health_reasons', {}).items() if v >= RARE]
    for stream, fate in f['inputs'].items():
        listed = ', '.join(f'{n} {what}' for what, n in fate.items() if n or what == 'used')
        # a bag may have one only topic of a type, by whatever name: the reader has to know
        source = f' ({f["topics"][stream]})' if stream in f['topics'] else ''
        rows.append((f'input {stream}', listed + source))
    rows.append(('memory', f'{f["peak_rss_mb"]:.0f} MB'))
    return rows + _truth_rows(f)


def survey_row(survey: Mapping[str, Any]) -> str:
    """How the map and its survey agree."""
    if not survey['found']:
        return f'the map is not found in it: {survey["why"]}'
    counts = ', '.join(f'{len(survey[k])} {k}' for k in ('missing', 'moved', 'new'))
    return f'{survey["why"]}, RMSE {1e3 * survey["rmse_m"]:.1f} mm; {counts}'


def _truth_rows(f: Mapping[str, Any]) -> list[tuple[str, str]]:
    if 'ate_rmse_m' not in f:
        return []
    aligned = '' if f['alignment'] == 'none' else ', aligned'
    live = f'{f["live_ate_rmse_m"]:.3f} m RMSE, max {f["live_ate_max_m"]:.3f}{aligned}'
    rows = [('error, live', live), ('error, optimised', f'{f["ate_rmse_m"]:.3f} m RMSE{aligned}')]
    if 'heading_rmse_deg' in f:
        live = f'{f["live_heading_rmse_deg"]:.3f}° live'
        rows.append(('heading error', f'{live}, {f["heading_rmse_deg"]:.3f}° optimised'))
    if 'nees_mean' in f:
        rows.append(('NEES', f'{f["nees_mean"]:.2f} (3 is ideal)'))
    if f.get('reflector_rmse_m') is not None:
        error = (
            f'{f["reflector_rmse_m"]:.3f} m RMSE; {f["reflectors_found"]} of '
            f'{f["reflectors_true"]} found, {f["reflectors_twice"]} twice, '
            f'{f["reflectors_spurious"]} spurious'
        )
        rows.append(('reflector error', error))
    return rows


def summary_text(title: str, figures: Mapping[str, Any]) -> str:
    """The table as plain text."""
    rows = summary_rows(figures)
    width = max(len(name) for name, _ in rows)
    return '\n'.join([title, *(f'  {name:<{width}}  {value}' for name, value in rows)])


def print_summary(
    run: Run, figures: Mapping[str, Any], folder: Path, as_json: bool, report: bool = True
) -> int:
    """Print the figures of a run whose results are in a folder, and its problem; the exit code."""
    if as_json:
        print(json.dumps(figures))
    else:
        print(summary_text(run.name, figures))
        print(f'report: {folder / "report.html"}' if report else f'results: {folder}')
    if run.problem:
        print(f'rlml: {run.problem}', file=sys.stderr)
    return 1 if run.problem else 0
