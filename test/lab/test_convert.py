# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab convert``: public data sets become bags."""

from __future__ import annotations

import json

from rlml_lab.main import main
from rlml_slam.ros.bags.bag import BagReader


def test_mrclam_folder_becomes_a_bag(tmp_path, capsys):
    (tmp_path / 'Barcodes.dat').write_text('1 5\n6 63\n')
    (tmp_path / 'Landmark_Groundtruth.dat').write_text('6 1.0 2.0 0.001 0.001\n')
    (tmp_path / 'Robot1_Odometry.dat').write_text('1.0 1 0\n2.0 1 0\n')
    (tmp_path / 'Robot1_Measurement.dat').write_text('1.5 63 2.0 0.5\n1.6 5 1.0 0\n')
    (tmp_path / 'Robot1_Groundtruth.dat').write_text('1.0 0 0 0\n')
    arguments = ['convert', 'mrclam', str(tmp_path), '--robot', '1', str(tmp_path / 'bag')]
    assert main([*arguments, '--json']) == 0
    assert json.loads(capsys.readouterr().out)['source'] == {'used': 1, 'of_robots': 1}
    with BagReader(tmp_path / 'bag') as bag:
        by_topic = {topic: m for _, topic, m in bag.messages()}
    truth = by_topic['/ground_truth_reflectors']
    assert truth.header.frame_id == 'world'
    assert by_topic['/reflectors'].width == 1
    assert main(['convert', 'mrclam', str(tmp_path), '--robot', '2', str(tmp_path / 'b')]) == 1
