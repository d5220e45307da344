# SPDX-License-Identifier: Apache-2.0
"""The study of relocalization: its layouts are what they say, its verdicts are right."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rlml_lab.main import main
from rlml_lab.studies import study_relocalization as study
from rlml_slam import se2


@pytest.fixture(scope='module')
def rows():
    from contextlib import redirect_stdout
    from io import StringIO

    out = StringIO()
    with redirect_stdout(out):
        assert main(['study', 'relocalization', '--poses', '58', '--seed', '3', '--json']) == 0
    return json.loads(out.getvalue())['layouts']


@pytest.mark.parametrize('layout', study.LAYOUTS)
def test_layouts_have_12_to_40_reflectors(layout):
    counts = {len(study.case_of(layout, k, 0).reflectors) for k in range(58)}
    assert min(counts) == 12
    assert max(counts) == 40


def test_symmetric_layout_is_the_same_turned_by_half():
    points = study.symmetric(20, np.random.default_rng(0))
    turned = se2.transform(np.array([0.0, 0.0, np.pi]), points)
    gap = np.hypot(*(points[:, None] - turned[None]).transpose(2, 0, 1))
    assert gap.min(axis=0).max() < 1e-12


def test_shares_of_ghosts_and_missing_are_as_asked():
    seen, there, ghosts, made = 0, 0, 0, 0
    for k in range(200):
        case = study.case_of('yard', k, 0)
        at = se2.transform(case.truth, case.points)
        gap = np.hypot(*(at[:, None] - case.reflectors[None]).transpose(2, 0, 1))
        near = np.hypot(*(case.reflectors - case.truth[:2]).T) < study.REACH
        seen += int((gap.min(axis=0)[near] < 0.2).sum())
        there += int(near.sum())
        ghosts += int((gap.min(axis=1) > 0.2).sum())
        made += len(at)
    # three sigmas of so many draws, and ghosts that fall on a reflector
    assert seen / there == pytest.approx(1.0 - study.MISSING, abs=0.03)
    assert ghosts / made == pytest.approx(study.GHOSTS, abs=0.02)


@pytest.mark.parametrize('layout', ['hall', 'yard'])
def test_unique_verdicts_are_right_and_most_are_unique(rows, layout):
    assert rows[layout]['right_of_unique'] == 1.0
    assert rows[layout]['unique'] > 0.9


def test_symmetric_layout_is_ambiguous_with_the_truth_among_the_candidates(rows):
    assert rows['symmetric']['unique'] == 0.0
    assert rows['symmetric']['ambiguous_with_truth'] >= 0.98


@pytest.mark.parametrize('layout', study.LAYOUTS)
def test_map_of_another_place_is_never_unique(rows, layout):
    assert rows[f'{layout}, map of another']['unique'] == 0.0


def test_table_has_a_row_for_each_layout(rows):
    lines = study.text(rows).splitlines()
    assert len(lines) == 1 + len(rows)
    assert lines[0].startswith('layout')


def test_nothing_to_study_is_refused(capsys):
    assert main(['study', 'relocalization', '--poses', '0']) == 1
    assert '--poses' in capsys.readouterr().err
