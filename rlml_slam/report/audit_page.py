# SPDX-License-Identifier: Apache-2.0
"""The files of an audit: audit.json, a map of what was found, and a page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.planning.audit.audit import Audit
from rlml_slam.planning.audit.findings import Kind
from rlml_slam.report import pictures as draw
from rlml_slam.report.outputs import make_folder, write_json
from rlml_slam.report.page import headed_table, heading, page, picture, section
from rlml_slam.report.plan_page import cm
from rlml_slam.types import Level

CAPTION = 'Where the robot was, and what was found, by its rank in the table'
MARGIN = 1.5  # [m] around what is drawn
AREA_HEADER = ('area', 'scans', 'seen of expected', 'planned [cm]', 'measured [cm]',
               'published [cm]', 'residuals / sigma', 'OK')  # fmt: skip
FINDING_HEADER = ('rank', 'kind', 'what', 'what to do')


def write_audit(audit: Audit, name: str, folder: Path) -> None:
    """Write audit.json, audit.png and audit.html, each whole or not at all."""
    folder = make_folder(folder)
    image = picture_of(audit)
    write_atomically(folder / 'audit.png', image)
    write_json(folder / 'audit.json', audit.figures)
    write_atomically(folder / 'audit.html', _page(name, audit, image).encode())


def area_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The table of areas; sigmas are medians of one scan by reflectors, and as published."""
    rows: list[tuple[str, ...]] = [AREA_HEADER]
    for r in found['areas']:
        seen = f'{r["seen"]} of {r["expected"]}'
        ratio = '' if r['residual_ratio'] is None else f'{r["residual_ratio"]:.2f}'
        sigmas = [cm(r[f'{k}_sigma_m']) for k in ('planned', 'measured', 'published')]
        rows.append((r['area'], str(r['scans']), seen, *sigmas, ratio, f'{r["ok_share"]:.0%}'))
    return rows


def finding_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The table of findings, the most important first."""
    return [FINDING_HEADER, *((str(k), f['kind'], f['what'], f['advice'])
            for k, f in enumerate(found['findings'], 1))]  # fmt: skip


def picture_of(audit: Audit) -> bytes:
    """The grid, the places of the scans by health, the layout, and the findings by rank."""
    e = audit.evidence
    figure = Figure(figsize=(9.0, 6.5), layout='constrained')
    axes = figure.add_subplot()
    draw.dress(axes, 'x [m]', 'y [m]')
    axes.grid(False)
    draw.draw_grid(axes, e.site.grid)
    at, levels = e.sightings.poses, e.sightings.levels
    for level in (Level.OK, Level.DEGRADED):
        if (mine := levels == level).any():
            axes.plot(*at[mine, :2].T, '.', ms=3, color=draw.LEVELS[level], label=level.name,
                      zorder=2)  # fmt: skip
    ghosts = e.points[e.match < 0]
    if len(ghosts):
        axes.plot(*ghosts.T, 'x', ms=4, color=draw.INK, label='not in the layout', zorder=2)
    axes.plot(*e.site.reflectors.points.T, 'D', color=draw.REFLECTOR, mec='white', ms=5,
              label='layout', zorder=3)  # fmt: skip
    for k, f in enumerate(audit.findings, 1):
        axes.plot(f.x, f.y, 'o', mfc='none', mec=draw.INK, ms=15, zorder=4)
        axes.annotate(
            str(k), (f.x, f.y), (9, 9), textcoords='offset points', color=draw.INK, zorder=5
        )
        if f.kind is Kind.MIRROR:
            axes.plot(*f.wall.T, '-', color=draw.INK, lw=2.5, zorder=4)
    shown = np.concatenate(
        [
            at[:, :2],
            e.site.reflectors.points,
            np.array([(f.x, f.y) for f in audit.findings]).reshape(-1, 2),
        ]
    )
    (x, y), (x_end, y_end) = shown.min(axis=0) - MARGIN, shown.max(axis=0) + MARGIN
    axes.set(aspect='equal', xlim=(x, x_end), ylim=(y, y_end))  # a ghost may be far away
    draw.legend_above(axes)
    return draw.png(figure)


def _page(name: str, audit: Audit, image: bytes) -> str:
    f = audit.figures
    kinds = ', '.join(dict.fromkeys(g.kind.value for g in audit.findings)) or 'all is as planned'
    n = len(audit.findings)
    count = '1 finding' if n == 1 else f'{n} findings'
    parts = [
        heading(
            f'Audit of {name}',
            f'{count}: {kinds}. {f["scans"]} scans, {f["detections"]} '
            f'detections, {f["unmatched"]} of which the layout does not have; '
            f'{f["usual_rate"]:.1%} of expected reflectors were seen',
        )
    ]
    if audit.findings:
        parts.append(section('What to do', headed_table(finding_rows(f)), 'problem'))
    parts.append(section(CAPTION, picture(image, CAPTION)))
    parts.append(section('Areas', headed_table(area_rows(f))))
    return page(f'Audit of {name}', parts)
