# SPDX-License-Identifier: Apache-2.0
"""What is remembered of reflectors that are no longer in the map."""

import numpy as np

from rlml_slam.slam.landmarks.landmark import Landmark
from rlml_slam.slam.landmarks.removed_landmarks import MAX_RECORDS, RemovedLandmarks


def landmark(key, mapped):
    out = Landmark(key)
    out.index = 0 if mapped else -1
    return out


def test_ghosts_make_room_before_what_was_in_the_map():
    removed = RemovedLandmarks()
    for key in range(3 * MAX_RECORDS):
        removed.add(landmark(key, key % 100 == 7), np.array([float(key), 0.0]))
    keys = removed.keys
    assert len(keys) <= 2 * MAX_RECORDS
    assert keys == sorted(keys)
    assert set(range(7, 3 * MAX_RECORDS, 100)) <= set(keys)
    assert keys[-MAX_RECORDS // 2 :] == list(
        range(3 * MAX_RECORDS - MAX_RECORDS // 2, 3 * MAX_RECORDS)
    )
    np.testing.assert_array_equal(removed.rows['place'][:, 0], keys)


def test_of_what_was_in_the_map_the_first_make_room():
    removed = RemovedLandmarks()
    for key in range(2 * MAX_RECORDS + 1):
        removed.add(landmark(key, True), np.zeros(2))
    assert removed.keys == list(range(MAX_RECORDS + 1, 2 * MAX_RECORDS + 1))
