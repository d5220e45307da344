# SPDX-License-Identifier: Apache-2.0
"""Reflectors that are left out of the state come back as if they had been in it all the time."""

import copy

import numpy as np
import pytest
from made_states import made
from made_worlds import TinyWorld, drive, errors, observations, within

from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.params import Parameters, Reflector
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.front_end.inactive_landmarks import (
    MIN_INACTIVE,
    InactiveLandmarks,
    InactivePart,
)
from rlml_slam.slam.front_end.joint_state import LANDMARKS, JointState
from rlml_slam.slam.front_end.map_window import MARGIN
from rlml_slam.slam.front_end.reflector_update import use_reflectors
from rlml_slam.types import ANONYMOUS, Motion

NOBODY = np.zeros(0, dtype=np.int64)


def live(state, near, rng):
    """What happens to a state: it moves, turns over submaps, sees, learns and forgets."""
    for k in range(6):
        cov = 1e-3 * np.diag(rng.uniform(0.5, 1.0, 3))
        state.predict(Motion(rng.normal(0.0, 0.3, 3), cov, True, np.array([0.0, 0.0, -0.1])), 1e-6)
        index = rng.choice(near, 2, replace=False)
        z = rng.normal(0.0, 2.0, (2, 2))
        noise, zero = np.tile(0.01 * np.eye(2), (2, 1, 1)), np.zeros(2)
        use_reflectors(state.x, state.P, index, z, noise, zero, zero, 1.0)
        if k % 2:
            state.move_anchor(0, 1)
            state.clone_pose(0, rng.normal(), 1e-4 * np.eye(3))
        state.add_landmark(rng.normal(0.0, 3.0, 2), 0.01 * np.eye(2))


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('same', [False, True], ids=['regular', 'singular'])
def test_state_is_what_it_would_be_with_all_of_them_in_it(seed, same):
    whole = made(seed, landmarks=9)
    if same:  # an anchor just begun is the pose, another never was
        whole.move_anchor(0, 1)
        whole.clone_pose(0, 0.1, np.zeros((3, 3)))
    away = np.zeros(9, dtype=np.bool_)
    away[[1, 4, 5, 8]] = True
    part = copy.deepcopy(whole)
    out = InactivePart(part, away)
    assert part.num_landmarks == 5
    near = np.flatnonzero(~away)
    live(whole, near, np.random.default_rng(seed))
    live(part, np.arange(5), np.random.default_rng(seed))
    # two of the near ones leave: the first of the state, and one that was found later
    first, later = np.ones(whole.num_landmarks, dtype=np.bool_), np.ones(11, dtype=np.bool_)
    first[[0, 10]] = later[[0, 6]] = False
    whole.remove_landmarks(first)
    part.remove_landmarks(later)
    points, covs = out.positions(part)
    out.put_back(part)
    # in the whole state, those away stand between: after the first one, at 0, 3, 4 and 7
    order = np.r_[1, 2, 5, 6, np.arange(8, whole.num_landmarks), 0, 3, 4, 7]
    rows = np.r_[0:LANDMARKS, (LANDMARKS + 2 * order[:, None] + np.arange(2)).ravel()]
    np.testing.assert_allclose(part.x, whole.x[rows], atol=1e-9)
    np.testing.assert_allclose(part.P, whole.P[np.ix_(rows, rows)], atol=1e-9)
    np.testing.assert_allclose(points, part.landmarks()[-4:], atol=1e-12)
    np.testing.assert_allclose(covs, part.landmark_covs()[-4:], atol=1e-12)
    assert part.extra == 0


def test_state_that_leaves_them_out_does_not_grow_by_those_that_come_and_go():
    state = made(0, landmarks=9)
    InactivePart(state, np.arange(9) > 4)
    size = len(state.x)
    for _ in range(50):
        state.add_landmark(np.ones(2), np.eye(2))
        state.remove_landmarks(np.arange(state.num_landmarks) < 5)
    assert len(state.x) == size


def aisle(length):
    """A state and tracks with a reflector every 2 m along x, all seen often."""
    state, tracks = JointState(np.zeros(3), 1e-4 * np.eye(3), 0.01), LandmarkTracks()
    points = np.stack([np.arange(0.0, length, 2.0), np.ones(int(length / 2))], -1)
    state.fix_landmarks(points, np.tile(1e-4 * np.eye(2), (len(points), 1, 1)))
    for k in range(len(points)):
        tracks.append(0, 100 + k if k == 90 else ANONYMOUS, 0.05)
        tracks.sightings[k] = 10
    return state, tracks, points


def test_only_what_is_in_reach_is_in_the_state():
    state, tracks, points = aisle(400.0)
    distant = InactiveLandmarks(20.0, 3)
    for x in np.arange(0.0, 400.0, 4.0):
        state.x[0] = x
        distant.update(state, tracks, NOBODY)
        assert state.num_landmarks == len(tracks) < 2 * (20.0 + 2.0 * MARGIN) / 2.0 + 2
        assert set(np.flatnonzero(np.abs(points[:, 0] - x) < 19.0)) <= set(tracks.keys.tolist())
        np.testing.assert_allclose(state.landmarks(), points[tracks.keys], atol=1e-9)
        keys, places, covs = distant.all_landmarks(state, tracks)
        assert sorted(keys.tolist()) == list(range(200))
        np.testing.assert_allclose(places, points[keys], atol=1e-9)
        np.testing.assert_allclose(covs, np.tile(1e-4 * np.eye(2), (200, 1, 1)), atol=1e-9)
    distant.restore(state, tracks)
    assert len(tracks) == state.num_landmarks == 200


def test_candidates_and_few_reflectors_stay():
    state, tracks, _ = aisle(400.0)
    tracks.sightings[150:] = 1
    InactiveLandmarks(20.0, 3).update(state, tracks, NOBODY)
    assert set(range(150, 200)) <= set(tracks.keys.tolist())
    near = int((20.0 + MARGIN) / 2.0)
    state, tracks, _ = aisle(2.0 * (near + MIN_INACTIVE))
    InactiveLandmarks(20.0, 3).update(state, tracks, NOBODY)
    assert len(tracks) == near + MIN_INACTIVE


def test_reflector_that_tells_its_id_is_in_reach_wherever_it_was_believed():
    state, tracks, _ = aisle(400.0)
    distant = InactiveLandmarks(20.0, 3)
    distant.update(state, tracks, np.array([ANONYMOUS]))
    assert 190 not in tracks.ids
    distant.update(state, tracks, np.array([ANONYMOUS, 190]))
    assert 190 in tracks.ids
    assert len(tracks) < 30


RNG = np.random.default_rng(0)
HALL = np.stack([np.arange(0.0, 160.0, 2.0), np.tile([-2.0, 2.0], 40)], -1)
HALL += RNG.uniform(-0.8, 0.8, HALL.shape)


def mapped(reach, path):
    """A front end that drives along an aisle and sees no farther than 8 m."""
    seen = observations(
        TinyWorld(np.zeros((0, 4)), HALL), path, scan=False, rng=np.random.default_rng(1)
    )
    front_end = FrontEnd(Parameters(reflector=Reflector(max_range=reach)))
    return front_end, np.array([front_end.process(o).T_map_base for o in within(seen, 8.0)])


def test_drive_is_the_same_with_and_without_those_out_of_reach():
    out = drive((1.0, 0.0, 100.0))
    path = np.concatenate([out, out[::-1]])
    far, whole = mapped(8.0, path), mapped(1000.0, path)
    np.testing.assert_allclose(far[1], whole[1], atol=1e-7)
    assert errors(far[1], path)[0][-100:].max() < 0.1  # back where it began
    assert len(far[0].tracks) < 30 < len(whole[0].tracks)
    mine, all_ = far[0].reflectors(), whole[0].reflectors()
    a, b = np.argsort(mine.keys), np.argsort(all_.keys)
    np.testing.assert_array_equal(mine.keys[a], all_.keys[b])
    np.testing.assert_allclose(mine.points[a], all_.points[b], atol=1e-7)
    np.testing.assert_allclose(mine.cov[a], all_.cov[b], atol=1e-9)
    np.testing.assert_array_equal(mine.sightings[a], all_.sightings[b])


def test_reflector_that_may_be_in_reach_stays():
    state, tracks, points = aisle(400.0)
    state.P[LANDMARKS + 2 * 60, LANDMARKS + 2 * 60] = 40.0**2
    InactiveLandmarks(20.0, 3).update(state, tracks, NOBODY)
    assert points[60, 0] > 2.0 * (20.0 + MARGIN)
    assert 60 in tracks.keys
    assert 61 not in tracks.keys
