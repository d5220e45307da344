# SPDX-License-Identifier: Apache-2.0
"""Packed submaps are the submaps that they were made of, and few of them are unpacked."""

from __future__ import annotations

import numpy as np
import pytest
from made_rooms import ROOM, scan

from rlml_slam import params
from rlml_slam.matching.scans import packed_submap
from rlml_slam.matching.scans.packed_submap import PackedSubmap, Unpacked
from rlml_slam.matching.scans.scan_match import match
from rlml_slam.matching.scans.submap import Submap


@pytest.fixture
def whole():
    submap = Submap(params.Submap())
    submap.insert(scan(ROOM, np.zeros(3)), np.zeros(2))
    submap.complete()
    return submap


def test_packed_submap_answers_as_the_whole_one(whole):
    packed = PackedSubmap(whole, Unpacked())
    np.testing.assert_array_equal(packed.values, whole.values)
    np.testing.assert_array_equal(packed.bounds, whole.bounds)
    np.testing.assert_array_equal(packed.walls(), whole.walls())
    points = scan(ROOM, np.array([0.05, -0.03, 0.01]))
    found = [
        match(s, points, np.zeros(3), np.eye(3), params.ScanMatch(), searched=False)
        for s in (packed, whole)
    ]
    np.testing.assert_array_equal(found[0].pose, found[1].pose)
    assert (packed.version, packed.resolution) == (whole.version, whole.resolution)
    assert not hasattr(packed, 'cells')


def test_few_are_unpacked_at_a_time(whole, monkeypatch):
    monkeypatch.setattr(packed_submap, 'KEPT', 3)
    unpacked = Unpacked()
    packed = [PackedSubmap(whole, unpacked) for _ in range(5)]
    assert not any('values' in vars(p) for p in packed)
    for p in packed:
        np.testing.assert_array_equal(p.values, whole.values)
    assert ['values' in vars(p) for p in packed] == [False, False, True, True, True]
    np.testing.assert_array_equal(packed[0].values, whole.values)
