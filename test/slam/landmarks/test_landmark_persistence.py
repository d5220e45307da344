# SPDX-License-Identifier: Apache-2.0
"""Missing, moved and new reflectors are distinguished; those that stay are unchanged."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, SECOND, STEP, TinyWorld, drive, messages, polygon

from rlml_slam.cli.main import main
from rlml_slam.cli.map import map_reflectors
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.graph import Graph
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.keyframes import Interval, Sighting
from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.landmark_persistence import HIDDEN, HIDDEN_TIME, LandmarkPersistence
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.slam.landmarks.reflector_states import reflector_states, state_table
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Odometry, Scan

PARAMS = Parameters()
LAP = drive((0.6, 0.6, 10.5), start=(1.0, -1.4, 0.0))  # a circle of 1 m radius around the box
CHANGED = ROOM.reflectors.copy()
CHANGED[1] += [-0.9, 0.3]  # moved
CHANGED = np.vstack([np.delete(CHANGED, 4, axis=0), [[-1.9, 0.4]]])  # one missing, one new


def laps(slam, world, n, start=0, keep=1.0, seed=0):
    """Drive ``n`` laps, from lap ``start`` on; a share of the detections is lost."""
    rng = np.random.default_rng((seed, start))
    slam.set_sensor_pose('laser', np.zeros(3))
    frames = []
    for k in range(start, start + n):
        shift = k * len(LAP) * STEP
        for m in messages(world, LAP, rng=rng):
            m = replace(m, stamp=m.stamp + shift)
            if isinstance(m, Odometry):
                frames += slam.add_odometry(m)
            elif isinstance(m, Scan):
                frames += slam.add_scan(m)
            else:
                frames += slam.add_detections(thinned(m, rng.random(len(m)) < keep))
    return frames


def thinned(d, kept):
    return Detections(
        d.stamp, d.frame_id, d.points[kept], d.cov[kept], d.ids[kept], d.diameters[kept]
    )


def by_state(back_end):
    out = {}
    for s in back_end.reflector_states():
        out.setdefault(s.state, []).append(s)
    return out


@pytest.fixture(scope='module')
def three_laps():
    """A map of the room, which tests copy."""
    slam = Slam(PARAMS)
    laps(slam, ROOM, 3)
    return slam


@pytest.fixture(scope='module')
def changed(three_laps):
    """One reflector is moved, one missing and one new: six laps more, of which five decide."""
    slam = copy.deepcopy(three_laps)
    before = by_state(slam.back_end)
    laps(slam, replace(ROOM, reflectors=CHANGED), 6, start=3)
    slam.finish()
    return slam, before


def at(world_point):
    """Of the world, in the map, which begins at the first pose of the lap."""
    return np.array(world_point) - LAP[0, :2]


def test_first_map_has_nothing_new_in_it(changed):
    assert set(changed[1]) <= {'present', 'ghost'}
    assert len(changed[1]['present']) == len(ROOM.reflectors)


def test_moved_missing_and_new_are_told_apart(changed):
    slam, _ = changed
    found = by_state(slam.back_end)
    (moved,), (missing,), (new,) = (found[s] for s in ('moved', 'missing', 'new'))
    np.testing.assert_allclose(moved.place, at(CHANGED[1]), atol=0.05)
    np.testing.assert_allclose(moved.origin.place, at(ROOM.reflectors[1]), atol=0.05)
    assert moved.distance == pytest.approx(math.hypot(0.9, 0.3), abs=0.05)
    np.testing.assert_allclose(missing.place, at(ROOM.reflectors[4]), atol=0.05)
    np.testing.assert_allclose(new.place, at(CHANGED[-1]), atol=0.05)
    assert len(found['present']) == 4
    assert all(s.probability > 0.99 for s in found['present'])


@pytest.mark.parametrize(('there', 'state'), [(61.0, 'moved'), (30.0, 'present')])
def test_what_came_when_a_settled_one_went_was_moved(changed, there, state):
    """Even where no keyframe is left that stood there before."""
    reflectors = changed[0].back_end.reflector_graph
    (moved,) = by_state(changed[0].back_end)['moved']
    is_new = {m.key: m.history.is_new for m in reflectors.alive()}
    first = reflectors.removed.rows['first'].copy()
    try:
        reflectors.removed.rows['first'] = reflectors.removed.rows['last'] - int(there * 1e9)
        for m in reflectors.alive():
            m.history.is_new = False
        found = {s.key: s.state for s in changed[0].back_end.reflector_states()}
    finally:
        reflectors.removed.rows['first'] = first
        for m in reflectors.alive():
            m.history.is_new = is_new[m.key]
    assert found[moved.key] == state
    assert 'new' not in found.values()


def test_map_and_front_end_have_what_is_there_now(changed):
    slam, _ = changed
    points = slam.reflectors().points
    assert len(points) == len(CHANGED)
    gap = np.linalg.norm(points[:, None] - at(CHANGED)[None], axis=-1)
    assert gap.min(axis=1).max() < 0.05
    held = slam.front_end.reflectors().points
    assert np.linalg.norm(held[:, None] - at(CHANGED)[None], axis=-1).min(axis=1).max() < 0.1
    missing = [s.key for s in by_state(slam.back_end)['missing']]
    assert not set(missing) & set(slam.front_end.tracks.keys.tolist())


def test_states_are_saved_with_the_map(changed, tmp_path, capsys):
    slam, _ = changed
    path = map_file.save(tmp_path / 'a.rlml', slam.back_end, PARAMS)
    again = BackEnd(PARAMS)
    map_file.restore(map_file.load(path), again)
    table = state_table(slam.back_end.reflector_states())
    assert state_table(again.reflector_states()) == table
    assert map_reflectors.of_file(path) == table
    assert main(['map', 'reflectors', str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:4]] == ['moved', 'missing', 'new']
    assert lines[-1].startswith('4 present, ')


@pytest.mark.parametrize('keep', [1.0, 0.5])
def test_what_stays_is_never_given_up(keep):
    """Half of the detections lost at random is no sign of anything."""
    slam = Slam(PARAMS)
    laps(slam, ROOM, 8, keep=keep, seed=1)
    found = by_state(slam.back_end)
    assert set(found) <= {'present', 'ghost'}
    assert len(found['present']) == len(ROOM.reflectors)


def test_hidden_reflector_stays_in_the_map(three_laps):
    """A rack before it: nothing is known of it any more."""
    slam = copy.deepcopy(three_laps)
    x, y = ROOM.reflectors[0]
    rack = polygon((x + 0.3, y - 0.2), (x + 0.8, y - 0.2), (x + 0.8, y + 0.9), (x + 0.3, y + 0.9))
    hidden = TinyWorld(np.vstack([ROOM.walls, rack]), np.delete(ROOM.reflectors, 0, axis=0))
    laps(slam, hidden, 6, start=3)
    found = by_state(slam.back_end)
    assert len(found['present']) == len(ROOM.reflectors)
    assert 'missing' not in found


def test_blind_detector_empties_no_map(three_laps):
    slam = copy.deepcopy(three_laps)
    laps(slam, ROOM.without_reflectors(), 6, start=3)
    assert len(by_state(slam.back_end)['present']) == len(ROOM.reflectors)


def test_hall_without_reflectors_is_mapped():
    slam = Slam(PARAMS)
    assert laps(slam, ROOM.without_reflectors(), 1)
    assert slam.back_end.reflector_states() == []


def test_nothing_is_given_up_where_that_is_not_wanted():
    params = replace(PARAMS, reflector=replace(PARAMS.reflector, persistence_threshold=0.0))
    slam = Slam(params)
    laps(slam, ROOM, 3)
    laps(slam, replace(ROOM, reflectors=CHANGED), 6, start=3)
    assert 'missing' not in by_state(slam.back_end)
    assert len(slam.reflectors()) == len(ROOM.reflectors) + 2


def test_odds_follow_bayes():
    graph = Graph()
    persistence = LandmarkPersistence(
        PARAMS, graph, ReflectorGraph(PARAMS.reflector, OnlineSolver(graph))
    )
    m, pose = Landmark(0), np.zeros(3)
    empty = PARAMS.reflector.unmapped_density * math.pi * PARAMS.reflector.min_separation**2
    m.views[0, 0] = (2, 1)
    assert not persistence._update_odds(m, False, pose, SECOND)
    first = (1 - 3 / 5) / (1 - empty)  # (1 + 2) of (2 + 3)
    assert m.history.odds == pytest.approx(math.log(HIDDEN + (1 - HIDDEN) * first), rel=1e-12)
    # from the same spot, the same miss adds no information
    before = m.history.odds
    persistence._update_odds(m, False, np.array([0.2, 0.0, 0.0]), SECOND)
    assert m.history.odds == before
    # a moment later they have a common cause now and then
    persistence._update_odds(m, False, np.array([0.7, 0.0, 0.0]), 2 * SECOND)
    both = first * 0.5 / (1 - empty)
    assert m.history.odds == pytest.approx(math.log(HIDDEN + (1 - HIDDEN) * both), rel=1e-12)
    # much later they have not
    before = m.history.odds
    persistence._update_odds(m, False, np.array([1.7, 0.0, 0.0]), SECOND + HIDDEN_TIME)
    once = HIDDEN + (1 - HIDDEN) * 0.5 / (1 - empty)
    assert m.history.odds == pytest.approx(before + math.log(once), rel=1e-12)
    before = m.history.odds
    persistence._update_odds(m, True, pose, SECOND + HIDDEN_TIME)
    assert m.history.odds == pytest.approx(before + math.log(3 / 6 / empty), rel=1e-12)
    for k in range(20):
        persistence._update_odds(m, True, np.array([1.0 * k, 0.0, 0.0]), SECOND)
    threshold = PARAMS.reflector.persistence_threshold
    assert m.history.odds == pytest.approx(math.log((1 - threshold) / threshold), rel=1e-12)


def test_no_single_while_ends_a_reflector():
    """However often it is missed meanwhile, from wherever it was always seen."""
    graph = Graph()
    persistence = LandmarkPersistence(
        PARAMS, graph, ReflectorGraph(PARAMS.reflector, OnlineSolver(graph))
    )
    m = Landmark(0)
    for k in range(100):
        m.views[2 * k, 0] = (1000, 0)
    m.history.odds = math.log(
        (1 - PARAMS.reflector.persistence_threshold) / PARAMS.reflector.persistence_threshold
    )
    given_up = [
        persistence._update_odds(
            m, False, np.array([1.0 * k, 0.0, 0.0]), SECOND + k * HIDDEN_TIME // 20
        )
        for k in range(100)
    ]
    assert not any(given_up[:80])
    assert given_up[-1]


def test_candidates_do_not_pile_up():
    """What was seen once is let go of, and listed as a ghost."""
    graph = Graph()
    graph.add_pose([1.0, 0.0, 0.0])
    reflectors = ReflectorGraph(PARAMS.reflector, OnlineSolver(graph))
    interval, sighting = Interval(np.zeros(3)), Sighting()
    interval.first_stamp = interval.last_stamp = SECOND
    sighting.add(np.array([0.5, 0.5]), 1e-4 * np.eye(2))
    interval.sightings[7] = [sighting]
    reflectors.add(0, interval)
    reflectors.drop_candidates(SECOND)
    assert reflectors.arrays()['reflector_key'].tolist() == [7]
    reflectors.drop_candidates(2 * SECOND)
    assert reflectors.arrays()['reflector_key'].tolist() == []
    (ghost,) = reflector_states(reflectors, PARAMS.reflector)
    assert (ghost.state, ghost.key, ghost.sightings) == ('ghost', 7, 1)
    np.testing.assert_allclose(ghost.place, [1.5, 0.5])
    assert reflectors.next_key == 8
