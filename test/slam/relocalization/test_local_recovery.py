# SPDX-License-Identifier: Apache-2.0
"""Odometry that is wrong by more than a search around it covers costs no scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import CORRIDOR, ROOM, TinyWorld, drive, errors, observations, polygon

from rlml_slam import se2
from rlml_slam.params import Parameters
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.front_end.scan_term import ScanTerm
from rlml_slam.slam.relocalization.local_recovery import AS_USUAL, recover_locally
from rlml_slam.types import Level, Motion

PATH = drive((0.6, 0.0, 2.0), (0.5, 0.7, 2.0))


def mapped(world):
    """A front end that drove through a world, and the last scan in its submap: place, points."""
    front_end = FrontEnd(Parameters())
    seen = observations(world, PATH, reflectors=False, rng=np.random.default_rng(0))
    for o in seen:
        front_end.process(o)
    place = se2.between(front_end.state.anchor(0), front_end.state.pose)
    return front_end, place, seen[-1].points


@pytest.mark.parametrize('slip', [(0.9, 0.0, 0.0), (-0.6, 0.7, 0.3), (0.0, 0.0, -0.9)])
def test_scan_is_found_where_it_was_taken(slip):
    front_end, place, points = mapped(ROOM)
    submap, usual = front_end.submaps.target, front_end._scans.kidnapping.usual
    found = recover_locally(submap, points, place + slip, usual, Parameters())
    assert found is not None
    assert found.score >= AS_USUAL * usual
    assert found.prior_weight == 0.0
    dx, dy, turn = se2.between(place, found.pose)
    assert np.hypot(dx, dy) < 0.03
    assert abs(turn) < 0.01


def test_nothing_is_found_beyond_its_reach_in_the_same_room():
    front_end, place, points = mapped(ROOM)
    submap, usual = front_end.submaps.target, front_end._scans.kidnapping.usual
    for far in ([2.2, 0.0, 0.0], [0.0, 0.0, 2.5], [-1.5, -1.5, 1.5]):
        assert recover_locally(submap, points, place + far, usual, Parameters()) is None


def test_place_along_a_corridor_is_not_guessed():
    front_end, place, points = mapped(CORRIDOR)
    submap, usual = front_end.submaps.target, front_end._scans.kidnapping.usual
    turned = place + np.array([0.0, 0.0, 0.8])
    assert recover_locally(submap, points, turned, usual, Parameters()) is None


@pytest.mark.parametrize('slip', [(0.6, 0.0, 0.7), (0.0, 0.0, -0.85)], ids=['both', 'turn'])
def test_scan_after_a_slip_is_used_and_mapped_without_a_doubt(slip):
    seen = observations(ROOM, PATH, reflectors=False, rng=np.random.default_rng(0))
    k = len(PATH) - 5
    motion = seen[k].motion
    seen[k] = replace(
        seen[k], motion=Motion(se2.compose(motion.delta, np.array(slip)), motion.cov)
    )
    front_end = FrontEnd(Parameters())
    frames = [front_end.process(o) for o in seen]
    assert not any(f.unconfirmed for f in frames)
    assert all(f.scan_used for f in frames[1:])
    assert all(f.health.level is not Level.LOST for f in frames)
    distance, turn = errors(np.array([f.T_local_base for f in frames]), PATH)
    assert distance.max() < 0.06
    assert turn.max() < 0.03


def with_doors():
    """A corridor with doors in its walls, its ends out of sight."""
    right, left = [(-20.0, -1.2)], [(20.0, 1.2)]
    for x in (-5.0, -1.6, 0.7, 3.9, 6.1, 9.8):
        right += [(x, -1.2), (x, -1.4), (x + 0.9, -1.4), (x + 0.9, -1.2)]
    for x in (8.6, 4.4, 2.6, -0.9, -4.2):
        left += [(x + 0.9, 1.2), (x + 0.9, 1.4), (x, 1.4), (x, 1.2)]
    return TinyWorld(polygon(*right, (20.0, -1.2), *left, (-20.0, 1.2)), np.zeros((0, 2)))


@pytest.mark.parametrize('late', [-0.35, -0.25, 0.35])
def test_scan_with_a_wrong_stamp_is_placed_where_it_was_taken(late):
    path = drive((0.6, 0.0, 6.0))
    seen = observations(with_doors(), path, reflectors=False, rng=np.random.default_rng(0))
    k = len(path) - 3
    for n, way in ((k, late), (k + 1, -late)):  # odometry is right again for the next one
        delta = se2.compose(seen[n].motion.delta, np.array([way, 0.0, 0.0]))
        seen[n] = replace(seen[n], motion=Motion(delta, seen[n].motion.cov))
    front_end = FrontEnd(Parameters())
    frames = [front_end.process(o) for o in seen]
    assert all(f.scan_used for f in frames[1:])
    distance, turn = errors(np.array([f.T_local_base for f in frames]), path)
    assert distance.max() < 0.06
    assert turn.max() < 0.03


@pytest.mark.parametrize('turn', [1.4, -1.45])
def test_scan_of_what_is_new_by_half_contradicts_nothing(turn):
    path = np.array([*drive((0.3, 0.0, 2.0)), *drive((0.0, 0.0, 0.5))])
    path[21:] = se2.compose(path[20], np.array([0.0, 0.0, turn]))
    seen = observations(ROOM, path, reflectors=False, rng=np.random.default_rng(0))
    # a laser of 120 degrees
    ahead = [np.abs(np.arctan2(o.points[:, 1], o.points[:, 0])) < 1.05 for o in seen]
    seen = [replace(o, points=o.points[a]) for o, a in zip(seen, ahead, strict=True)]
    front_end = FrontEnd(Parameters())
    frames = [front_end.process(o) for o in seen]
    assert all(f.scan_used and not f.unconfirmed for f in frames[1:])
    distance, off = errors(np.array([f.T_local_base for f in frames]), path)
    assert distance.max() < 0.06
    assert off.max() < 0.03


def test_scan_of_new_space_is_looked_for_nowhere_else(monkeypatch):
    """In a corridor with doors alike it would fit at one that is mapped already."""
    front_end, place, points = mapped(ROOM)
    searches = []
    monkeypatch.setattr(ScanTerm, '_match_in_window', lambda *args: searches.append(args))
    points = points.copy()
    points[::4] += 40.0
    scans, sure = front_end._scans, np.diag([1e4, 1e4, 1e5])
    found = scans._match(front_end.submaps.target, points, place, sure)
    assert found.score < AS_USUAL * front_end._scans.kidnapping.usual
    assert np.abs(found.pose - place).max() < 0.03
    assert not searches
