# SPDX-License-Identifier: Apache-2.0
"""Reflectors and scan together determine the pose, or contradict each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import CORRIDOR, OTHER_ROOM, ROOM, TinyWorld, drive, observations, polygon

from rlml_slam import se2
from rlml_slam.maps.occupancy import render
from rlml_slam.params import Node, Parameters
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.types import ANONYMOUS, Reflectors, Verdict

P = Parameters()
# reflectors of no order, and ones that look the same turned by half
SOME = np.array([[-3.6, -2.7], [3.4, -2.9], [3.8, 1.1], [-0.7, 2.6], [-3.9, 1.9], [1.5, -2.4]])
HALF = np.array([[-3.6, -2.7], [-1.1, -2.9], [2.3, -2.8], [3.7, -0.4]])
TURNED = np.vstack([HALF, -HALF])
HALL = polygon((-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, 3.0))  # the same turned by half
PATH = drive((0.6, 0.0, 4.0), (0.0, 0.8, 4.0), (0.4, 0.3, 4.0))[::4]
HERE = np.array([0.8, 0.5, 1.1])


def grid_of(world, path=PATH):
    seen = observations(world, path)
    return render(path, [o.points for o in seen], [o.origin for o in seen])


def map_of(points):
    m = len(points)
    return Reflectors(
        np.arange(m), np.array(points, dtype=np.float64), np.tile(1e-4 * np.eye(2), (m, 1, 1)),
        np.full(m, ANONYMOUS), np.full(m, 9), np.full(m, np.nan),
    )  # fmt: skip


def seen(world, pose=HERE, **kw):
    (o,) = observations(world, [pose], rng=np.random.default_rng(0), **kw)
    return o


def assert_here(found, truth=HERE):
    error = se2.between(truth, found.pose)
    assert np.hypot(error[0], error[1]) < 0.05
    assert abs(error[2]) < 0.02


@pytest.mark.parametrize('walls', [ROOM.walls, HALL])
def test_reflectors_tell_the_place_and_the_scan_fits_there(walls):
    world = TinyWorld(walls, SOME)
    found = localize_globally(grid_of(world), map_of(SOME), seen(world), P)
    assert found.verdict is Verdict.UNIQUE
    assert 'the scan fits' in found.why
    assert_here(found)


def test_reflectors_tell_the_place_without_scans():
    world = TinyWorld(HALL, SOME)
    for grid, observation in ((None, seen(world)), (grid_of(world), seen(world, scan=False))):
        found = localize_globally(grid, map_of(SOME), observation, P)
        assert found.verdict is Verdict.UNIQUE
        assert 'no scan to confirm it' in found.why
        assert_here(found)


def test_corridor_is_told_by_its_reflectors():
    """A scan leaves the way along it open, reflectors do not."""
    x = np.array([2.0, 5.3, 7.1, 11.0, 13.2, 18.1])
    world = replace(CORRIDOR, reflectors=np.stack([x, np.array([1.1, -1.1] * 3)], -1))
    path = drive((1.0, 0.0, 20.0))[::10]
    here = np.array([7.0, 0.2, 0.1])
    found = localize_globally(grid_of(world, path), map_of(world.reflectors), seen(world, here), P)
    assert found.verdict is Verdict.UNIQUE
    assert_here(found, here)


def test_scan_tells_twins_apart():
    recess = polygon(
        (-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (1.0, 3.0), (1.0, 1.5), (-2.0, 1.5), (-2.0, 3.0),
        (-4.0, 3.0),
    )  # fmt: skip
    world = TinyWorld(recess, TURNED)
    found = localize_globally(grid_of(world), map_of(TURNED), seen(world), P)
    assert found.verdict is Verdict.UNIQUE
    assert_here(found)


def test_reflectors_and_scan_each_in_doubt_tell_the_place_together():
    """The scan leaves half a turn open, and the same reflectors stand 60 m away once more."""
    world = TinyWorld(HALL, SOME)
    twice = np.vstack([SOME, SOME + np.array([60.0, 0.0])])
    grid = grid_of(world)
    found = localize_globally(grid, map_of(twice), seen(world), P)
    assert found.verdict is Verdict.UNIQUE
    assert 'of these, the scan fits one' in found.why
    assert_here(found)
    assert localize_globally(None, map_of(twice), seen(world), P).verdict is Verdict.AMBIGUOUS


def test_unique_scan_is_not_believed_where_reflectors_stand_elsewhere():
    """The map has the reflectors twice, but neither where the scan says."""
    moved = np.vstack([SOME + np.array([60.0, 0.0]), SOME + np.array([0.0, 60.0])])
    found = localize_globally(
        grid_of(ROOM), map_of(moved), seen(replace(ROOM, reflectors=SOME)), P
    )
    assert found.verdict is Verdict.AMBIGUOUS
    assert 'the scan fits where the reflectors do not' in found.why


def test_what_looks_the_same_turned_to_both_is_ambiguous():
    world = TinyWorld(HALL, TURNED)
    found = localize_globally(grid_of(world), map_of(TURNED), seen(world), P)
    assert found.verdict is Verdict.AMBIGUOUS
    assert 'fit alike' in found.why


def test_scan_that_does_not_fit_where_the_reflectors_do_makes_it_ambiguous():
    found = localize_globally(grid_of(OTHER_ROOM), map_of(SOME), seen(TinyWorld(HALL, SOME)), P)
    assert found.verdict is Verdict.AMBIGUOUS
    assert 'but there the scan has a score' in found.why


def test_scan_alone_tells_the_place_where_reflectors_cannot():
    grid = grid_of(ROOM)
    few = replace(ROOM, reflectors=ROOM.reflectors[:2])
    for observation in (seen(few), seen(ROOM, reflectors=False)):
        found = localize_globally(grid, map_of(ROOM.reflectors), observation, P)
        assert found.verdict is Verdict.UNIQUE
        assert_here(found)


def test_scan_tells_the_place_where_reflectors_are_too_many_to_be_searched():
    x, y = np.meshgrid(np.arange(68), np.arange(68))
    far = np.stack([x.ravel(), y.ravel()], -1)
    survey_frame = map_of(np.vstack([ROOM.reflectors, 20.0 + 0.1 * far]))
    found = localize_globally(grid_of(ROOM), survey_frame, seen(ROOM), P)
    assert found.verdict is Verdict.UNIQUE
    assert_here(found)
    # a place that nothing was searched for is not impossible
    found = localize_globally(None, survey_frame, seen(ROOM), P)
    assert found.verdict is Verdict.NOT_SEARCHED
    assert found.pose is None
    assert 'too many to be searched' in found.why
    # as many that do not stand that close are searched
    found = localize_globally(
        None, map_of(np.vstack([ROOM.reflectors, 20.0 + 4.0 * far])), seen(ROOM), P
    )
    assert found.verdict is Verdict.UNIQUE
    assert_here(found)


def test_reflectors_that_are_switched_off_do_not_count():
    world = TinyWorld(HALL, SOME)
    off = replace(P, node=replace(Node(), use_reflectors=False))
    assert (
        localize_globally(grid_of(world), map_of(SOME), seen(world), off).verdict
        is Verdict.AMBIGUOUS
    )


def test_without_a_frame_there_is_no_place():
    found = localize_globally(None, map_of(SOME), None, P)
    assert found.verdict is Verdict.IMPOSSIBLE
