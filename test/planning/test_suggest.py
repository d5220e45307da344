# SPDX-License-Identifier: Apache-2.0
"""Suggested reflectors: what they are said to bring is what the plan shows; few are enough."""

from __future__ import annotations

from itertools import combinations, count

import numpy as np
import pytest

from rlml_slam.errors import MapError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning import site as sites
from rlml_slam.planning.coverage import Choice, Coverage, start
from rlml_slam.planning.mounts import APART, MOST, thin, wall_mounts
from rlml_slam.planning.plan import Goal, make_plan
from rlml_slam.planning.site import Site
from rlml_slam.planning.suggest import Wanted, coverage, exchanged, grown, suggest, suggested
from rlml_slam.se2 import Array
from rlml_slam.simulation.world_file import load_world

P, SENSOR = Parameters(), SimulatorParameters()
NONE = np.zeros((0, 2))


def empty(name: str) -> Site:
    return sites.of_world(load_world(name).without_reflectors())


def covered(site: Site, mounts: Array, wanted: Wanted, spacing: float = 1.0) -> Coverage:
    return coverage(site, mounts, sites.places(site, spacing, 0.3), P, SENSOR, wanted, NONE)


def with_mounts(of: Coverage, mounts: tuple[int, ...]) -> Choice:
    return start(of).changed(*(of.num_present + k for k in mounts)) if mounts else start(of)


@pytest.mark.parametrize('hidden', [0, 1, 2])
def test_places_that_lack_accuracy_are_those_of_the_plan(hidden):
    site = sites.of_world(load_world('hall'))
    places = sites.places(site, 1.0, 0.3)
    goal = Goal(0.012, hidden=hidden)
    plan = make_plan(site, places, P, SENSOR, goal)
    of = coverage(site, NONE, places, P, SENSOR, Wanted(1, goal, is_unique=False), NONE)
    assert 0.0 < plan.is_reached.mean() < 1.0
    assert np.mean((start(of).cost == 0.0) == plan.is_reached) > 0.995


@pytest.mark.parametrize('hidden', [0, 1])
def test_gains_are_the_losses_that_fall(hidden):
    site = empty('room')
    of = covered(site, wall_mounts(site, 2.0, 0.3), Wanted(1, Goal(0.01, hidden=hidden),
                                                      is_unique=False))  # fmt: skip
    rng = np.random.default_rng(3)
    for _ in range(5):
        choice = with_mounts(of, tuple(rng.choice(len(of.points), 4, replace=False).tolist()))
        gains = choice.gains()
        for k in rng.choice(np.flatnonzero(~choice.chosen), 4, replace=False):
            more = choice.changed(int(k))
            assert choice.loss - more.loss == pytest.approx(gains[k], abs=1e-9)
            fresh = with_mounts(of, tuple(np.flatnonzero(more.chosen).tolist()))
            np.testing.assert_allclose(fresh.after, more.after, atol=1e-9)
            assert more.changed(int(k)).loss == pytest.approx(choice.loss, abs=1e-9)


def test_fewest_are_the_fewest_of_all_choices():
    site = empty('room')
    mounts = wall_mounts(site, 1.8, 0.3)
    wanted = Wanted(None, Goal(0.012), is_unique=False)
    of = covered(site, mounts, wanted, 0.6)
    found = suggest(of, wanted)
    assert found.is_complete
    assert found.at_least == len(found.mounts) >= 3
    fewer = combinations(range(len(of.points)), len(found.mounts) - 1)
    assert not any(with_mounts(of, c).is_complete for c in fewer)


def test_fewest_are_found_on_a_busy_machine(monkeypatch):
    """Of the clock on the wall, an hour passes between two looks."""
    site = empty('room')
    wanted = Wanted(None, Goal(0.012), is_unique=False)
    of = covered(site, wall_mounts(site, 1.8, 0.3), wanted, 0.6)
    hours = count(0.0, 3600.0)
    monkeypatch.setattr('time.monotonic', lambda: next(hours))
    found = suggest(of, wanted)
    assert found.at_least == len(found.mounts) >= 3


def test_exchanges_are_near_the_best_choice():
    site = empty('room')
    of = covered(site, wall_mounts(site, 1.8, 0.3), Wanted(3, Goal(0.01), is_unique=False))
    found = exchanged(grown(start(of), 3))
    best = min(with_mounts(of, c).loss for c in combinations(range(len(of.points)), 3))
    without = start(of).loss
    assert without - found.loss >= 0.95 * (without - best)


def test_goal_holds_with_any_suggested_reflector_hidden():
    site = empty('room')
    places = sites.places(site, 1.0, 0.3)
    wanted = Wanted(None, Goal(0.015, hidden=1), is_unique=False)
    found, plan = suggested(site, wall_mounts(site, 1.0, 0.3), places, P, SENSOR, wanted)
    assert found.is_complete
    assert plan.is_reached.all()
    for k in range(len(found.mounts)):
        rest = site.with_posts(np.delete(found.mounts, k, axis=0))
        assert make_plan(rest, places, P, SENSOR, Goal(0.015)).is_reached.all()


def test_symmetric_hall_becomes_unique():
    site = sites.of_world(load_world('symmetric'))
    places = sites.places(site, 1.0, 0.3)
    wanted = Wanted(None, Goal(0.02), is_accurate=False)
    found, plan = suggested(site, wall_mounts(site, 2.0, 0.3), places, P, SENSOR, wanted)
    assert found.steps[0].unique_share == 0.0
    assert found.steps[-1].unique_share == 1.0
    assert plan.is_unique.all()
    assert not any('turned' in note for note in plan.notes)
    assert found.at_least is not None
    assert 2 <= found.at_least <= len(found.mounts)


def test_each_step_names_what_is_reached_and_shares_never_fall():
    site = empty('hall')
    wanted = Wanted(6, Goal(0.02), is_unique=False)
    places = sites.places(site, 1.0, 0.3)
    found, plan = suggested(site, wall_mounts(site, 2.0, 0.3), places, P, SENSOR, wanted)
    shares = [s.goal_share for s in found.steps]
    assert len(found.mounts) == 6
    assert shares == sorted(shares)
    assert plan.is_reached.mean() == pytest.approx(shares[-1], abs=0.01)


def test_laser_that_looks_forward_needs_more():
    site = empty('room')
    narrow = SimulatorParameters()
    narrow = type(narrow)(laser=type(narrow.laser)(field_of_view=np.pi))
    places, mounts = sites.places(site, 1.5, 0.3), wall_mounts(site, 1.5, 0.3)
    wanted = Wanted(None, Goal(0.02), is_unique=False)
    counts = []
    for sensor in (SENSOR, narrow):
        found = suggest(coverage(site, mounts, places, P, sensor, wanted, NONE), wanted)
        counts.append(len(found.mounts) if found.is_complete else len(mounts))
    assert counts[1] > counts[0]


@pytest.mark.parametrize('name', ['hall', 'symmetric', 'room'])
def test_mounts_touch_walls_and_stand_in_no_aisle(name):
    site = sites.of_world(load_world(name))
    mounts = wall_mounts(site, 1.0, 0.3)
    grid = site.grid
    i, j = np.nonzero(grid.cells >= 65)
    walls = np.array(grid.origin) + grid.resolution * (np.stack([j, i], -1) + 0.5)
    gap = np.hypot(*(mounts[:, None] - walls).transpose(2, 0, 1)).min(axis=1)
    assert 10 < len(mounts) <= MOST
    assert (gap >= 0.06).all()
    assert (gap <= 0.15).all()
    places = sites.places(site, 0.25, 0.3)
    assert np.hypot(*(mounts[:, None] - places).transpose(2, 0, 1)).min() > 0.15
    others = site.reflectors.points
    assert np.hypot(*(mounts[:, None] - others).transpose(2, 0, 1)).min() >= APART


def test_many_mounts_are_thinned():
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    kept = thin(np.stack([x.ravel(), y.ravel()], -1), 1.0, NONE)
    assert MOST / 3 < len(kept) <= MOST


def test_no_mount_is_an_error():
    site = sites.of_world(load_world('yard'))
    wanted = Wanted(3, Goal(0.01))
    with pytest.raises(MapError, match='mountable'):
        suggested(
            site, wall_mounts(site, 1.0, 0.3), sites.places(site, 2.0, 0.3), P, SENSOR, wanted
        )
