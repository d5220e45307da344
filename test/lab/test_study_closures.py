# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study closures``: the reference holds the relations, odometry is spoilt as asked."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from rlml_lab.studies.study_closures import MisledSlam, reference
from rlml_slam import se2
from rlml_slam.evaluation.relations import Relations
from rlml_slam.params import Parameters
from rlml_slam.types import Odometry


def test_reference_agrees_with_all_relations_of_a_part():
    rng = np.random.default_rng(0)
    true = rng.uniform(-3.0, 3.0, (6, 3))
    pairs = np.array([[0, 1], [2, 1], [0, 2], [3, 4], [4, 5], [3, 5]])
    deltas = se2.between(true[pairs[:, 0]], true[pairs[:, 1]])
    stamps, poses, part = reference(Relations(10 * pairs + 7, deltas))
    assert_array_equal(stamps, 10 * np.arange(6) + 7)
    assert part[0] == part[1] == part[2] != part[3] == part[4] == part[5]
    found = se2.between(poses[pairs[:, 0]], poses[pairs[:, 1]])
    assert_allclose(found[:, :2], deltas[:, :2], atol=1e-6)
    assert_allclose(se2.wrap(found[:, 2] - deltas[:, 2]), 0.0, atol=1e-6)


def test_odometry_is_spoilt_step_by_step(monkeypatch):
    sent = []
    slam = MisledSlam(Parameters())
    monkeypatch.setattr(
        slam.synchronizer, 'add_odometry', lambda sample: sent.append(sample) or []
    )
    slam.scale, slam.turn = 1.1, 1.05
    pose = np.array([1.0, 2.0, 0.5])
    for k in range(3):
        slam.add_odometry(Odometry(k, pose))
        pose = se2.compose(pose, se2.exp([0.2, 0.0, 0.1]))
    assert_allclose(sent[0].pose, [1.0, 2.0, 0.5])
    for a, b in itertools.pairwise(sent):
        assert_allclose(se2.log(se2.between(a.pose, b.pose)), [0.22, 0.0, 0.105], atol=1e-12)
