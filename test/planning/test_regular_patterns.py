# SPDX-License-Identifier: Apache-2.0
"""Rows and lattices are named, chance is not."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.planning.regular_patterns import rows_of
from rlml_slam.simulation.world_file import load_world


def test_row_is_named_with_its_step_among_others():
    rng = np.random.default_rng(1)
    row = np.array([[5.0 * k, 1.0 + 0.02 * (k % 2)] for k in range(7)])
    others = rng.uniform((0.0, 5.0), (40.0, 45.0), (8, 2))
    notes = rows_of(np.concatenate([row, others]))
    assert notes[0] == 'repeats after (5.0, 0.0) m: 7 reflectors in equally spaced rows'


def test_lattice_is_named_by_two_steps():
    notes = rows_of(np.array([[5.0 * i, 7.0 * j] for i in range(5) for j in range(4)]))
    assert len(notes) == 2
    assert 'repeats after (0.0, 7.0) m: 20 reflectors' in notes[0]
    assert notes[1].startswith('the lattice also repeats after (5.0, 0.0) m')


@pytest.mark.parametrize('seed', range(5))
def test_random_layout_has_no_row(seed):
    assert rows_of(np.random.default_rng(seed).uniform(0.0, 100.0, (100, 2))) == []


@pytest.mark.parametrize('name', ['hall', 'yard', 'corridor', 'symmetric', 'room'])
def test_layouts_of_the_package_have_no_row(name):
    assert rows_of(load_world(name).reflectors.points) == []


def test_three_in_a_row_are_no_pattern():
    assert rows_of(np.array([[0.0, 0.0], [5.0, 0.0], [10.0, 0.0]])) == []
