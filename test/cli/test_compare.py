# SPDX-License-Identifier: Apache-2.0
"""How far a node in shadow mode and another localization were apart, out of a bag of both."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.cli.main import main
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag

SECOND = 1_000_000_000
APART = np.array([12.0, -3.0, 0.8])  # of the two maps


def drive(t):
    return np.array([0.5 * t, np.sin(0.2 * t), 0.1 * np.sin(0.3 * t)])


@pytest.fixture
def both(tmp_path):
    """AMCL's map to odom at 10 Hz, dated ahead by a second, and our poses 4 cm beside its."""
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(1500):
            stamp, t = 10 * SECOND + k * SECOND // 50, k / 50.0
            tf = [encode.transform(make_bag, stamp, ('odom', 'base_link'), drive(t))]
            if k % 5 == 0:
                ahead = stamp + SECOND
                tf.append(encode.transform(make_bag, ahead, ('map', 'odom'), APART))
            bag.write('/tf', encode.tf_message(make_bag, tf), stamp)
            if k % 5 == 3:
                ours = drive(t) + np.array([0.0, 0.04 * (-1) ** k, 0.0])
                msg = encode.pose_with_covariance(make_bag, stamp, 'map', ours, np.eye(3))
                bag.write('/shadow/pose', msg, stamp)
                msg = encode.pose_with_covariance(
                    make_bag, stamp, 'map', se2.compose(APART, drive(t)), np.eye(3)
                )
                bag.write('/amcl_pose', msg, stamp)
    return str(tmp_path / 'bag')


@pytest.mark.parametrize('other', ['/tf', '/amcl_pose'])
def test_paths_in_two_maps_are_fitted_and_compared(both, capsys, other):
    assert main(['compare', both, '--other', other, '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['ours'] == '/shadow/pose'
    assert figures['rmse_m'] == pytest.approx(0.04, abs=0.002)
    assert figures['matched'] > 230


def test_in_one_map_nothing_is_fitted(both, capsys):
    assert main(['compare', both, '--same-map']) == 0
    said = capsys.readouterr().out
    assert '/shadow/pose against /tf' in said
    assert 'fitted' not in said
    assert float(said.split('median ')[1].split(' ')[0]) > 10.0


def test_a_topic_that_is_not_there_is_named(both, capsys):
    assert main(['compare', both, '--other', '/odom_pose']) == 1
    assert 'no topic /odom_pose; it has /amcl_pose' in capsys.readouterr().err
