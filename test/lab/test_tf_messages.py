# SPDX-License-Identifier: Apache-2.0
import argparse

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

from rlml_lab.dropin import study_shadow, study_tf_now, tf_messages
from rlml_slam.errors import RlmlError


@pytest.mark.parametrize('study', [study_shadow, study_tf_now])
def test_study_says_what_it_needs_before_it_begins(study, monkeypatch):
    monkeypatch.setattr(tf_messages, 'rclpy_class', lambda kind: None)
    with pytest.raises(RlmlError, match='make tf'):
        study.run(argparse.Namespace(minutes=1.0, tolerance=None))
