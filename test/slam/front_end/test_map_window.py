# SPDX-License-Identifier: Apache-2.0
"""Of a large map, only what is in reach is in the state."""

import numpy as np
import pytest
from made_worlds import TinyWorld, drive, errors, observations, within

from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Node, Parameters, Reflector
from rlml_slam.slam.front_end import map_window
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.front_end.joint_state import LANDMARKS, JointState
from rlml_slam.slam.front_end.map_window import MARGIN, MapWindow
from rlml_slam.types import ANONYMOUS, Reflectors

REACH = 8.0
RNG = np.random.default_rng(0)
AISLE = np.stack([np.arange(0.0, 300.0, 2.5), np.tile([-2.0, 2.0], 60)], -1)
AISLE += RNG.uniform(-0.8, 0.8, AISLE.shape)
M = len(AISLE)
MAP = Reflectors(
    np.arange(M), AISLE, np.tile(1e-4 * np.eye(2), (M, 1, 1)), np.full(M, ANONYMOUS),
    np.full(M, 9), np.linspace(0.04, 0.1, M),
)  # fmt: skip


def at(x):
    return JointState(np.array([x, 0.0, 0.0]), 1e-6 * np.eye(3), 0.1)


def test_state_has_what_is_in_reach_as_the_map_has_it():
    state, tracks, window = at(0.0), LandmarkTracks(), MapWindow(MAP, REACH)
    for x in np.arange(0.0, 290.0, 3.0):
        state.x[0] = x
        window.update(state, tracks)
        near = np.flatnonzero(np.abs(AISLE[:, 0] - x) < REACH)
        assert set(near) <= set(tracks.keys.tolist())
        assert len(tracks) < 2 * (REACH + 2 * MARGIN) / 2.5 + 4
        np.testing.assert_array_equal(state.landmarks(), AISLE[tracks.keys])
        np.testing.assert_array_equal(tracks.diameters, MAP.diameters[tracks.keys])
        assert tracks.surveyed.all()
        assert state.num_landmarks == len(tracks)


def test_what_stays_in_reach_keeps_what_is_known_of_it():
    state, tracks, window = at(100.0), LandmarkTracks(), MapWindow(MAP, REACH)
    window.update(state, tracks)
    index = int(np.argmin(np.abs(AISLE[tracks.keys, 0] - 106.0)))
    key = tracks.keys[index]
    state.apply(LANDMARKS + 2 * index + np.arange(2), np.eye(2), 1e-6 * np.eye(2), np.ones(2))
    cov_before = state.landmark_covs()[index].copy()
    state.x[0] = 100.0 + 1.5 * MARGIN
    window.update(state, tracks)
    (now,) = np.flatnonzero(tracks.keys == key)
    np.testing.assert_allclose(state.landmark_covs()[now], cov_before)
    assert cov_before[0, 0] < 1e-5


def test_nothing_changes_while_the_pose_stays_near(monkeypatch):
    state, tracks, window = at(100.0), LandmarkTracks(), MapWindow(MAP, REACH)
    window.update(state, tracks)
    monkeypatch.setattr(map_window.np, 'setdiff1d', None)
    state.x[0] += 0.9 * MARGIN
    window.update(state, tracks)


@pytest.mark.parametrize('reach', [REACH, 1000.0])
def test_drive_through_a_large_map(reach):
    world = TinyWorld(np.zeros((0, 4)), AISLE)
    path = drive((1.0, 0.0, 60.0))
    seen = observations(world, path, scan=False, rng=np.random.default_rng(1))
    close = within(seen, REACH)
    p = Parameters(node=Node(mode='localization'), reflector=Reflector(max_range=reach))
    front_end = FrontEnd(p)
    front_end.use_map(SavedMap(MAP).reflectors)
    poses = np.array([front_end.process(o).T_map_base for o in close])
    distance, turn = errors(poses, path)
    # detections have 2 cm of noise; some five at once, and odometry averages over time
    assert np.sqrt((distance**2).mean()) < 0.015
    assert turn.max() < 0.02
    assert len(front_end.tracks) < M if reach == REACH else len(front_end.tracks) == M
