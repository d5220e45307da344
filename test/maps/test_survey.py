# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.cli.map import map_survey
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps import reflector_file, survey
from rlml_slam.maps.survey import Survey
from rlml_slam.types import ANONYMOUS, Reflectors

NAMES = ('id', 'x', 'y', 'diameter')
ROWS = [(7, 1.5, -2.25, 0.08), (9, 10.0, 4.0, 0.05)]


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('a.csv', 'id,x,y,diameter\n7,1.5,-2.25,0.08\n9,10,4,0.05\n'),
        ('a.json', json.dumps([dict(zip(NAMES, r, strict=True)) for r in ROWS])),
        ('a.imk', 'globID x/mm y/mm type subtype size/mm layer\n# none\n'
         '7 1500 -2250 1 1 80 1\n9 10000 4000 1 1 50 1 2\n\n'),
    ],
)  # fmt: skip
def test_three_formats_say_the_same(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    found = survey.load(path)
    np.testing.assert_array_equal(found.ids, [7, 9])
    np.testing.assert_allclose(found.points, [[1.5, -2.25], [10.0, 4.0]])
    np.testing.assert_allclose(found.diameters, [0.08, 0.05])


def test_reflectors_of_a_map_are_a_survey(tmp_path):
    points, cov = np.array([r[1:3] for r in ROWS]), np.tile(1e-4 * np.eye(2), (2, 1, 1))
    ids, diameters = np.array([ANONYMOUS, 9]), np.array([np.nan, 0.05])
    seen = Reflectors(np.arange(2), points, cov, ids, np.ones(2, dtype=np.int64), diameters)
    reflector_file.save(seen, tmp_path / 'reflectors.csv')
    found = survey.load(tmp_path / 'reflectors.csv')
    np.testing.assert_array_equal(found.ids, ids)
    np.testing.assert_allclose(found.points, points)
    np.testing.assert_allclose(found.diameters, diameters)


def test_table_that_an_editor_has_saved_is_read(tmp_path):
    table = tmp_path / 'reflectors.csv'
    row = '0,7,1.5,-2.25,1e-4,0,1e-4,3,'
    table.write_text('\n'.join([','.join(reflector_file.COLUMNS), '', row, '']), 'utf-8-sig')
    np.testing.assert_array_equal(reflector_file.load(table).ids, [7])


@pytest.mark.parametrize(
    ('text', 'ids'),
    [
        ('id,x_m,y_m\n7,1.5,-2.25\n9,10,4\n', [7, 9]),
        ('X;Y\n1,5;-2,25\n10;4\n', [-1, -1]),
        ('nr;easting;northing\n7;1.5;-2.25\n9;10;4\n', [7, 9]),
        ('East [m],North [m],height\n1.5,-2.25,3\n10,4,3\n', [-1, -1]),
        ('# of today\n1.5 -2.25\n10 4\n', [-1, -1]),
        ('7,1.5,-2.25\n9,10,4\n', [7, 9]),
        ('P7\t1.5\t-2.25\nP9\t10\t4\n', [-1, -1]),
        ('1.5,-2.25,0.5\n10,4,0.5\n', [-1, -1]),
        ('"id, number";x;y\n7;1.5;-2.25\n9;10;4\n', [-1, -1]),
        ('id,x,y,note\n7,1.5,-2.25,"gate, left"\n9,10,4,,\n', [7, 9]),
        ('id\tx\ty\n\t1.5\t-2.25\n9\t10\t4\n', [-1, 9]),
        ('\ufeff# of today\nid,x,y\n7,"1.5","-2.25"\n9,10,4\n', [7, 9]),
    ],
)
def test_surveys_with_usual_columns_are_read(tmp_path, text, ids):
    (tmp_path / 'a.csv').write_text(text)
    found = survey.load(tmp_path / 'a.csv')
    np.testing.assert_allclose(found.points, [[1.5, -2.25], [10.0, 4.0]])
    np.testing.assert_array_equal(found.ids, ids)


def test_id_and_diameter_may_be_missing(tmp_path):
    (tmp_path / 'a.csv').write_text('x,y\n1,2\n')
    found = survey.load(tmp_path / 'a.csv')
    assert found.ids[0] == ANONYMOUS
    assert np.isnan(found.diameters[0])


@pytest.mark.parametrize(
    ('name', 'text', 'why'),
    [
        ('a.csv', 'x,z\n1,2\n', 'no columns of x and y; the header has x, z'),
        ('a.csv', 'x,y\n1,nan\n', 'line 2: the place is not finite'),
        ('a.csv', 'x,y\n1,far\n', 'line 2: y is no number: far'),
        ('a.csv', 'x,y\n1,\n', 'line 2: y is missing'),
        ('a.json', '[{"x": 1, "y": null}]', 'entry 1: y is missing'),
        ('a.json', '[{"x": 1}]', 'entry 1: y is missing'),
        ('a.json', '[{"x": 1, "y": [2]}]', 'entry 1: y is no number: .2.'),
        ('a.json', '[{"x": 1, "y": 2, "id": "gate"}]', 'entry 1: id is no number: gate'),
        ('a.csv', 'x,y\n', 'no reflector'),
        ('a.csv', 'id,x,y\n3,1,2\n3,4,5\n', 'two reflectors'),
        ('a.csv', 'id,x,y\n1,"10,5","20,5"\n', 'line 2: 10,5: write 1.5, or'),
        ('a.csv', 'id,x,y\n1,10,5,20,5\n', 'line 2: 5 values, 3 expected'),
        ('a.csv', '1,10,5\n2,11,5,20,5\n', 'line 2: 5 values, 3 expected'),
        ('a.csv', 'x,y,n\n1.5,2.5,1\n', 'more than one column of y; the header has x, y, n'),
        ('a.csv', 'n,x,y\n1,1.5,2.5\n', 'more than one column of y'),
        ('a.csv', 'id,number,x,y\n1,2,3,4\n', 'more than one column of id'),
        *(('a.csv', f'x,y,diameter\n1,2,{d}\n', 'line 2: a diameter of .* m is not in')
          for d in ('80', '-0.08', 'inf')),
        ('a.imk', '7 1500 -2250 1 1 80000\n', 'line 1: a diameter of 80 m'),
        ('a.csv', 'x,y\n' + '1' * 200_000, 'field larger than'),
        ('a.json', '[3]', 'entry 1: not an object'),
        ('a.json', '[{', 'Expecting'),
        ('a.imk', '7 1500 -2250\n', 'line 1: 3 fields'),
        ('a.txt', '', 'one of .csv, .json, .imk'),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(tmp_path, name, text, why):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(FileFormatError, match=why):
        survey.load(path)
    with pytest.raises(MapError, match='cannot be read'):
        survey.load(tmp_path / 'none.csv')


def mapped(points, rng=None, sigma=0.01):
    n = len(points)
    noise = 0.0 if rng is None else sigma * rng.standard_normal((n, 2))
    return Reflectors(
        100 + np.arange(n), points + noise, np.tile(sigma**2 * np.eye(2), (n, 1, 1)),
        np.full(n, ANONYMOUS), np.full(n, 5), np.full(n, np.nan),
    )  # fmt: skip


@pytest.mark.parametrize(('in_map', 'in_survey', 'which'), [(5, 2, 'survey'), (2, 5, 'map')])
def test_too_few_reflectors_are_said_of_the_one_that_has_them(in_map, in_survey, which):
    points = np.random.default_rng(0).uniform(-9.0, 9.0, (5, 2))
    surveyed = Survey(np.full(in_survey, ANONYMOUS), points[:in_survey], np.full(in_survey, 0.1))
    with pytest.raises(MapError, match=f': the {which} has 2 reflectors, three are needed'):
        map_survey.compare(mapped(points[:in_map]), surveyed)


@pytest.fixture(scope='module')
def compared():
    """Of 20 reflectors, 3 is missing, 5 was moved by 1.5 m, and one is new."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-20.0, -12.0), (20.0, 12.0), (20, 2))
    true = np.array([12.0, -7.0, 2.1])
    there = points.copy()
    there[5] += [1.5, 0.0]
    there = np.vstack([np.delete(there, 3, axis=0), [[30.0, 25.0]]])
    seen = se2.transform(se2.inverse(true), there)
    ids = np.arange(20)
    figures = map_survey.compare(mapped(seen, rng), Survey(ids, points, np.full(20, np.nan)))
    return true, figures


def test_map_is_found_in_the_plant(compared):
    true, figures = compared
    # a centimetre of noise, 18 reflectors over 40 m
    np.testing.assert_allclose(figures['T_survey_map'], true, atol=0.01)
    assert figures['rmse_m'] == pytest.approx(0.014, abs=0.005)
    assert [r['id'] for r in figures['residuals']] == [k for k in range(20) if k not in (3, 5)]


def test_missing_new_and_moved_are_told_apart(compared):
    _, figures = compared
    assert [r['id'] for r in figures['missing']] == [3]
    assert [r['id'] for r in figures['moved']] == [5]
    assert figures['moved'][0]['by_m'] == pytest.approx(1.5, abs=0.05)
    (new,) = figures['new']
    np.testing.assert_allclose(new['at'], [30.0, 25.0], atol=0.05)
    lines = map_survey.text(figures).splitlines()
    assert sum(line.startswith(('missing: 3', 'moved: 5', 'new: ')) for line in lines) == 3


def test_map_of_another_place_is_refused():
    rng = np.random.default_rng(1)
    a, b = rng.uniform(-15.0, 15.0, (2, 10, 2))
    with pytest.raises(MapError, match='not found in the survey'):
        map_survey.compare(mapped(a), Survey(np.arange(10), b, np.full(10, np.nan)))


def test_diameter_of_zero_is_not_known(tmp_path):
    (tmp_path / 'a.csv').write_text('x,y,diameter\n1,2,0\n3,4,0.08\n')
    np.testing.assert_array_equal(survey.load(tmp_path / 'a.csv').diameters, [np.nan, 0.08])
