# SPDX-License-Identifier: Apache-2.0
"""``rlml plan``: exit code, files and errors."""

from __future__ import annotations

import json

from rlml_slam.cli.main import main
from rlml_slam.maps import nav2_map
from rlml_slam.planning import site as sites
from rlml_slam.simulation.world_file import load_world


def plan(capsys, *arguments) -> tuple[int, str, str]:
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
    assert len(list(tmp_path.glob('*.png'))) == 7


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
    _, whole, _ = plan(capsys, tmp_path / 'hall.yaml', *common)
    _, part, _ = plan(capsys, tmp_path / 'hall.yaml', *common, '--area', '0,0 10,0 10,10 0,10')
    assert 0 < json.loads(part)['places'] < json.loads(whole)['places']


def test_bad_input_is_one_line(tmp_path, capsys):
    for arguments, reason in (
        ((tmp_path / 'none.yaml',), 'cannot be read'),
        (('hall', '--area', '0,0 1'), '--area'),
        (('hall', '--area', '0,0 1,1'), 'at least three points'),
        (('hall', '--goal', 0), '--goal'),
        (('hall', '--reflectors', tmp_path / 'none.csv'), 'cannot be read'),
        (('hall', '--path', tmp_path / 'none.tum'), 'none.tum'),
    ):
        code, _, err = plan(capsys, *arguments, '--out', tmp_path)
        assert code == 1
        assert reason in err
        assert err.count('\n') == 1
