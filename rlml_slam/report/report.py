# SPDX-License-Identifier: Apache-2.0
"""The report of a run: one interactive HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from itertools import groupby
from typing import Any

from rlml_slam.evaluation.metrics import RunErrors
from rlml_slam.evaluation.run_record import Origin, Run
from rlml_slam.evaluation.survey_residuals import changes, name_of
from rlml_slam.report.page import heading, page, section, table
from rlml_slam.report.summary import summary_rows
from rlml_slam.report.viewer import viewer_page
from rlml_slam.report.viewer.columns import columns_of
from rlml_slam.slam.landmarks.reflector_states import PRESENT, describe
from rlml_slam.types import Level


def report_html(run: Run, figures: Mapping[str, Any], errors: RunErrors | None) -> str:
    """The page: key figures, viewer, table of all figures, and spells of bad health."""
    parts = [
        heading(run.name, _subtitle(figures)),
        f'<div class="cards">{"".join(_cards(figures))}</div>',
    ]
    if run.problem:
        parts.append(section('The results are incomplete', '', 'problem', run.problem))
    *viewer, bar, script, code = viewer_page.parts(columns_of(run, errors))
    parts += viewer
    spells = list(bad_spells(run))
    if spells:
        parts.append(section('When it was not OK', table(spells)))
    parts.append(section('Figures', table(summary_rows(figures))))
    if figures.get('survey', {}).get('found'):
        parts.append(section('Reflectors against the survey', table(_residuals(figures))))
    changed = [describe(s).partition(': ') for s in run.reflector_states if s.state != PRESENT]
    if changed:
        rows = [(kind, what) for kind, _, what in changed]
        parts.append(section('New, moved, missing and ghost reflectors', table(rows)))
    return page(run.name, [*parts, bar, script, code], origin_rows(run.origin), viewer_page.head())


def origin_rows(origin: Origin) -> dict[str, str]:
    """What a run was made by, for the footer."""
    rows = {'command': origin.command, 'made from': origin.source}
    if origin.parameters is not None:
        changed = ', '.join(f'{k}={v}' for k, v in origin.parameters.items())
        rows['parameters'] = changed or 'all as by default'
    return {k: v for k, v in rows.items() if v}


def _subtitle(f: Mapping[str, Any]) -> str:
    speed = f', {f["real_time_factor"]:.0f} × real time' if f['real_time_factor'] else ''
    return f'{f["scans"]} scans in {f["duration_s"]:.0f} s{speed}'


def _cards(f: Mapping[str, Any]) -> Iterator[str]:
    """The few figures that show whether the run was good."""
    cards: list[tuple[str, str]] = []
    if 'ate_rmse_m' in f:
        cards.append((f'{100 * f["live_ate_rmse_m"]:.1f} cm', 'position RMSE, live'))
        cards.append((f'{100 * f["ate_rmse_m"]:.1f} cm', 'position RMSE, optimised'))
    if 'live_heading_rmse_deg' in f:
        cards.append((f'{f["live_heading_rmse_deg"]:.2f}°', 'heading RMSE, live'))
    if 'nees_mean' in f:
        cards.append((f'{f["nees_mean"]:.1f}', 'mean NEES (ideal: 3)'))
    if f['front_end_ms']['median'] is not None:
        cards.append((f'{f["front_end_ms"]["median"]:.1f} ms', 'front end per scan, median'))
    cards.append((str(f['reflectors']), 'reflectors'))
    cards.append((str(f['closures']['accepted']), 'loop closures'))
    cards.append((f'{f["health"]["OK"]:.1%}', 'of the time OK'))
    for value, name in cards:
        yield f'<div class="card"><b>{escape(value)}</b><span>{escape(name)}</span></div>'


def _residuals(f: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(reflector, where it is against where it was surveyed)."""
    rows = [
        (name_of(r), f'dx {1e3 * r["dx_m"]:.1f} mm, dy {1e3 * r["dy_m"]:.1f} mm')
        for r in f['survey']['residuals']
    ]
    for line in changes(f['survey']):
        kind, _, what = line.partition(': ')
        rows.append((kind, what))
    return rows


def bad_spells(run: Run, most: int = 20) -> Iterator[tuple[str, str]]:
    """(when, level and reasons) of the spells that were not OK, one per reason, the first ones."""
    f = run.frames
    spells = groupby(range(len(f.stamps)), lambda k: (f.levels[k], f.reasons[k]))
    bad = ((state, list(rows)) for state, rows in spells if state[0] != Level.OK)
    for count, ((level, reasons), rows) in enumerate(bad):
        if count == most:
            yield '…', 'and more'
            return
        a, b = ((f.stamps[k] - f.stamps[0]) * 1e-9 for k in (rows[0], rows[-1]))
        yield f'{a:.1f} to {b:.1f} s', f'{Level(level).name}: {"; ".join(reasons)}'
