# SPDX-License-Identifier: Apache-2.0
"""The class of the messages on /tf, which the wheels of ROS 2 lack."""

from __future__ import annotations

from typing import Any

from rlml_slam.errors import RlmlError
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.tf import TF_MESSAGE


def tf_message() -> Any:
    """tf2_msgs.msg.TFMessage; RlmlError that says how to get it where it is missing."""
    kind = rclpy_class(TF_MESSAGE)
    if kind is None:
        raise RlmlError('tf2_msgs is not installed, this study needs it: make tf')
    return kind
