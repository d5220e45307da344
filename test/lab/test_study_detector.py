# SPDX-License-Identifier: Apache-2.0
"""rlml-lab study detector: its table, its figures, and how detections are matched."""

from __future__ import annotations

import json

import numpy as np

from rlml_lab.main import main
from rlml_lab.studies.study_detector import DIAMETERS, DISTANCES, matched


def test_the_study_prints_every_figure(capsys):
    args = ['study', 'detector', '--scans', '2', '--rooms', '5', '--drive', '3']
    assert main([*args, '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert len(figures['cylinders']) == len(DIAMETERS) * len(DISTANCES)
    assert figures['rooms']['scans'] == figures['vests']['scans'] == 5
    assert figures['hall']['visible'] > 0
    assert figures['ms_per_1440_beams'] > 0.0


def test_a_wrong_number_is_one_line(capsys):
    assert main(['study', 'detector', '--scans', '0']) == 1
    assert '--scans' in capsys.readouterr().err


def test_pairs_are_one_to_one_and_nearest_first():
    truth = np.array([[0.0, 0.0], [1.0, 0.0]])
    points = np.array([[0.2, 0.0], [0.05, 0.0], [9.0, 9.0]])
    assert matched(points, truth).tolist() == [[1, 0]]
    assert matched(points[:0], truth).shape == (0, 2)
