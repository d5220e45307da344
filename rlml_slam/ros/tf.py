# SPDX-License-Identifier: Apache-2.0
"""Transforms: map to odom is published, the sensors' places are read.

The one place that knows of tf2_msgs, which every installed ROS 2 has and the wheels lack.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.decode import Transform
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.message_guard import Listener, guard_of
from rlml_slam.se2 import Array

TF_MESSAGE = 'tf2_msgs/msg/TFMessage'
MAX_FRAMES = 10_000  # on /tf_static; robots have some hundred
MAX_BYTES = 1 << 18  # of a message: some 2000 transforms
HALF_TURN = np.diag([1.0, -1.0, -1.0])  # about the x axis


class Extrinsics:
    """The tree of static transforms, from /tf_static of a robot or of a bag."""

    def __init__(self) -> None:
        self._parent: dict[str, Transform] = {}
        self._found: dict[tuple[str, str], tuple[Array, Array] | None] = {}  # until it changes
        self.version = 0  # of which frames sit in which

    def add(self, transforms: Iterable[Transform]) -> None:
        """Take over transforms; a later one of the same child replaces the earlier."""
        for t in transforms:
            self.move(t)
        self._found = {}

    def move(self, t: Transform) -> None:
        """Take over a transform that may change all the time.

        What was found of a frame stays as it was, unless the frame is a new one.
        """
        before = self._parent.get(t.child)
        if before is None and len(self._parent) >= MAX_FRAMES:
            raise InputError(f'/tf_static: more than {MAX_FRAMES} frames')
        self._parent[t.child] = t
        if before is None or before.parent != t.parent:
            self._found = {}
            self.version += 1

    def step(self, frame: str) -> Transform | None:
        """The transform by which a frame sits in its parent, None if it is not known."""
        return self._parent.get(frame)

    def parent(self, frame: str) -> str | None:
        """The frame that a frame sits in, None if it is not known."""
        t = self._parent.get(frame)
        return None if t is None else t.parent

    def frames(self) -> tuple[str, ...]:
        """All frames that sit in another one."""
        return tuple(self._parent)

    def path(self, a: str, b: str) -> tuple[str, ...] | None:
        """The children of the transforms that connect two frames, from ``a`` on; None if none."""
        up_a, up_b = list(self._ancestors(a)), list(self._ancestors(b))
        shared = next((f for f in up_b if f in up_a), None)
        if shared is None:
            return None
        return (*up_a[: up_a.index(shared)], *reversed(up_b[: up_b.index(shared)]))

    def between(self, a: str, b: str) -> tuple[Array, Array] | None:
        """R (3, 3) and t (3,) of T_a_b as the transforms are now, None if nothing connects."""
        up_a, up_b = self._ancestors(a), self._ancestors(b)
        shared = next((f for f in up_b if f in up_a), None)
        if shared is None:
            return None
        (R_a, t_a), (R_b, t_b) = up_a[shared], up_b[shared]
        return R_a.T @ R_b, R_a.T @ (t_b - t_a)

    def pose(self, base: str, frame: str) -> Array | None:
        """Planar T_base_frame (3,), None if the tree does not connect the two.

        Of a sensor that hangs upside down, it is that of one which stands there upright, with its
        x axis in the same direction. Raises InputError if the sensor is tilted against the base.
        """
        found = self._known(base, frame)
        if found is None:
            return None
        R, t = found
        if R[2, 2] < 0.0:
            R = R @ HALF_TURN
        return np.array([t[0], t[1], decode.yaw(R, f'{base} to {frame}')])

    def planar_poses(self, base: str) -> dict[str, Array]:
        """T_base_frame (3,) of every untilted frame that the tree connects to ``base``."""
        out: dict[str, Array] = {}
        for frame in self._parent:
            with contextlib.suppress(InputError):
                pose = self.pose(base, frame)
                if pose is not None:
                    out[frame] = pose
        return out

    def hangs(self, base: str, frame: str) -> bool:
        """Whether a sensor is known to hang upside down."""
        up = self.up(base, frame)
        return up is not None and float(up[2]) < 0.0

    def up(self, base: str, frame: str) -> Array | None:
        """The base z axis (3,) in the sensor's frame, None if the tree does not connect them."""
        found = self._known(base, frame)
        return None if found is None else found[0][2]

    def _known(self, base: str, frame: str) -> tuple[Array, Array] | None:
        """R (3, 3) and t (3,) of T_base_frame, kept until the tree changes."""
        if (base, frame) not in self._found:
            if len(self._found) >= MAX_FRAMES:  # names in messages may be anything
                self._found = {}
            self._found[base, frame] = self.between(base, frame)
        return self._found[base, frame]

    def _ancestors(self, frame: str) -> dict[str, tuple[Array, Array]]:
        """T_ancestor_frame as (R, t) by ancestor, nearest first, the frame itself included."""
        R, t = np.eye(3), np.zeros(3)
        out = {frame: (R, t)}
        while frame in self._parent:
            step = self._parent[frame]
            frame = step.parent
            if frame in out:
                break  # a cycle: the tree is broken, what was found so far holds
            R, t = step.R @ R, step.R @ t + step.t
            out[frame] = (R, t)
        return out


class TransformPublisher:
    """Publishes one transform on /tf, or on a topic of its own where there is no tf2_msgs."""

    def __init__(self, node: Any, otherwise: str = '~/map_to_odom') -> None:
        self._has_tf = rclpy_class(TF_MESSAGE) is not None
        if self._has_tf:
            self._publisher = node.create_publisher(rclpy_class(TF_MESSAGE), '/tf', 100)
        else:
            kind = rclpy_class('geometry_msgs/msg/TransformStamped')
            self._publisher = node.create_publisher(kind, otherwise, 100)
            node.get_logger().warning(
                f'tf2_msgs is not installed: a transform is on {self._publisher.topic_name} '
                'instead of /tf'
            )

    def publish(self, stamp: int, frames: tuple[str, str], T: Array) -> None:
        """Send T (3,) of frames (parent, child) at a stamp [ns]."""
        message = encode.transform(make_rclpy, stamp, frames, T)
        if self._has_tf:
            message = encode.tf_message(make_rclpy, [message])
        self._publisher.publish(message)


def subscribe_static(node: Any, extrinsics: Extrinsics) -> bool:
    """Keep ``extrinsics`` up to date from /tf_static; False where there is no tf2_msgs."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    kind = rclpy_class(TF_MESSAGE)
    if kind is None:
        node.get_logger().warning(
            'tf2_msgs is not installed: /tf_static is not read, and every sensor is taken to sit '
            'where the parameter laser_pose says'
        )
        return False
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    guard = guard_of(node)

    def take_one(transform: Any) -> None:
        extrinsics.add(decode.transforms(transform))

    def take(msg: Any) -> None:
        for transform in msg.transforms:  # each by itself: a bad one costs none of the others
            guard.pass_on('/tf_static', partial(take_one, transform))

    Listener(node, kind, '/tf_static', take, latched, MAX_BYTES)
    return True
