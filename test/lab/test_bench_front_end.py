# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench front-end``: every scan is counted once, with all that it costs."""

from __future__ import annotations

import importlib.util
import itertools
import json

import pytest

from rlml_lab.bench import bench_front_end
from rlml_lab.main import main

FEW = ['bench', 'front-end', '--scans', '70', '--beams', '180']


def test_figures_of_the_hall(capsys):
    assert main([*FEW, '--without', 'yag-slam', '--json']) == 0
    (hall,) = json.loads(capsys.readouterr().out)['results']
    assert hall['beams'] == 180
    assert hall['scans'] == 70 - bench_front_end.WARM
    assert 1 <= hall['reflectors_at_most'] <= 12
    assert 0.0 < hall['rlml']['median'] <= hall['rlml']['p99'] <= hall['rlml']['max']
    assert hall['yag_slam']['median'] is None
    assert hall['ratio'] is None
    lines = bench_front_end.text([hall]).splitlines()
    assert lines[2].split()[:4] == ['hall', '180', str(hall['reflectors_at_most']), '20']
    assert lines[2].endswith('not measured')


@pytest.mark.skipif(not importlib.util.find_spec('karto_scanmatcher'), reason='needs yag-slam')
def test_rival_follows_the_robot():
    rival = bench_front_end.Rival()
    inputs = bench_front_end.from_hall(360)
    given = []
    for add in inputs:
        for o in add():
            if o.scan is not None and rival.wants(o):
                rival.add(o)
                given.append(o)
        if len(given) == 8:
            break
    moved = [b.odom_pose - a.odom_pose for a, b in itertools.pairwise(given)]
    assert all(abs(step).max() > 0.1 for step in moved)
    # the odometry of the first metres is good: so must the rival's pose be
    found = rival._running[-1].corrected_pose
    x, y, _ = bench_front_end.se2.compose(given[-1].odom_pose, given[-1].T_base_laser)
    assert [found.x, found.y] == pytest.approx([x, y], abs=0.15)


def test_too_few_scans_are_one_line(capsys):
    assert main(['bench', 'front-end', '--scans', '50']) == 1
    assert 'the first 50 are not counted' in capsys.readouterr().err
