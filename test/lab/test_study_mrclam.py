# SPDX-License-Identifier: Apache-2.0
"""The study of MR.CLAM: landmarks are compared with the true ones in the frame of the truth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rlml_lab.datasets.mrclam import MrclamRobot
from rlml_lab.main import main
from rlml_lab.studies.study_mrclam import begun_at, evaluate, frame_of_truth, nearest
from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.types import ANONYMOUS, Detections, Odometry, Reflectors

SECOND = 10**9
T_TRUTH_MAP = np.array([1.0, -2.0, 0.7])
TRUE = np.array([[0.0, 3.0], [4.0, 1.0], [2.0, -2.0]])
PATH = Trajectory(
    SECOND * np.arange(4), np.array([[0.0, 0, 0], [1, 0, 0.5], [2, 1, 1], [2, 2, 2]])
)


def found(points, ids):
    m = len(points)
    eye = np.tile(np.eye(2), (m, 1, 1))
    return Reflectors(np.arange(m), points, eye, np.array(ids), np.full(m, 9), np.full(m, np.nan))


@pytest.fixture
def data():
    points_map = se2.transform(se2.inverse(T_TRUTH_MAP), TRUE)
    detections = [
        Detections(
            int(t), 'base_link', se2.transform(se2.inverse(X), points_map),
            np.tile(0.01 * np.eye(2), (3, 1, 1)), np.array([6, 7, 8]), np.full(3, np.nan),
        )
        for t, X in zip(PATH.stamps, PATH.poses, strict=True)
    ]  # fmt: skip
    odometry = [Odometry(int(t), X) for t, X in zip(PATH.stamps, PATH.poses, strict=True)]
    return MrclamRobot(odometry, detections, None, np.array([6, 7, 8]), TRUE)


def test_detections_by_id_give_the_frame_of_the_truth(data):
    assert_allclose(frame_of_truth(data, PATH), T_TRUTH_MAP, atol=1e-12)


def test_doubles_and_false_landmarks_are_counted(data):
    own = se2.transform(se2.inverse(T_TRUTH_MAP), np.vstack([TRUE, TRUE[0] + 0.3, TRUE[1] + 2.0]))
    error, rmse, mapped, hits, twice, false = evaluate(
        data, PATH, found(own, [ANONYMOUS] * 5), PATH
    )
    assert (mapped, hits, twice, false) == (5, 3, 1, 1)
    assert_allclose([error, rmse], 0.0, atol=1e-9)


def test_an_id_says_which_landmark_it_is_at_any_distance(data):
    far = TRUE + 5.0
    assert_array_equal(nearest(far, found(far, [8, 6, ANONYMOUS]), data), [2, 0, -1])


def test_a_run_begins_later(data):
    later = begun_at(data, 1.5)
    assert [o.stamp for o in later.odometry] == [2 * SECOND, 3 * SECOND]
    assert [d.stamp for d in later.detections] == [2 * SECOND, 3 * SECOND]


def test_table_has_a_row_for_each_system_stage_and_choice_of_ids(monkeypatch, data, capsys):
    """Both systems, live and in replay, with known ids and without."""
    monkeypatch.setattr('rlml_lab.studies.study_mrclam.read_mrclam', lambda folder, robot: data)
    assert main(['study', 'mrclam', 'folder', '--robot', '3']) == 0
    title, *rows = (SimpleNamespace(words=r.split()) for r in capsys.readouterr().out.splitlines())
    assert title.words[:4] == ['robot', 'system', 'stage', 'ids']
    assert [r.words[1:4] for r in rows] == [
        [s, t, i] for s in ('rlml', 'ekf') for t in ('replay', 'live') for i in ('known', 'none')
    ]
