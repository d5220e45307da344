# SPDX-License-Identifier: Apache-2.0
"""The study's report.html, self-contained, with its figures also as PNG and results.json."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rlml_lab.deformable.ekf import Estimate
from rlml_lab.deformable.experiment import FEATURES, ROWS, Row
from rlml_lab.deformable.monte_carlo import ESTIMATORS, RowResult, Runs, run_estimators
from rlml_lab.deformable.study_deformable_tables import tables
from rlml_lab.support import page
from rlml_slam.errors import RlmlError
from rlml_slam.se2 import Array

matplotlib.use('Agg')

FEATURE_COLORS = ('#0072b2', '#d55e00', '#009e73')
PATH_COLOR = '#cc0077'
ESTIMATOR_COLORS = {
    'ekf': '#d55e00', 'nls': '#0072b2', 'rts': '#56b4e9', 'dead_reckoning': '#999999'
}  # fmt: skip
LABELS = {'ekf': 'EKF', 'nls': 'NLS', 'rts': 'RTS smoother', 'dead_reckoning': 'dead reckoning'}
CHI2_95 = 5.991  # 95 % quantile of chi^2 with 2 degrees of freedom


def write_report(
    directory: Path, summary: Mapping[str, Any], results: Mapping[Row, RowResult], seed: int
) -> None:
    """Write report.html, results.json and one PNG per figure into ``directory``."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / 'results.json').write_text(json.dumps(summary, indent=1), encoding='utf-8')
    except OSError as e:
        raise RlmlError(f'{directory}: cannot be written: {e.strerror}') from e
    figures = [('comparison', 'All rows', draw_comparison(summary, results))]
    for row in ROWS:
        if row in results:
            runs = run_estimators(row, range(seed, seed + 1))
            title = f'{row.name}, seed {seed}'
            figures.append((row.name.replace(' ', '_'), title, draw_run(row, runs)))
    parts = [_table(*t) for t in tables(dict(summary))]
    parts.append(_claims(summary['claims']))
    for name, title, figure in figures:
        png = directory / f'{name}.png'
        figure.savefig(png, dpi=110, bbox_inches='tight', metadata={'Software': None})
        parts += [page.heading(title), page.picture(png.read_bytes(), title)]
    lead = (
        f'{summary["seeds"]} seeds per row, the same seeds in every row; {summary["wall_s"]} s. A '
        'robot accompanies three features that move and deform over 20 poses. Both estimators are '
        'given the same measurements: odometry, sightings, construction edges and the nominal '
        'motion of the features.'
    )
    text = page.page('Deformable-feature SLAM: EKF against NLS', lead, parts)
    (directory / 'report.html').write_text(text, encoding='utf-8')


def _table(title: str, header: list[str], lines: list[list[str]]) -> str:
    return page.heading(title) + page.table(header, lines)


def _claims(claims: list[dict[str, Any]]) -> str:
    lines = ''.join(
        f'<tr><td>{html.escape(c["claim"])}</td><td>{html.escape(c["where"])}</td>'
        f'<td>{html.escape(c["found"])}</td>'
        f'<td class="{"yes" if c["holds"] else "no"}">{"yes" if c["holds"] else "no"}</td></tr>'
        for c in claims
    )
    return (f'<h2>What may be claimed from {len(claims)} comparisons</h2><details open><summary>'
            f'{sum(c["holds"] for c in claims)} hold</summary><div class="wide"><table><thead><tr>'
            '<th>claim</th><th>where</th><th>found</th><th>holds</th></tr></thead>'
            f'<tbody>{lines}</tbody></table></div></details>')  # fmt: skip


def draw_comparison(summary: Mapping[str, Any], results: Mapping[Row, RowResult]) -> Figure:
    """Mean errors of all rows, paired differences, and how often a single run agrees."""
    names = list(summary['rows'])
    figure = Figure(figsize=(14, 0.55 * len(names) + 1.8), layout='constrained')
    left, middle, right = figure.subplots(1, 3, sharey=True)
    y = np.arange(len(names))[::-1]
    for k, e in enumerate(ESTIMATORS):
        mean, half = np.array([summary['rows'][n]['ss3'][e] for n in names]).T
        left.errorbar(mean, y + 0.24 - 0.16 * k, xerr=half, fmt='o', ms=4, capsize=3,
                      color=ESTIMATOR_COLORS[e], label=LABELS[e])  # fmt: skip
    left.set(xscale='log', xlabel='pose error ss3, mean ± 95 % CI', title='pose error')
    left.set_xticks([0.5, 1, 2, 4], ['0.5', '1', '2', '4'])
    left.minorticks_off()
    left.set_yticks(y, names)
    left.set_ylim(-1.6, len(names) - 0.4)  # room for the legends
    left.legend(loc='lower center', ncols=2, fontsize=8)
    for k, (pair, color, label) in enumerate(
        (('nls-ekf', '#222222', 'NLS − EKF'), ('rts-ekf', ESTIMATOR_COLORS['rts'], 'RTS − EKF'),
         ('nls-rts', ESTIMATOR_COLORS['nls'], 'NLS − RTS'))
    ):  # fmt: skip
        mean, half = np.array([summary['rows'][n]['paired'][pair] for n in names]).T
        middle.errorbar(mean, y + 0.2 - 0.2 * k, xerr=half, fmt='o', ms=4, capsize=3,
                        color=color, label=label)  # fmt: skip
    middle.axvline(0.0, color='#888888', lw=0.8)
    middle.set(xlabel='difference of ss3 on the same seeds', title='paired differences')
    middle.legend(loc='lower center', ncols=3, fontsize=8)
    ratios = [r.ss3('nls') / r.ss3('ekf') for r in (results[Row(*n.split())] for n in names)]
    right.boxplot(ratios, positions=y, orientation='horizontal', widths=0.5, whis=(5, 95),
                  showfliers=False, manage_ticks=False,
                  medianprops={'color': ESTIMATOR_COLORS['nls']})  # fmt: skip
    right.axvline(1.0, color='#888888', lw=0.8)
    right.set(xscale='log', xlabel='NLS / EKF in a single run (box 50 %, whiskers 90 %)',
              title='single runs')  # fmt: skip
    right.set_xticks([0.2, 0.5, 1, 2, 5], ['0.2', '0.5', '1', '2', '5'])
    right.minorticks_off()
    return figure


def draw_run(row: Row, runs: Runs) -> Figure:
    """One run in the manner of the note's figures: (a) EKF-based, (b) NLS-based."""
    wide = row.path == 'straight'
    figure = Figure(figsize=(14, 8.8) if wide else (14, 8.2), layout='constrained')
    panels = figure.subplots(*((2, 1) if wide else (1, 2)), sharex=True, sharey=True)
    estimates = (('ekf', runs.ekf), ('nls', Estimate(runs.nls.mean, runs.nls.cov)))
    for axes, letter, (name, estimate) in zip(panels, 'ab', estimates, strict=True):
        error2 = ((estimate.mean[0, :, :3] - runs.truth[0, :, :3]) ** 2).sum()
        _draw_panel(axes, runs, estimate)
        # a straight run is 40 m by a few: its y is stretched so that the errors can be seen
        axes.set_aspect('auto' if wide else 'equal')
        if wide:
            axes.set_ylabel('y [m], stretched')
        axes.set_title(f'({letter}) {LABELS[name]}: ss3 = {error2:.3f}', loc='left')
    figure.legend(handles=_legend(), ncols=7, fontsize=9, loc='outside lower center')
    return figure


def _draw_panel(axes: Axes, runs: Runs, estimate: Estimate) -> None:
    truth, mean, cov = runs.truth[0], estimate.mean[0], estimate.cov[0]
    seen = ~np.isnan(runs.measurements.sigma[0])
    for j in range(FEATURES):
        k = slice(3 + 2 * j, 5 + 2 * j)
        points, feature_color = truth[:, k], FEATURE_COLORS[j]
        shape: dict[str, Any] = {'color': feature_color, 'ls': '', 'ms': 4}
        axes.plot(*points.T, color=feature_color, lw=0.6, alpha=0.5)
        axes.plot(*points[seen[:, j]].T, marker='o', **shape)
        axes.plot(*points[~seen[:, j]].T, marker='o', mfc='none', **shape)
        axes.plot(*mean[:, k].T, marker='x', zorder=4, **shape)
        _ellipses(axes, mean[:, k], cov[:, k, k], feature_color)
        lines = np.stack([truth[seen[:, j], :2], points[seen[:, j]]], 1)
        axes.add_collection(LineCollection(list(lines), colors='#bbbbbb', lw=0.5, zorder=1))
    axes.plot(*truth[:, :2].T, 'k.-', lw=1.2, ms=5, zorder=5)
    axes.plot(*runs.reckoned[0, :, :2].T, ':', color=ESTIMATOR_COLORS['dead_reckoning'], lw=1.4)
    axes.plot(*mean[:, :2].T, '.-', color=PATH_COLOR, lw=1.2, ms=5, zorder=6)
    _ellipses(axes, mean[:, :2], cov[:, :2, :2], PATH_COLOR)
    axes.set(xlabel='x [m]', ylabel='y [m]')
    axes.grid(alpha=0.2)


def _ellipses(axes: Axes, centers: Array, cov: Array, color: str) -> None:
    """95 % ellipses at ``centers`` (n, 2) with ``cov`` (n, 2, 2)."""
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(CHI2_95 * np.maximum(values, 0.0))[:, None]
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    outlines = centers[:, None] + np.einsum(
        'nab,kb->nka', root, np.stack([np.cos(angle), np.sin(angle)], -1)
    )
    axes.add_collection(
        PolyCollection(list(outlines), facecolors='none', edgecolors=color, lw=0.7, alpha=0.7)
    )


def _legend() -> list[Line2D]:
    grey = '#555555'

    def entry(label: str, **style: Any) -> Line2D:
        return Line2D([], [], label=label, **style)

    return [
        entry('true path', color='k', marker='.'),
        entry('estimated path, 95 % ellipses', color=PATH_COLOR, marker='.'),
        entry('dead reckoning', color=ESTIMATOR_COLORS['dead_reckoning'], ls=':'),
        entry('true feature, seen', color=grey, marker='o', ms=4, ls=''),
        entry('true feature, not seen', color=grey, marker='o', ms=4, ls='', mfc='none'),
        entry('estimated feature', color=grey, marker='x', ms=4, ls=''),
        entry('sighting', color='#bbbbbb', lw=0.8),
    ]
