# SPDX-License-Identifier: Apache-2.0
"""fleet.html: one row per run in a table that sorts, distributions, and what got worse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from rlml_lab.fleet.bags import in_words
from rlml_lab.fleet.comparison import LIMITS, Effect, Limit, Verdict, effect_rows
from rlml_lab.fleet.results import Record
from rlml_lab.fleet.run import span
from rlml_slam.report.page import heading, html_table, page, section

COLUMNS = (
    'status', 'duration_s', 'frames', 'lost_s', 'degraded_s', 'closures', 'reflectors',
    'live_ate_rmse_m', 'ate_rmse_m', 'nees_mean', 'relations_trans_mean_m',
    'relations_rot_mean_deg', 'problem',
)  # fmt: skip
WORST = 10  # runs that are listed by name for each figure
BINS, WIDTH, HEIGHT = 24, 300, 70  # of a histogram, in pixels
_SCRIPT = """<style>table.runs th{cursor:pointer;width:auto;padding-right:12px}
tr.worse td{background:var(--problem)} figure rect{fill:var(--accent)}</style><script>
for (const th of document.querySelectorAll('table.runs th')) th.onclick = () => {
  const body = th.closest('table').tBodies[0], k = th.cellIndex, up = th.up = !th.up;
  const value = r => r.cells[k].dataset.v ?? r.cells[k].textContent;
  const both = (a, b) => !isNaN(a) && !isNaN(b) && a !== '' && b !== '' ? a - b :
    String(a).localeCompare(b);
  body.append(...[...body.rows].sort((a, b) => (up ? 1 : -1) * both(value(a), value(b))));
};</script>"""


def fleet_page(
    records: Sequence[Record],
    verdicts: Sequence[Verdict] = (),
    found: Sequence[Effect] = (),
    limits: Mapping[str, Limit] = LIMITS,
) -> str:
    """The whole page; links are relative to the folder of the results."""
    ok = sum(r.row['status'] == 'ok' for r in records)
    worse = {v.name: v.worse for v in verdicts if v.worse}
    driven = span(sum(r.row.get('duration_s', 0.0) for r in records))
    text = f'{in_words(len(records))}, {driven}; {ok} without a problem'
    parts = [heading('Fleet', text)]
    if verdicts:
        parts += [_verdict(verdicts, worse, records), _effects(found), _limits(limits)]
    parts.append(section('Worst runs', _worst(records)))
    parts.append(section('Distributions', _distributions(records)))
    parts.append(section('Runs', _runs(records, worse)))
    return page('Fleet', [*parts, _SCRIPT])


def _verdict(
    verdicts: Sequence[Verdict], worse: Mapping[str, tuple[str, ...]], records: Sequence[Record]
) -> str:
    by_name = {r.name: r for r in records}
    same = sum(v.is_same for v in verdicts)
    head = f'<p>{in_words(len(verdicts))} compared, {same} with the same bytes.</p>'
    rows = [[_link(by_name[n]), escape('; '.join(why))] for n, why in worse.items()]
    title = f'{in_words(len(worse))} got worse' if worse else 'No bag got worse'
    return section(title, head + (html_table(rows, ('bag', 'what')) if rows else ''),
                   'problem' if worse else '')  # fmt: skip


def _effects(found: Sequence[Effect]) -> str:
    rows = [[escape(c) for c in row] for row in effect_rows(found)]
    return section(
        'Mean change', html_table(rows, ('figure', 'bags', 'mean', '95 % interval', ''))
    )  # fmt: skip


def _limits(limits: Mapping[str, Limit]) -> str:
    rows = [
        [escape(v.title), '+' if v.sign > 0 else '−', f'{v.step:g}', f'{v.share:.0%}']
        for v in limits.values()
    ]
    return section('A bag got worse where a figure changed by more than the larger of both',
                   html_table(rows, ('figure', 'direction', 'step', 'share')))  # fmt: skip


def _worst(records: Sequence[Record]) -> str:
    failed = [r for r in records if r.row['status'] != 'ok']
    rows = [
        [escape(r.row['status']), _link(r), escape(str(r.row['problem']))] for r in failed[:WORST]
    ]
    for figure in ('lost_s', 'live_ate_rmse_m', 'ate_rmse_m', 'relations_trans_mean_m'):
        known = [r for r in records if r.row.get(figure)]
        known.sort(key=lambda r: -r.row[figure])
        rows += [
            [escape(LIMITS[figure].title), _link(r), f'{r.row[figure]:.4g}'] for r in known[:WORST]
        ]
    return html_table(rows, ('by', 'bag', 'value'))


def _link(r: Record) -> str:
    """A run's name with links to its report and its MCAP, as far as they were written."""
    files = {'report.html': 'report', 'run.mcap': 'MCAP'}
    links = ', '.join(
        f'<a href="{quote(f"{r.name}/{f}")}">{text}</a>'
        for f, text in files.items()
        if f in r.files
    )
    return escape(r.name) + (f' ({links})' if links else '')


def _distributions(records: Sequence[Record]) -> str:
    return ''.join(
        _histogram(limit.title, [r.row[k] for r in records if r.row.get(k) is not None])
        for k, limit in LIMITS.items()
    )


def _histogram(title: str, values: Sequence[float]) -> str:
    """A picture as SVG, nothing without values."""
    if not values:
        return ''
    counts, _ = np.histogram(values, BINS)
    step, top = WIDTH / BINS, max(int(counts.max()), 1)
    bars = ''.join(
        f'<rect x="{k * step:.1f}" y="{HEIGHT * (1 - c / top):.1f}" width="{step - 1:.1f}" '
        f'height="{HEIGHT * c / top:.1f}"/>'
        for k, c in enumerate(counts.tolist())
    )
    median, p95 = np.percentile(values, (50, 95))
    text = (f'{title}: {min(values):.4g} to {max(values):.4g}, median {median:.4g}, '
            f'95 % below {p95:.4g}')  # fmt: skip
    return (
        f'<figure style="display:inline-block;width:{WIDTH}px;margin:8px 16px 8px 0">'
        f'<svg width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="{escape(text)}">{bars}'
        f'</svg><figcaption class="sub" style="margin:0">{escape(text)}</figcaption></figure>'
    )


def _runs(records: Sequence[Record], worse: Mapping[str, tuple[str, ...]]) -> str:
    columns = [c for c in COLUMNS if any(r.row.get(c) not in (None, '') for r in records)]
    rows = []
    for r in records:
        cells = ''.join(_cell(r.row.get(c)) for c in columns)
        kind = ' class="worse"' if r.name in worse else ''
        rows.append(f'<tr{kind}><td>{_link(r)}</td>{cells}</tr>')
    head = ''.join(f'<th>{escape(c)}</th>' for c in ('bag', *columns))
    return (
        '<p class="sub">A click on a heading sorts.</p><div class="wide"><table class="runs">'
        f'<thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f'<td data-v="{value!r}">{value:.4g}</td>'
    return f'<td>{"" if value is None else escape(str(value))}</td>'
