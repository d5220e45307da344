# SPDX-License-Identifier: Apache-2.0
"""``rlml plan``: exit code, files and errors."""

from __future__ import annotations

import json

import pytest

from rlml_slam.cli.main import main
from rlml_slam.maps import nav2_map
from rlml_slam.planning import site as sites
from rlml_slam.report import plan_page
from rlml_slam.simulation.world_file import load_world


def plan(capsys, *arguments, drawn=True) -> tuple[int, str, str]:
    """Exit code and what is printed; without pictures where others of the test are drawn."""
    with pytest.MonkeyPatch.context() as patch:
        if not drawn:
            patch.setattr(plan_page, '_map', lambda *arguments: b'')
        code = main(['plan', *map(str, arguments)])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_symmetric_hall_reaches_two_centimetres(tmp_path, capsys):
    code, out, _ = plan(
        capsys, 'symmetric', '--out', tmp_path, '--goal', 0.02, '--spacing', 1, '--json'
    )
    assert code == 0
    found = json.loads(out)
    assert found == json.loads((tmp_path / 'plan.json').read_text(encoding='utf-8'))
    assert found['goal_share'] == 1.0
    assert found['unique_share'] == 0.0
    assert '<h1>Layout of symmetric</h1>' in (tmp_path / 'plan.html').read_text(encoding='utf-8')
    assert len(list(tmp_path.glob('*.png'))) == 8


def test_missed_goal_is_exit_code_1(tmp_path, capsys):
    code, out, _ = plan(capsys, 'symmetric', '--out', tmp_path, '--goal', 0.005, '--spacing', 1)
    assert code == 1
    assert '0.005 m is reached at ' in out


def test_map_of_nav2_with_a_layout_and_an_area(tmp_path, capsys):
    site = sites.of_world(load_world('hall'))
    nav2_map.save(site.grid, tmp_path / 'hall')
    layout = tmp_path / 'layout.csv'
    rows = [f'{x},{y}' for x, y in site.reflectors.points.tolist()]
    layout.write_text('\n'.join(['x,y', *rows]), encoding='utf-8')
    common = ('--reflectors', layout, '--out', tmp_path / 'out', '--spacing', 1, '--json')
    _, whole, _ = plan(capsys, tmp_path / 'hall.yaml', *common, drawn=False)
    _, part, _ = plan(capsys, tmp_path / 'hall.yaml', *common, '--area', '0,0 10,0 10,10 0,10')
    assert 0 < json.loads(part)['places'] < json.loads(whole)['places']


def test_bad_input_is_one_line(tmp_path, capsys):
    for arguments, reason in (
        ((tmp_path / 'none.yaml',), 'cannot be read'),
        (('hall', '--area', '0,0 1'), '--area'),
        (('hall', '--area', '0,0 1,1'), 'at least three points'),
        (('hall', '--goal', 0), '--goal'),
        (('hall', '--speed', -1), '--speed'),
        (('hall', '--reflectors', tmp_path / 'none.csv'), 'cannot be read'),
        (('hall', '--path', tmp_path / 'none.tum'), 'none.tum'),
    ):
        code, _, err = plan(capsys, *arguments, '--out', tmp_path)
        assert code == 2
        assert reason in err
        assert err.count('\n') == 1


def test_layout_as_imk_gives_the_plan_of_the_same_layout_as_csv(tmp_path, capsys):
    points = load_world('symmetric').reflectors.points[:7]
    rows = [f'{x:.3f},{y:.3f},0.08' for x, y in points.tolist()]
    (tmp_path / 'a.csv').write_text('\n'.join(['x,y,diameter', *rows]), encoding='utf-8')
    lines = [f'{k} {1e3 * x:.0f} {1e3 * y:.0f} 1 1 80 1' for k, (x, y) in enumerate(points)]
    header = 'globID x/mm y/mm type subtype size/mm layer1'
    (tmp_path / 'a.imk').write_text('\n'.join([header, *lines]), encoding='utf-8')
    found = []
    for name in ('a.csv', 'a.imk'):
        code, out, _ = plan(
            capsys, 'symmetric', '--reflectors', tmp_path / name, '--out', tmp_path / 'out',
            '--spacing', 1, '--goal', 0.05, '--json', drawn=name == 'a.imk',
        )  # fmt: skip
        assert code == 0
        found.append(json.loads(out))
    assert found[0]['reflectors'] == found[1]['reflectors'] == 7
    for key in ('in_view_median', 'unique_share'):
        assert found[0][key] == found[1][key]
    for key in ('reflectors_sigma_m', 'driving_sigma_m', 'one_hidden_sigma_m'):
        assert found[0][key] == pytest.approx(found[1][key], rel=1e-9)


def test_sensor_file_has_the_noise_the_laser_and_the_range(tmp_path, capsys):
    common = ('symmetric', '--out', tmp_path / 'out', '--spacing', 3, '--goal', 1, '--json')
    sections = {
        'noise': 'front_end: {ros__parameters: {reflector.sigma_range: 0.04, '
        'reflector.sigma_bearing: 0.006}}',
        'range': 'simulator: {ros__parameters: {markers.max_range: 8.0}}',
        'both': 'front_end: {ros__parameters: {reflector.sigma_range: 0.04, '
        'reflector.sigma_bearing: 0.006}}\nsimulator: {ros__parameters: {markers.max_range: 8.0}}',
    }
    found = {'none': json.loads(plan(capsys, *common, drawn=False)[1])}
    for name, text in sections.items():
        (tmp_path / f'{name}.yaml').write_text(text, encoding='utf-8')
        options = ('--sensor', tmp_path / f'{name}.yaml')
        found[name] = json.loads(plan(capsys, *common, *options, drawn=name == 'both')[1])
    sigma = {k: v['reflectors_sigma_m']['median'] for k, v in found.items()}
    assert sigma['noise'] == pytest.approx(2.0 * sigma['none'], rel=1e-6)
    assert found['range']['in_view_median'] < found['none']['in_view_median']
    assert found['both']['in_view_median'] == found['range']['in_view_median']
    assert sigma['both'] == pytest.approx(2.0 * sigma['range'], rel=1e-6)


def test_slower_drives_are_more_accurate_and_hidden_reflectors_count(tmp_path, capsys):
    common = ('symmetric', '--out', tmp_path, '--spacing', 3, '--goal', 0.008, '--json')
    slow, fast, single, hidden = (
        json.loads(plan(capsys, *common, *more, drawn=drawn)[1])
        for more, drawn in (
            (('--speed', 0.3), False),
            ((), False),
            (('--speed', 0), True),
            (('--redundant', 1), True),
        )
    )
    sigma = [f['driving_sigma_m']['median'] for f in (slow, fast, single)]
    assert sigma == sorted(sigma)
    assert single['driving_sigma_m'] == single['both_sigma_m']
    assert hidden['goal_share'] < fast['goal_share']


def test_suggested_layout_is_written_and_plans_the_same(tmp_path, capsys):
    common = ('--spacing', 1, '--goal', 0.011, '--json')
    code, out, _ = plan(capsys, 'symmetric', '--out', tmp_path / 'a', *common, '--suggest', 2)
    found = json.loads(out)
    assert code == 1  # two are not enough for a unique pose everywhere
    mounts = found['suggested']['mounts']
    assert [m['id'] for m in mounts] == [11, 12]
    assert found['suggested']['before']['unique_share'] == 0.0
    assert mounts[-1]['unique_share'] > 0.0
    assert 'Suggested reflectors' in (tmp_path / 'a' / 'plan.html').read_text(encoding='utf-8')
    for name in ('layout.csv', 'layout.imk'):
        layout = tmp_path / 'a' / name
        _, out, _ = plan(
            capsys, 'symmetric', '--reflectors', layout, '--out', tmp_path / 'b', *common,
            drawn=name == 'layout.imk',
        )  # fmt: skip
        again = json.loads(out)
        assert again['reflectors'] == 12
        assert again['driving_sigma_m']['max'] == pytest.approx(
            found['driving_sigma_m']['max'], rel=1e-3
        )


def test_fewest_on_given_poles(tmp_path, capsys):
    poles = [(1.0, 1.0), (39.0, 1.0), (39.0, 29.0), (1.0, 29.0), (20.0, 15.0), (20.0, 1.0)]
    rows = '\n'.join(f'{x},{y}' for x, y in poles)
    (tmp_path / 'poles.csv').write_text(f'x,y\n{rows}\n', encoding='utf-8')
    code, out, _ = plan(
        capsys, 'yard', '--out', tmp_path, '--spacing', 2, '--minimum', '--need', 'accuracy',
        '--area', '2,2 38,2 38,28 2,28', '--goal', 0.012, '--mountable', tmp_path / 'poles.csv',
    )  # fmt: skip
    found = json.loads((tmp_path / 'plan.json').read_text(encoding='utf-8'))
    assert code == 0
    assert found['goal_share'] == 1.0
    mounts = found['suggested']['mounts']
    assert {(m['x_m'], m['y_m']) for m in mounts} <= set(poles)
    assert 'reach the goal' in out


def test_no_reflector_is_suggested_on_a_path(tmp_path, capsys):
    (tmp_path / 'poles.csv').write_text('x,y\n10,10\n30,9.7\n12,20\n30,20\n', encoding='utf-8')
    poses = ('0 5 10 0 0 0 0 1\n', '1 35 10 0 0 0 0 1\n')  # far apart: the way between counts
    (tmp_path / 'path.tum').write_text(''.join(poses), encoding='utf-8')
    _, _, err = plan(
        capsys, 'yard', '--out', tmp_path, '--path', tmp_path / 'path.tum', '--spacing', 2,
        '--suggest', 4, '--goal', 0.002, '--mountable', tmp_path / 'poles.csv',
    )  # fmt: skip
    assert err == '2 of 4 poles are in the way of robots: they are not used\n'
    found = json.loads((tmp_path / 'plan.json').read_text(encoding='utf-8'))
    assert {m['y_m'] for m in found['suggested']['mounts']} == {20.0}
