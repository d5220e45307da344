# SPDX-License-Identifier: Apache-2.0
"""Loops in a made building are closed rightly, and the table says so."""

import argparse

import numpy as np

from rlml_lab.studies import study_building as study
from rlml_slam import se2


def test_route_is_one_that_a_robot_can_drive():
    poses = study.route(60.0, 0.5)
    steps = se2.between(poses[:-1], poses[1:])
    assert np.isfinite(poses).all()
    assert np.hypot(steps[:, 0], steps[:, 1]).max() < 1.1 * 0.5 * study.SPEED
    assert np.abs(steps[:, 2]).max() < 1.1 * 0.5 * study.TURN


def test_odometry_without_errors_is_the_way():
    poses = study.route(40.0, 0.5)
    odometry = study.odometry_of(poses, 0.0, np.random.default_rng(0))
    assert np.abs(se2.between(se2.compose(poses[0], odometry), poses)).max() < 1e-9


def test_stalls_and_cuts_come_again_and_again():
    inside = study.is_within(np.arange(0.0, 10.0), 4.0, 2.0, 1.0)
    assert np.flatnonzero(inside).tolist() == [1, 2, 5, 6, 9]


def row_of(capsys, **options):
    usual = {'size': 40.0, 'rate': 2.0, 'poor': 1.0, 'speed': study.SPEED, 'stall': 0.0}
    more = {'cut': 0.0, 'every': 30.0, 'closed': False, 'seeds': 1, 'first': 0}
    assert study.run(argparse.Namespace(**{**usual, **more, **options})) == 0
    header, row = capsys.readouterr().out.splitlines()
    assert 'enabled wrong' in header
    return row.split()


def test_closures_of_a_building_are_right(capsys):
    _, scans, odometry, _, rms, _, right, wrong, enabled, ok_and_wrong, _ = row_of(capsys)
    assert int(scans) == len(study.route(40.0, 0.5))
    assert float(rms) < 0.1 < float(odometry)
    assert int(right) > 10
    assert (wrong, enabled, ok_and_wrong) == ('0', '0', '0.00%')


def test_odometry_that_stalls_in_bare_corridors_is_not_lost(capsys):
    """The robot stood still after each stall: 7.4 m off, 7.8 % of the poses OK and wrong."""
    row = row_of(capsys, size=60.0, rate=5.0, speed=0.9, stall=0.8, every=60.0, first=22)
    before_closing, rms, ok_and_wrong = float(row[3]), float(row[4]), row[9]
    assert before_closing < 3.0
    assert rms < 0.2
    assert ok_and_wrong == '0.00%'


def test_way_back_through_bare_corridors_closes_no_loop_by_walls_across(capsys):
    """Displaced by the width of a crossing, it fits those that it saw on the way there."""
    row = row_of(capsys, size=60.0, poor=2.0, closed=True, first=7)
    assert float(row[4]) < 0.1
    assert row[-3:-1] == ['0', '0.00%']


def test_closed_building_has_walls_along_all_corridors():
    walls = np.array(study.ClosedBuilding(3, 60.0).geometry.segments)[:, :4]
    lengths = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
    along = np.minimum(np.abs(walls[:, 2] - walls[:, 0]), np.abs(walls[:, 3] - walls[:, 1]))
    assert along.max() < 1e-9
    assert lengths.max() <= 60.0
