# SPDX-License-Identifier: Apache-2.0
"""Repeatability of landmarks: how often places are seen again."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from rlml_lab.main import main
from rlml_lab.studies.study_repeatability import count_sightings, repeatability

A, B = np.array([1.0, 2.0]), np.array([4.0, -1.0])


def test_places_within_the_radius_are_one_landmark():
    scans = [np.array([A, B]), np.array([A + 0.1]), np.zeros((0, 2)), np.array([A - 0.1, B + 1.0])]
    assert_array_equal(count_sightings(scans, 0.3), [3, 1, 1])


def test_one_scan_sees_a_landmark_once():
    scans = [np.array([A]), np.array([A + 0.1, A - 0.1])]
    assert_array_equal(count_sightings(scans, 0.3), [2])


def test_shares_are_of_landmarks_and_of_detections():
    figures = repeatability([np.array([A, B]), np.array([A]), np.array([A])], 0.3)
    assert figures['landmarks'] == 2
    assert figures['share_of_landmarks'][2] == figures['share_of_landmarks'][3] == 0.5
    assert figures['share_of_detections'][3] == 0.75
    assert figures['share_of_detections'][5] == 0.0
    assert repeatability([], 0.3)['landmarks'] == 0


def flaser(k):
    """A robot at (0.1 k, 0) between walls at y = 2 and y = -2, a post at (3, 0.5) before them."""
    x = 0.1 * k
    angles = np.radians(np.arange(180) - 89.5)
    r = 2.0 / np.maximum(np.abs(np.sin(angles)), 0.05)
    at = math.atan2(0.5, 3.0 - x)
    near = np.abs(angles - at) < math.radians(1.0)
    r[near] = math.hypot(0.5, 3.0 - x)
    ranges = ' '.join(f'{v:.3f}' for v in np.minimum(r, 30.0))
    return f'FLASER 180 {ranges} {x} 0 0 {x} 0 0 {k}.0 host {k}.0\n'


def test_post_and_walls_are_seen_from_every_pose(tmp_path, capsys):
    path = tmp_path / 'corrected.log'
    path.write_text(''.join(flaser(k) for k in range(10)))
    assert main(['study', 'repeatability', str(path), '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['spikes']['landmarks'] == 1
    assert figures['spikes']['share_of_landmarks']['5'] == 1.0
    assert figures['lines']['landmarks'] == 2
    assert figures['lines']['per_scan'] == pytest.approx(2.0)
