# SPDX-License-Identifier: Apache-2.0
"""What is remembered of reflectors that are no longer in the map."""

import numpy as np

from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.removed_landmarks import MOST, RemovedLandmarks


def landmark(key, mapped):
    out = Landmark(key)
    out.index = 0 if mapped else -1
    return out


def test_ghosts_make_room_before_what_was_in_the_map():
    gone = RemovedLandmarks()
    for key in range(3 * MOST):
        gone.add(landmark(key, key % 100 == 7), np.array([float(key), 0.0]))
    keys = gone.keys
    assert len(keys) <= 2 * MOST
    assert keys == sorted(keys)
    assert set(range(7, 3 * MOST, 100)) <= set(keys)
    assert keys[-MOST // 2 :] == list(range(3 * MOST - MOST // 2, 3 * MOST))
    np.testing.assert_array_equal(gone.rows['place'][:, 0], keys)


def test_of_what_was_in_the_map_the_first_make_room():
    gone = RemovedLandmarks()
    for key in range(2 * MOST + 1):
        gone.add(landmark(key, True), np.zeros(2))
    assert gone.keys == list(range(MOST + 1, 2 * MOST + 1))
