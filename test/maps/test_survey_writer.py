# SPDX-License-Identifier: Apache-2.0
"""Layouts that are written are read again, and DXF is R12."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam.maps import survey, survey_writer
from rlml_slam.maps.survey import Survey
from rlml_slam.report.plan_page import outlines
from rlml_slam.simulation.world_file import load_world

LAYOUT = Survey(
    np.array([3, 7, 12]), np.array([[1.5, -2.25], [10.0, 4.001], [0.0, 0.0]]),
    np.array([0.08, 0.05, 0.1]),
)  # fmt: skip
WALLS = np.array([[0.0, 0.0, 5.0, 0.0], [5.0, 0.0, 5.0, 3.5]])


@pytest.mark.parametrize('name', ['layout.csv', 'layout.imk'])
def test_reader_finds_what_was_written(tmp_path, name):
    survey_writer.save(LAYOUT, WALLS, 2, tmp_path)
    found = survey.load(tmp_path / name)
    np.testing.assert_array_equal(found.ids, LAYOUT.ids)
    np.testing.assert_allclose(found.points, LAYOUT.points, atol=1e-9)
    np.testing.assert_allclose(found.diameters, LAYOUT.diameters, atol=1e-9)


def test_dxf_is_pairs_of_code_and_value():
    lines = survey_writer.dxf(LAYOUT, WALLS, 2).splitlines()
    pairs = [(int(a), b) for a, b in zip(lines[::2], lines[1::2], strict=True)]
    assert pairs[:2] == [(0, 'SECTION'), (2, 'TABLES')]
    assert pairs[-2:] == [(0, 'ENDSEC'), (0, 'EOF')]
    drawn = pairs.index((2, 'ENTITIES'))
    kinds = [b for a, b in pairs[drawn:] if a == 0][:-2]
    assert kinds == ['LINE'] * 2 + ['CIRCLE', 'TEXT'] * 3
    tables = pairs[:drawn]
    layers = {b: tables[k + 2] for k, (a, b) in enumerate(tables) if tables[k - 1] == (0, 'LAYER')}
    assert layers == {'REFLECTORS': (62, '1'), 'REFLECTORS_NEW': (62, '30'), 'WALLS': (62, '8')}
    assert {b for a, b in pairs if a == 8} == set(layers)  # one that is not declared is not drawn
    assert [b for a, b in pairs if a == 8].count('REFLECTORS_NEW') == 2


def test_dxf_opens_in_ezdxf(tmp_path):
    ezdxf = pytest.importorskip('ezdxf')
    survey_writer.save(LAYOUT, WALLS, 2, tmp_path)
    drawing = ezdxf.readfile(tmp_path / 'layout.dxf')
    assert not drawing.audit().errors
    space = drawing.modelspace()
    assert len(space.query('LINE')) == 2
    circles = [(e.dxf.layer, e.dxf.center.x, e.dxf.center.y, e.dxf.radius)
               for e in space.query('CIRCLE')]  # fmt: skip
    assert circles[1] == ('REFLECTORS', pytest.approx(10.0), pytest.approx(4.001), 0.025)
    assert circles[2][0] == 'REFLECTORS_NEW'
    assert [e.dxf.text for e in space.query('TEXT')] == ['3', '7', '12']


def test_drawing_has_the_pillars():
    walls = load_world('room').static
    lines = outlines(walls)
    np.testing.assert_array_equal(lines[: len(walls.segments)], walls.segments[:, :4])
    (x, y, radius) = walls.discs[0, :3]
    around = lines[len(walls.segments) :].reshape(-1, 2)
    assert len(around) == 48
    np.testing.assert_allclose(np.hypot(*(around - (x, y)).T), radius)
    none = replace(walls, discs=walls.discs[:0])
    assert len(outlines(none)) == len(walls.segments)
