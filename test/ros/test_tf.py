# SPDX-License-Identifier: Apache-2.0
"""The places of sensors out of static transforms."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.ros import build, convert
from rlml_slam.ros.convert import Transform
from rlml_slam.ros.messages import make_bag
from rlml_slam.ros.tf import Extrinsics

FLIPPED = np.diag([1.0, -1.0, -1.0])  # half a turn about x


def planar(parent, child, pose):
    message = build.transform(make_bag, 1, (parent, child), np.array(pose))
    return convert.transforms(message)


def test_chain_up_and_down_is_composed():
    tree = Extrinsics()
    tree.add(planar('footprint', 'base_link', [0.1, 0.0, 0.3]))
    tree.add(planar('footprint', 'mast', [0.0, 0.5, -1.0]))
    tree.add(planar('mast', 'laser', [1.0, 2.0, 0.2]))
    want = se2.between([0.1, 0.0, 0.3], se2.compose([0.0, 0.5, -1.0], [1.0, 2.0, 0.2]))
    np.testing.assert_allclose(tree.pose('base_link', 'laser'), want, atol=1e-12)


def test_frame_is_at_itself():
    np.testing.assert_array_equal(Extrinsics().pose('base_link', 'base_link'), np.zeros(3))


def test_unconnected_frames_have_no_pose():
    tree = Extrinsics()
    tree.add(planar('base_link', 'laser', [0, 0, 0]))
    assert tree.pose('base_link', 'camera') is None
    assert tree.up('base_link', 'camera') is None


def test_cycle_does_not_hang():
    tree = Extrinsics()
    tree.add(planar('a', 'b', [1, 0, 0]) + planar('b', 'a', [1, 0, 0]))
    assert tree.pose('base_link', 'a') is None


def test_imu_upside_down_is_turned_and_a_laser_refused():
    tree = Extrinsics()
    tree.add([Transform('base_link', 'imu', FLIPPED, np.zeros(3))])
    np.testing.assert_allclose(tree.up('base_link', 'imu'), [0.0, 0.0, -1.0])
    with pytest.raises(InputError, match='base_link to imu is not planar: it tilts by 180'):
        tree.pose('base_link', 'imu')


def test_later_transform_replaces_the_earlier():
    tree = Extrinsics()
    tree.add(planar('base_link', 'laser', [1, 0, 0]))
    tree.add(planar('base_link', 'laser', [2, 0, 0]))
    assert tree.pose('base_link', 'laser')[0] == 2.0
