# SPDX-License-Identifier: Apache-2.0
"""What differs between two runs: as lines of text, as comparison.json, and as a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.evaluation.run_comparison import (
    FIGURES,
    OF_PATHS,
    Figure,
    Row,
    RunComparison,
    live_name,
)
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.report.outputs import make_folder, write_json
from rlml_slam.report.page import headed_table, heading, page, picture, section
from rlml_slam.se2 import compose

HEADER = ('figure', 'A', 'B', 'change', 'verdict')
PARTED = ('apart by', 'first at', 'x, y [m]', 'health of A', 'health of B')
CAPTIONS = {
    'paths': 'Paths of A and B, in the map of A',
    'distance': 'Distance and difference of heading from A to B over time; lines mark where they '
    'part',
}


def figures_of(c: RunComparison) -> dict[str, Any]:
    """All of it, ready for JSON."""
    m = c.mounting
    return {
        'a': c.a.name, 'b': c.b.name, 'different': c.is_different, 'fitted': c.is_fitted,
        'paths': {name: e.summary() for name, e in c.paths.items()},
        'parting': [
            {'distance_m': p.distance, 'time_s': round(p.time, 9), 'stamp_ns': p.stamp,
             'x_m': p.place[0], 'y_m': p.place[1], 'health': list(p.health)}
            for p in c.parting
        ],
        'mounting': None if m is None else {
            'shift': m.shift.tolist(), 'sigma': m.sigma.tolist(), 'certain': m.is_certain(),
        },
        'settings': [dict(zip(('name', 'a', 'b'), s, strict=True)) for s in c.settings],
        'figures': {
            r.name: {
                'a': r.a, 'b': r.b, 'verdict': r.verdict,
                'limit': None if math.isinf(r.limit) else r.limit,
            }
            for r in c.rows
        },
    }  # fmt: skip


def text_of(c: RunComparison) -> str:
    """The comparison for people, without its table."""
    lines = [f'A: {c.a.name}', f'B: {c.b.name}']
    lines += [f'{name}: {a} against {b}' for name, a, b in c.settings]
    fitted = ', after it was fitted to A' if c.is_fitted else ''
    for name, e in c.paths.items():
        s = e.summary()
        text = f'{s["matched"]:.0f} poses of B{fitted}: rms {1e2 * s["rmse_m"]:.2f} cm from A, '
        text += f'max {1e2 * s["max_m"]:.2f} cm'
        if 'heading_rmse_deg' in s:
            text += f', heading rms {s["heading_rmse_deg"]:.3f}°'
        lines.append(f'{name}: {text}; {s["unmatched"]:.0f} without A')
    for p in c.parting:
        apart = 'at all' if p.distance < 1e-6 else f'by {100 * p.distance:g} cm'
        health = ' / '.join(filter(None, dict.fromkeys(p.health)))
        where = f'x {p.place[0]:.2f}, y {p.place[1]:.2f}{", " if health else ""}{health}'
        lines.append(f'apart {apart}: first at {p.time:.1f} s, {where}')
    lines += mounting_text(c)
    return '\n'.join(lines)


def mounting_text(c: RunComparison) -> list[str]:
    """Whether the paths differ as if the sensors were mounted elsewhere."""
    m = c.mounting
    if m is None or not m.is_certain():
        return []
    (x, y, yaw), (sx, sy, syaw) = m.shift, m.sigma
    return [
        'B differs as if its sensors sat elsewhere (laser_pose or /tf_static), by at least about '
        f'x {1e2 * x:+.2f} ± {1e2 * sx:.2f} cm, y {1e2 * y:+.2f} ± {1e2 * sy:.2f} cm, '
        f'heading {math.degrees(yaw):+.2f} ± {math.degrees(syaw):.2f}°'
    ]


def table_of(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """Cells of the table of figures, with a header."""
    out: list[tuple[str, ...]] = [HEADER]
    for r in rows:
        f, between = FIGURES[r.name], r.name in OF_PATHS
        change = '' if r.a is None or r.b is None or r.a == r.b else _cell(
            f, r.b - r.a, '' if between else '+'
        )  # fmt: skip
        limit = f' (limit {f.factor * r.limit:g})' if r.is_beyond else ''
        sides = ('', '') if between else (_cell(f, r.a), _cell(f, r.b))
        out.append((r.title, *sides, change, r.verdict + limit))
    return out


def _cell(f: Figure, value: float | None, sign: str = '') -> str:
    return '' if value is None else f'{f.factor * value:{sign}.6g} {f.unit}'.rstrip()


def parting_table(c: RunComparison) -> list[tuple[str, ...]]:
    """Cells of the table of where the paths part, with a header."""
    rows: list[tuple[str, ...]] = [PARTED]
    for p in c.parting:
        apart = 'any digit' if p.distance < 1e-6 else f'{100 * p.distance:g} cm'
        x, y = p.place
        rows.append((apart, f'{p.time:.1f} s', f'{x:.2f}, {y:.2f}', *p.health))
    return rows


def write_comparison(c: RunComparison, folder: Path) -> None:
    """Write comparison.json, two pictures and comparison.html, each whole or not at all."""
    folder = make_folder(folder)
    write_json(folder / 'comparison.json', figures_of(c))
    beyond = [r.title for r in c.rows if r.is_beyond]
    verdict = f'different: {"; ".join(beyond)}' if beyond else 'no difference beyond the limits'
    title = f'{c.a.name} against {c.b.name}'
    parts = [heading(title, verdict)]
    lines = ''.join(f'<p>{escape(line)}</p>' for line in text_of(c).splitlines())
    parts.append(section('Summary', lines, 'problem' if beyond else ''))
    for name, png in {'paths': _paths(c), 'distance': _distance(c)}.items():
        write_atomically(folder / f'{name}.png', png)
        parts.append(section(CAPTIONS[name], picture(png, CAPTIONS[name])))
    if c.parting:
        parts.append(section('Where they part', headed_table(parting_table(c))))
    parts.append(section('Figures', headed_table(table_of(c.rows))))
    write_atomically(folder / 'comparison.html', page(title, parts).encode())


def _paths(c: RunComparison) -> bytes:
    from matplotlib.figure import Figure

    from rlml_slam.report import pictures as draw

    name = live_name(c)
    a, b = ((r.paths.get(name) or next(iter(r.paths.values()))).poses for r in (c.a, c.b))
    figure = Figure(figsize=(9.0, 6.5), layout='constrained')
    axes = figure.add_subplot()
    draw.dress(axes, 'x [m]', 'y [m]')
    errors = c.paths[name]
    moved = compose(errors.T_truth_map, b[errors.indices])
    axes.plot(a[:, 0], a[:, 1], color=draw.TRUTH, linewidth=2.4, alpha=0.4, label='A')
    axes.plot(moved[:, 0], moved[:, 1], color=draw.LIVE, linewidth=1.0, label='B')
    for p in c.parting[1:]:
        axes.plot(*p.place, 'o', mfc='none', mec=draw.INK, ms=9)
        axes.annotate(
            f'{100 * p.distance:g} cm', p.place, (8, 8), textcoords='offset points', fontsize=8,
            color=draw.INK,
        )  # fmt: skip
    axes.set_aspect('equal')
    draw.legend_above(axes)
    return draw.png(figure)


def _distance(c: RunComparison) -> bytes:
    from matplotlib.figure import Figure

    from rlml_slam.report import pictures as draw

    logs = {n: r.health for n, r in (('A', c.a), ('B', c.b)) if r.health is not None}
    heights = [0.3] * len(logs) + [1.5, 1.2]
    figure = Figure(figsize=(9.0, 1.4 * sum(heights) + 1.0), layout='constrained')
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    start = int(next(iter(c.paths.values())).stamps[0])
    for axes, (name, log) in zip(panels, logs.items(), strict=False):
        draw.health_strip(
            axes, 1e-9 * (log.stamps - start).astype(np.float64), log.levels.tolist()
        )
        axes.set_ylabel(name, color=draw.INK, rotation=0, va='center', labelpad=12)
    far, turned = panels[-2:]
    draw.dress(far, '', 'distance [cm]')
    draw.dress(turned, 'time [s]', 'heading [°]')
    for (name, e), colour in zip(c.paths.items(), (draw.LIVE, draw.PATH), strict=False):
        t = (e.stamps - start) * 1e-9
        far.plot(t, 100.0 * e.distances, color=colour, linewidth=0.9, label=name)
        turned.plot(t, np.degrees(e.errors[:, 2]), color=colour, linewidth=0.9)
    for p in c.parting:
        far.axvline(p.time, color=draw.SOFT, linewidth=0.6)
    far.set_ylim(bottom=0.0)
    draw.legend_above(far)
    panels[-1].margins(x=0.005)
    figure.align_ylabels()
    return draw.png(figure)
