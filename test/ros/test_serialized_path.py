# SPDX-License-Identifier: Apache-2.0
"""The bytes of a path are those that ROS makes of the same message, pose by pose."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import bag_types, make_bag
from rlml_slam.ros.codecs.serialized_path import serialized_path

PATH = 'nav_msgs/msg/Path'


def message(stamp, frame_id, stamps, poses):
    """The same with an object for each pose."""
    header = encode.header(make_bag, stamp, frame_id)
    each = [
        make_bag(
            'geometry_msgs/msg/PoseStamped',
            header=encode.header(make_bag, int(s), frame_id),
            pose=encode.pose(make_bag, T),
        )
        for s, T in zip(stamps, poses, strict=True)
    ]
    return make_bag(PATH, header=header, poses=each)


@pytest.mark.parametrize('frame_id', ['', 'm', 'map', 'robot1/map', 'Größe', 'of_twelve_ch'])
@pytest.mark.parametrize('n', [0, 1, 2, 7])
def test_bytes_are_those_of_the_message(frame_id, n):
    """Names of every length shift what follows them by other amounts."""
    poses = np.random.default_rng(n).normal(size=(n, 3))
    stamps = 1_700_000_000_123_456_789 + 99_999_999 * np.arange(n)
    for name in (frame_id, frame_id + 'xy', frame_id + 'xyz', frame_id + 'wxyz'):
        expected = message(7_000_000_001, name, stamps, poses)
        data = serialized_path(7_000_000_001, name, stamps, poses)
        assert data == bytes(bag_types().serialize_cdr(expected, PATH))
