# SPDX-License-Identifier: Apache-2.0
"""Where odom lies, estimated from frames with and without odometry."""

from __future__ import annotations

import numpy as np

from rlml_slam import se2
from rlml_slam.ros.back_end.map_transform import OdomFrame
from rlml_slam.types import Frame, Motion, Observation

HERE, WHEELS = np.array([50.0, 20.0, 1.0]), np.array([3.0, 1.0, 0.2])


def frame(stamp, odom_pose, pose=HERE):
    observation = Observation(stamp, Motion(np.zeros(3), np.eye(3)), odom_pose=odom_pose)
    none = np.zeros(0, dtype=np.int64)
    return Frame(stamp, observation, pose, np.eye(3), pose, np.eye(3), none, none)


def test_frame_without_the_odometry_there_is_leaves_odom_where_it_was():
    odom = OdomFrame()
    odom.follow(frame(1, WHEELS))
    _, T = odom.newest
    np.testing.assert_allclose(se2.between(HERE, se2.compose(T, WHEELS)), 0.0, atol=1e-12)
    odom.follow(frame(2, None, pose=HERE + 1.0))
    assert odom.newest == (2, T)
    odom.restart()
    odom.follow(frame(3, None))
    assert odom.newest is None


def test_without_any_odometry_odom_is_the_local_frame():
    odom = OdomFrame()
    odom.follow(frame(1, None))
    stamp, T = odom.newest
    assert stamp == 1
    np.testing.assert_allclose(T, 0.0, atol=1e-12)
