# SPDX-License-Identifier: Apache-2.0
"""The page of ``rlml-lab study front-end``: tables, errors by sensor and fault, and NEES."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rlml_lab.studies.front_end_tables import (
    COLUMNS,
    FAULT_HEADER,
    FAULTS,
    SENSORS,
    drive_rows,
    fault_rows,
    kidnap_text,
)
from rlml_lab.support import page
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.report.outputs import make_folder
from rlml_slam.report.pictures import CLOSURE, LIVE, PATH, REFLECTOR, TRUTH, png

COLORS = dict(zip(SENSORS, (TRUTH, LIVE, REFLECTOR, CLOSURE, PATH), strict=True))


def write_report(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write report.html, results.json and the pictures as PNG into a folder."""
    folder = make_folder(folder)
    pictures = {'errors': draw_errors(summary), 'consistency': draw_nees(summary)}
    parts = [
        page.heading('Drives'),
        page.paragraph(
            'Default parameters; poses as published live; mean over the seeds (worst seed). '
            'Faults: wheel slip in 5 % of the time, worn wheels that give 4 % less speed and 5 % '
            'more turn, as many ghosts as detections, 40 % of the detections missed, 0.5 s in '
            'every 10 s without scan and reflectors, stamps that jitter by 20 ms (1 sigma).'
        ),
        page.table(['world, system or fault', *(c[0] for c in COLUMNS.values())],
                   drive_rows(summary)),
        page.picture(pictures['errors'], 'Position RMSE of every seed; faults with both sensors'),
        page.heading('Faults against the clean drives'),
        page.table(FAULT_HEADER, fault_rows(summary)),
        page.heading('Consistency'),
        page.paragraph('A covariance that is that of the errors has a mean NEES of 3.'),
        page.picture(pictures['consistency'], 'Mean NEES of every seed, and 2.4 to 3.6'),
        page.heading('Carried robots'),
        page.paragraph(f'{kidnap_text(summary)}.'),
    ]  # fmt: skip
    for name, data in pictures.items():
        write_atomically(folder / f'{name}.png', data)
    write_atomically(folder / 'results.json', (json.dumps(summary, indent=1) + '\n').encode())
    lead = f'{summary["seeds"]} seeds; {summary["wall_s"]:.0f} s.'
    write_atomically(folder / 'report.html', page.page('Front end', lead, parts).encode())


def draw_errors(summary: Mapping[str, Any]) -> bytes:
    """Position RMSE of every seed, a panel for each world, on a logarithmic scale."""
    return _panels(summary, 'ate_m', 100.0, 'live position RMSE [cm]')


def draw_nees(summary: Mapping[str, Any]) -> bytes:
    """Mean NEES of every seed, a panel for each world."""
    return _panels(summary, 'nees', 1.0, 'mean NEES', (2.4, 3.6))


def _panels(
    summary: Mapping[str, Any],
    key: str,
    factor: float,
    label: str,
    bounds: tuple[float, float] | None = None,
) -> bytes:
    drives = summary['drives']
    worlds = list(dict.fromkeys(name.split(', ')[0] for name in drives))
    rows = [r for r in (*SENSORS, *FAULTS) if any(f'{w}, {r}' in drives for w in worlds)]
    figure = Figure(figsize=(3.2 * len(worlds) + 1.0, 0.32 * len(rows) + 1.4),
                    layout='constrained')  # fmt: skip
    panels = figure.subplots(1, len(worlds), sharey=True, squeeze=False)[0]
    for axes, world in zip(panels, worlds, strict=True):
        for k, row in enumerate(rows):
            s = drives.get(f'{world}, {row}')
            if s is not None:
                values = factor * np.array(s[key]['per_seed'])
                y = np.full(len(values), len(rows) - 1 - k)
                axes.plot(values, y, 'o', ms=4, alpha=0.5, mew=0, color=COLORS.get(row, PATH))
        if bounds is not None:
            axes.axvspan(*bounds, color=TRUTH, alpha=0.15, lw=0)
        axes.set(xscale='log', xlabel=label, title=world)
        axes.set_yticks(range(len(rows))[::-1], rows)
        axes.grid(True, axis='x', alpha=0.4)
    return png(figure)
