# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench live``: what is sent, what is answered, and what it costs."""

from __future__ import annotations

import json

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

from rlml_lab.bench.bench_live import text
from rlml_lab.main import main


def test_every_scan_that_is_sent_gets_its_pose(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ['bench', 'live', '--minutes', '0.17', '--hz', '20', '--beams', '360', '--json']
    assert main(arguments) == 0
    f = json.loads(capsys.readouterr().out)
    # 10.2 s of scans
    assert 200 <= f['scans_sent'] <= 206
    assert f['dropped'] == 0
    assert f['poses'] == f['scans_sent']
    assert 0.0 < f['latency_ms']['median'] <= f['latency_ms']['p99']
    assert 0.0 < f['nodes']['front_end']['cpu_share'] < 2.0
    assert f['nodes']['back_end']['peak_rss_mb'] > 50.0
    lines = text(f).splitlines()
    assert lines[0].startswith(f'{f["poses"]} scans sent, {f["poses"]} poses received, 0 scans')
    assert len(lines) == 6
    assert list(tmp_path.iterdir()) == []  # no map is left where it was started


@pytest.mark.parametrize(
    ('arguments', 'why'),
    [
        (['--minutes', '0.1'], 'gives less than 10 s'),
        (['--hz', '-1'], 'laser.rate = -1.0 is outside'),
        (['--world', 'nowhere'], 'nowhere'),
    ],
)
def test_wrong_argument_is_one_line(capsys, arguments, why):
    assert main(['bench', 'live', *arguments]) == 1
    err = capsys.readouterr().err
    assert why in err
    assert err.count('\n') == 1
