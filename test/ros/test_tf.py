# SPDX-License-Identifier: Apache-2.0
"""The places of sensors out of static transforms."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.ros import tf
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.decode import Transform
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.tf import Extrinsics

FLIPPED = np.diag([1.0, -1.0, -1.0])  # half a turn about x


def planar(parent, child, pose):
    message = encode.transform(make_bag, 1, (parent, child), np.array(pose))
    return decode.transforms(message)


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


def test_sensor_that_hangs_upside_down_is_told_from_one_that_is_tilted():
    tree = Extrinsics()
    tree.add(planar('base_link', 'mast', [1.0, 2.0, 0.7]))
    tree.add([Transform('mast', 'laser', FLIPPED, np.array([0.0, 0.0, 1.5]))])
    np.testing.assert_allclose(tree.up('base_link', 'laser'), [0.0, 0.0, -1.0])
    np.testing.assert_allclose(tree.pose('base_link', 'laser'), [1.0, 2.0, 0.7], atol=1e-12)
    assert tree.hangs('base_link', 'laser')
    assert not tree.hangs('base_link', 'mast')
    assert not tree.hangs('base_link', 'nowhere')
    on_its_side = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    tree.add([Transform('base_link', 'camera', on_its_side, np.zeros(3))])
    with pytest.raises(InputError, match='base_link to camera is not planar: it tilts by 90'):
        tree.pose('base_link', 'camera')


def test_later_transform_replaces_the_earlier():
    tree = Extrinsics()
    assert tree.pose('base_link', 'laser') is None
    tree.add(planar('base_link', 'laser', [1, 0, 0]))
    assert tree.pose('base_link', 'laser')[0] == 1.0
    tree.add(planar('base_link', 'laser', [2, 0, 0]))
    assert tree.pose('base_link', 'laser')[0] == 2.0


def test_bad_static_transform_costs_only_itself(monkeypatch):
    pytest.importorskip('rclpy')
    hear, said = {}, []
    monkeypatch.setattr(tf, 'rclpy_class', lambda name: object)
    monkeypatch.setattr(
        tf, 'Listener', lambda node, kind, topic, use, *_: hear.update({topic: use})
    )
    node = SimpleNamespace(
        get_logger=lambda: SimpleNamespace(warning=said.append),
    )
    tree = Extrinsics()
    assert tf.subscribe_static(node, tree)
    bad = encode.transform(make_bag, 1, ('base_link', 'camera'), np.zeros(3))
    bad.transform.rotation.w = 0.0
    good = [
        encode.transform(make_bag, 1, ('base_link', child), np.array([0.3, 0.1, 0.0]))
        for child in ('laser', 'imu')
    ]
    hear['/tf_static'](SimpleNamespace(transforms=[good[0], bad, good[1]]))
    assert tree.pose('base_link', 'camera') is None
    for child in ('laser', 'imu'):
        np.testing.assert_allclose(tree.pose('base_link', child), [0.3, 0.1, 0.0])
    assert len(said) == 1
    assert 'base_link to camera: quaternion has the length 0' in said[0]
