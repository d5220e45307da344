# SPDX-License-Identifier: Apache-2.0
"""``rlml audit`` of replays and bags: exit codes, files and errors."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from rlml_slam.cli.main import main
from rlml_slam.maps import reflector_file, saved_map
from rlml_slam.params import Parameters
from rlml_slam.report.outputs import SIGHTINGS
from rlml_slam.ros.front_end import incident_file
from rlml_slam.ros.front_end.incident import Published, Received
from rlml_slam.types import Health

ROOM = Path(__file__).resolve().parents[2] / 'bags' / 'room'


@pytest.fixture(scope='module')
def replayed(room_run, tmp_path_factory):
    """A copy, since an audit writes into the folder of the run."""
    return shutil.copytree(room_run / 'run', tmp_path_factory.mktemp('audit') / 'run')


@pytest.fixture(scope='module')
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp('audit') / 'plan'
    main(['plan', 'room', '--out', str(folder), '--spacing', '0.5'])
    return folder


def audit(capsys, *arguments) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main(['audit', *map(str, arguments)])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_run_is_as_its_own_map(replayed, capsys):
    code, out, _ = audit(capsys, replayed)
    assert code == 0
    assert 'all is as planned' in out
    assert '<h1>Audit of run</h1>' in (replayed / 'audit/audit.html').read_text(encoding='utf-8')
    assert (replayed / 'audit/audit.png').stat().st_size > 5000


def test_layout_with_another_reflector_has_a_finding(replayed, tmp_path, capsys):
    known = saved_map.load(replayed).reflectors
    points = known.points.copy()
    points[0] += [0.06, 0.0]
    rows = [f'{x:.4f},{y:.4f}' for x, y in points]
    (tmp_path / 'layout.csv').write_text('x,y\n' + '\n'.join(rows) + '\n')
    plan = tmp_path / 'plan'
    main(['plan', str(replayed / 'map.yaml'), '--reflectors', str(tmp_path / 'layout.csv'),
          '--out', str(plan), '--spacing', '0.5'])  # fmt: skip
    code, out, _ = audit(capsys, replayed, '--plan', plan, '--out', tmp_path / 'out', '--json')
    found = json.loads(out)
    assert code == 1
    assert found == json.loads((tmp_path / 'out/audit.json').read_text(encoding='utf-8'))
    assert [f['kind'] for f in found['findings']] == ['moved']
    shift = np.array(found['reflectors'][0]['displaced_m'])
    np.testing.assert_allclose(shift, [-0.06, 0.0], atol=0.02)


def test_bag_is_replayed_in_the_map_of_the_plan(plan, tmp_path, capsys):
    code, out, _ = audit(capsys, ROOM, '--plan', plan, '--out', tmp_path / 'out')
    assert code == 0
    assert 'all is as planned' in out
    assert (tmp_path / 'out/run' / SIGHTINGS).exists()


def test_incident_is_audited_as_a_bag(plan, tmp_path, capsys):
    """A file of the black box: inputs as they came, beside poses and health of its node."""
    with AnyReader([ROOM]) as bag:
        received = [Received(at, c.topic, c.msgtype, data) for c, at, data in bag.messages()]
    static = [r for r in received if r.topic == '/tf_static']
    moving = [r for r in received if r.topic != '/tf_static']
    pose = Published(moving[9].time, moving[9].time, np.zeros(3), np.eye(3), Health())
    path = tmp_path / 'incident-20260101-120000-lost.mcap'
    incident_file.write(path, {'reason': 'lost'}, static, moving, [pose], Parameters())
    code, out, _ = audit(capsys, path, '--plan', plan, '--out', tmp_path / 'out')
    assert code == 0
    assert 'all is as planned' in out
    code, _, err = audit(capsys, path, '--out', tmp_path / 'own')
    assert code == 0, err


def test_errors_are_exit_code_2(replayed, tmp_path, capsys):
    for arguments in (
        (tmp_path / 'none',), (tmp_path,), (replayed, '--plan', tmp_path),
        (replayed, '--tolerance', '7'), (replayed, '--sensor', tmp_path / 'none.yaml'),
    ):  # fmt: skip
        code, _, err = audit(capsys, *arguments)
        assert code == 2, arguments
        assert err.startswith('rlml: ')
    whole = (replayed / SIGHTINGS).read_bytes()
    (tmp_path / 'cut').mkdir()
    (tmp_path / 'cut' / SIGHTINGS).write_bytes(whole[:-9])
    reflector_file.save(saved_map.load(replayed).reflectors, tmp_path / 'cut/reflectors.csv')
    code, _, err = audit(capsys, tmp_path / 'cut')
    assert code == 2
    assert 'damaged' in err
