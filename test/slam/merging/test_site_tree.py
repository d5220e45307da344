# SPDX-License-Identifier: Apache-2.0
"""Sessions are placed where exactly one pose fits; in a site that repeats, nobody guesses."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.maps.survey import Survey
from rlml_slam.params import Parameters
from rlml_slam.slam.merging.placement import place_session
from rlml_slam.slam.merging.site_map import Session, site_of
from rlml_slam.slam.merging.site_tree import place_sessions
from rlml_slam.types import ANONYMOUS

PARAMS = Parameters()
SIGMA, REACH = 0.01, 12.0


def session(name, reflectors, middle, rng, half=26.0, pose=None, ids=None):
    """What a drive around ``middle`` maps of reflectors, in a frame of its own at ``pose``."""
    T = np.array([*middle, rng.uniform(-3.0, 3.0)]) if pose is None else np.asarray(pose)
    half = np.broadcast_to(half, 2)
    near = (np.abs(reflectors - middle) < half).all(axis=1)
    own = se2.transform(se2.inverse(T), reflectors[near])
    own = own + SIGMA * rng.standard_normal(own.shape)
    n = len(own)
    grid = np.stack(
        np.meshgrid(*(np.arange(-h + 4.0, h - 3.9, 4.0) for h in half)), axis=-1
    ).reshape(-1, 2)
    views = se2.transform(se2.inverse(T), grid + middle)
    of = np.full(n, ANONYMOUS) if ids is None else ids[near]
    return T, Session(
        name, None, own, np.tile(SIGMA**2 * np.eye(2), (n, 1, 1)), of, np.arange(n), views, 4.0
    )


def assert_placed(placed, truth, tolerance=0.1):
    """Every session of the site lies where it does in truth, as the first one says."""
    site = placed.site
    first = se2.compose(truth[site.sessions[0].name], se2.inverse(site.poses[0]))
    for s, T in site.placed:
        off = se2.between(truth[s.name], se2.compose(first, T))
        assert (np.abs(off) < (tolerance, tolerance, 0.01)).all(), (s.name, off)


@pytest.mark.parametrize('seed', range(5))
def test_sessions_that_overlap_become_one_site_and_strangers_are_left_out(seed):
    rng = np.random.default_rng(seed)
    reflectors = rng.uniform(0.0, 120.0, (144, 2))
    other = rng.uniform(0.0, 120.0, (144, 2))
    made = {
        f'{x}-{y}': session(f'{x}-{y}', reflectors, np.array([x, y]), rng)
        for x in (20.0, 46.0, 72.0, 98.0) for y in (20.0, 46.0, 72.0, 98.0)
    }  # fmt: skip
    made['stranger'] = session('stranger', other, np.array([60.0, 60.0]), rng)
    order = rng.permutation(list(made))
    placed = place_sessions([made[name][1] for name in order], PARAMS)
    assert_placed(placed, {name: T for name, (T, _) in made.items()})
    assert 'stranger' in placed.left_out
    # by the few reflectors that two have in common, most are placed, and the others are reported
    assert len(placed.site.sessions) >= 14
    assert {s.name for s in placed.site.sessions} | set(placed.left_out) == set(made)
    assert all(placed.why[s.name] for s in placed.site.sessions)


# an aisle of 12 reflectors that repeats every 10 m, and a part of the hall that does not
AISLE = np.random.default_rng(3).uniform((0.0, 1.0), (40.0, 9.0), (12, 2))


def aisles(n):
    return np.concatenate([AISLE + np.array([0.0, 10.0 * k]) for k in range(n)])


def aisle(name, k, rng, number=1, reflectors=None):
    """A session of ``number`` aisles from the k-th on."""
    middle = np.array([20.0, 10.0 * k + 5.0 * number])
    return session(name, aisles(8) if reflectors is None else reflectors, middle, rng,
                   half=(20.0, 5.0 * number))  # fmt: skip


def test_sessions_of_aisles_that_repeat_are_not_guessed():
    rng = np.random.default_rng(0)
    whole = aisle('whole', 0, rng, 4)[1]
    for k in range(3):
        one = aisle('one', k, rng)[1]
        found = place_session(one, site_of([(whole, np.zeros(3))]), PARAMS.relocalization)
        assert found.pose is None
        assert 'poses fit' in found.why
    # two aisles each, one in common: 24 reflectors match where only 12 are the same
    lower, upper = aisle('lower', 0, rng, 2)[1], aisle('upper', 1, rng, 2)[1]
    found = place_session(upper, site_of([(lower, np.zeros(3))]), PARAMS.relocalization)
    assert found.pose is None


@pytest.mark.parametrize('seed', range(4))
def test_aisles_taken_for_one_are_parted_by_the_session_that_has_seen_both(seed):
    """Each of two looks like the other, and nobody knows better until the third one."""
    rng = np.random.default_rng(seed)
    distinct = rng.uniform((42.0, -20.0), (75.0, 20.0), (24, 2))
    site = np.concatenate([aisles(2), distinct])
    made = {
        'first': session('first', np.concatenate([AISLE, distinct]), np.array([37.0, 0.0]), rng,
                         half=(38.0, 20.0)),
        'second': session('second', aisles(2)[12:], np.array([20.0, 15.0]), rng, half=(20.0, 5.0)),
        'both': session('both', site, np.array([37.0, 0.0]), rng, half=(38.0, 20.5)),
    }  # fmt: skip
    for order in (
        ('first', 'second', 'both'),
        ('second', 'both', 'first'),
        ('both', 'first', 'second'),
    ):
        placed = place_sessions([made[name][1] for name in order], PARAMS)
        assert_placed(placed, {name: T for name, (T, _) in made.items()})
        assert 'second' in placed.left_out
        assert {s.name for s in placed.site.sessions} <= {'first', 'both'}


@pytest.mark.parametrize('seed', range(6))
def test_no_session_of_a_repeating_site_is_ever_at_a_wrong_place(seed):
    """Sessions anywhere in a site of eight equal aisles: placed rightly or left out."""
    rng = np.random.default_rng(seed)
    distinct = rng.uniform((42.0, 0.0), (70.0, 80.0), (20, 2))
    reflectors = np.concatenate([aisles(8), distinct])
    made = {}
    for k in range(10):
        middle = rng.uniform((10.0, 10.0), (60.0, 70.0))
        made[f's{k}'] = session(f's{k}', reflectors, middle, rng, rng.uniform(8.0, 30.0, 2))
    made['all'] = session('all', reflectors, np.array([35.0, 40.0]), rng, (36.0, 41.0))
    order = rng.permutation(list(made))
    placed = place_sessions([made[name][1] for name in order], PARAMS)
    assert_placed(placed, {name: T for name, (T, _) in made.items()})
    assert set(placed.left_out) == set(made) - {s.name for s in placed.site.sessions}


def test_survey_places_what_repeats_only_where_it_is_one_place():
    rng = np.random.default_rng(1)
    distinct = rng.uniform((42.0, 0.0), (60.0, 10.0), (10, 2))
    reflectors = np.concatenate([aisles(4), distinct])
    n = len(reflectors)
    survey = Survey(np.full(n, ANONYMOUS), reflectors, np.full(n, np.nan))
    made = {
        'end': session('end', reflectors, np.array([30.0, 5.0]), rng, (32.0, 5.0)),
        'middle': aisle('middle', 2, rng, reflectors=reflectors),
    }
    placed = place_sessions([s for _, s in made.values()], PARAMS, survey)
    assert placed.is_in_survey_frame
    assert set(placed.left_out) == {'middle'}
    np.testing.assert_allclose(placed.site.pose_of(made['end'][1]), made['end'][0], atol=0.05)


def test_ids_forbid_a_place_that_the_constellation_allows():
    rng = np.random.default_rng(2)
    ids = np.arange(12)
    site = site_of([(session('a', AISLE, np.array([20.0, 5.0]), rng, ids=ids)[1], np.zeros(3))])
    same = session('b', AISLE, np.array([20.0, 5.0]), rng, ids=ids)[1]
    other = session('c', AISLE, np.array([20.0, 5.0]), rng, ids=ids + 100)[1]
    assert place_session(same, site, PARAMS.relocalization).pose is not None
    assert place_session(other, site, PARAMS.relocalization).pose is None


def test_order_and_frames_of_the_sessions_change_nothing():
    rng = np.random.default_rng(4)
    reflectors = rng.uniform(0.0, 80.0, (100, 2))
    made = [session(f's{k}', reflectors, rng.uniform(20.0, 60.0, 2), rng) for k in range(6)]
    results = []
    for order in (range(6), range(5, -1, -1), (3, 0, 5, 1, 4, 2)):
        placed = place_sessions([made[k][1] for k in order], PARAMS)
        assert_placed(placed, {s.name: T for T, s in made})
        results.append({s.name for s in placed.site.sessions})
    assert results[0] == results[1] == results[2]
