# SPDX-License-Identifier: Apache-2.0
"""The report of a run: one HTML file that carries its pictures and needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

from rlml_slam.evaluation.run_record import Run
from rlml_slam.evaluation.survey_residuals import changes, name_of
from rlml_slam.report.summary import summary_rows
from rlml_slam.slam.landmarks.reflector_states import PRESENT, describe
from rlml_slam.types import Level
from rlml_slam.version import __version__

CAPTIONS = {
    'map': 'Map, trajectory, reflectors with 95 % ellipses, and loop closures',
    'errors': 'Errors against ground truth over time, with the 3σ bands that were published',
    'health': 'Health, position uncertainty and detections over time',
    'timing': 'Time per scan and per keyframe',
}
_STYLE = """
:root { --ink: #24292f; --soft: #6a737d; --line: #e3e6ea; --accent: #1f5fbf; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f7f9; color: var(--ink);
       font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 32px 20px 48px; }
h1 { font-size: 26px; margin: 0 0 2px; } h2 { font-size: 17px; margin: 0 0 12px; }
.sub { color: var(--soft); margin: 0 0 20px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; }
.card, section { background: #fff; border: 1px solid var(--line); border-radius: 10px; }
.card { padding: 12px 16px; } .card b { display: block; font-size: 23px; color: var(--accent); }
.card span { color: var(--soft); font-size: 13px; }
section { padding: 18px 20px; margin-top: 16px; }
img { width: 100%; height: auto; display: block; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
td, th { text-align: left; padding: 5px 12px 5px 0; border-bottom: 1px solid var(--line);
         vertical-align: top; font-weight: normal; }
th { color: var(--soft); white-space: nowrap; width: 1%; padding-right: 28px; }
.problem { background: #fdecea; border-color: #f1b8b2; }
footer { color: var(--soft); font-size: 13px; margin-top: 20px; }
"""


def report_html(run: Run, figures: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """The page: key figures, pictures, table of all figures, and spells of bad health."""
    parts = [
        f'<h1>{escape(run.name)}</h1>',
        f'<p class="sub">{escape(_subtitle(figures))}</p>',
        f'<div class="cards">{"".join(_cards(figures))}</div>',
    ]
    if run.problem:
        parts.append(section('The results are incomplete', escape(run.problem), 'problem'))
    parts += [_picture(name, pictures[name]) for name in ('map', 'errors') if name in pictures]
    parts.append(section('Figures', _table(summary_rows(figures))))
    if figures.get('survey', {}).get('found'):
        parts.append(section('Reflectors against the survey', _table(_residuals(figures))))
    changed = [describe(s).partition(': ') for s in run.reflector_states if s.state != PRESENT]
    if changed:
        rows = [(kind, what) for kind, _, what in changed]
        parts.append(section('New, moved, missing and ghost reflectors', _table(rows)))
    parts += [_picture(name, pictures[name]) for name in ('health', 'timing') if name in pictures]
    spells = list(bad_spells(run))
    if spells:
        parts.append(section('When it was not OK', _table(spells)))
    return page(run.name, parts)


def page(title: str, parts: Sequence[str]) -> str:
    """A whole page of these parts, in the style of the report."""
    body = '\n'.join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{escape(title)} · rlml_slam</title><style>{_STYLE}</style></head>\n'
        f'<body><main>\n{body}\n<footer>rlml_slam {__version__}</footer></main></body></html>\n'
    )


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


def _picture(name: str, png: bytes) -> str:
    data = base64.b64encode(png).decode('ascii')
    alt = escape(CAPTIONS[name])
    return section(CAPTIONS[name], f'<img alt="{alt}" src="data:image/png;base64,{data}">')


def section(title: str, body: str, kind: str = '') -> str:
    """A box of the page; ``body`` is HTML."""
    return f'<section class="{kind}"><h2>{escape(title)}</h2>{body}</section>'


def _table(rows: list[tuple[str, str]]) -> str:
    cells = ''.join(f'<tr><th>{escape(a)}</th><td>{escape(b)}</td></tr>' for a, b in rows)
    return f'<table>{cells}</table>'


def bad_spells(run: Run, most: int = 20) -> Iterator[tuple[str, str]]:
    """(when, level and reasons) of the spells that were not OK, one per reason, the first ones."""
    frames, count = run.frames, 0
    begun: int | None = None
    for k in range(len(frames.stamps) + 1):
        state = (frames.levels[k], frames.reasons[k]) if k < len(frames.stamps) else None
        if begun is not None and state != (frames.levels[begun], frames.reasons[begun]):
            level = Level(frames.levels[begun])
            if level != Level.OK:
                count += 1
                if count > most:
                    yield '…', 'and more'
                    return
                a, b = ((frames.stamps[i] - frames.stamps[0]) * 1e-9 for i in (begun, k - 1))
                yield f'{a:.1f} to {b:.1f} s', f'{level.name}: {"; ".join(frames.reasons[begun])}'
            begun = None
        if begun is None and state is not None:
            begun = k
