# SPDX-License-Identifier: Apache-2.0
"""docs/deformable.md says what the code says, as far as a second of checks can show."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rlml_lab.deformable.experiment import ROWS
from rlml_lab.deformable.replay_note import replay
from rlml_lab.deformable.scoring import chi2_bounds
from rlml_slam.cli.support.interface import TOPICS
from rlml_slam.params import DeformableParameters, declarations

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / 'docs' / 'deformable.md').read_text(encoding='utf-8')
NOTE = ROOT.parent / 'shared' / 'data' / 'deformable-note'


def table(first, header):
    """Cells as numbers (the first of each cell) of the rows of a table, by their first cell."""
    lines = TEXT[TEXT.index(header) :].splitlines()[2:]
    rows = {}
    for line in lines[: lines.index('')]:
        name, *cells = (cell.strip() for cell in line.strip('|').split('|'))
        rows[name] = [float(re.findall(r'-?\d+\.?\d*', c.replace('−', '-'))[0]) for c in cells]
    assert list(rows) == first
    return rows


ERRORS = table([r.name for r in ROWS], '| row | EKF | NLS | RTS')
PAIRED = table([r.name for r in ROWS], '| row | NLS − EKF')


@pytest.mark.skipif(not NOTE.is_dir(), reason=f'{NOTE} is not there')
def test_replayed_figures_are_those_of_the_replay():
    for r in replay(NOTE).values():
        figures = [*r['leak_on'].values(), *r['leak_off'].values(), r['ekf_leaked']]
        assert all(f'{f:.4f}' in TEXT for f in figures)


@pytest.mark.parametrize('row', ROWS, ids=lambda r: r.name)
def test_paired_differences_are_those_of_the_means(row):
    """Three decimals each, of which two are rounded into a difference."""
    ekf, nls, rts, _ = ERRORS[row.name]
    for found, expected in zip(PAIRED[row.name], (nls - ekf, rts - ekf, nls - rts), strict=False):
        assert found == pytest.approx(expected, abs=0.0016)


def test_summary_says_what_the_tables_say():
    gains = [1.0 - nls / ekf for ekf, nls, *_ in ERRORS.values()]
    assert f'{100 * min(gains):.0f}–{100 * max(gains):.0f} %' in TEXT
    smoothing = [p[1] / p[0] for p in PAIRED.values()]
    assert f'{100 * min(smoothing):.0f}–{100 * max(smoothing):.0f} %' in TEXT
    shares = [p[3] for p in PAIRED.values()]
    assert f'{int(min(shares))}–{round(max(shares))} %' in TEXT


def test_bounds_are_those_of_chi2():
    for (low, high), digits in ((chi2_bounds(177, 2000), 1), (chi2_bounds(9, 2000), 2)):
        assert f'{low:.{digits}f} … {high:.{digits}f}' in TEXT
    low, high = chi2_bounds(177, 2000)
    assert all(low < p[4] < high for p in PAIRED.values())


def test_node_is_described_with_its_topics_and_parameters():
    node = TEXT[TEXT.index('## Live') : TEXT.index('## Corrections')]
    topics = {t.name for t in TOPICS if t.node == 'deformable_slam'} - {'/tf_static'}
    assert topics <= set(re.findall(r'`([~/a-z_]+)`', node))
    names = {d.name for d in declarations(DeformableParameters)}
    assert set(re.findall(r'`(deformable\.[a-z_]+)', node)) <= names
