# SPDX-License-Identifier: Apache-2.0
"""All kernels ready before the first message, with progress where they have to be compiled."""

from __future__ import annotations

import threading
import time
from typing import Any

from rlml_slam import warm_up
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.types import Health, Level

PERIOD = 2.0  # [s] between two reports


def prepare(node: Any) -> None:
    """Load the kernels of all imported modules; without a library, Numba compiles them."""
    if warm_up.has_library():
        warm_up.compile_loaded()
        return
    modules = warm_up.loaded()
    done = threading.Event()
    at = ['']
    reporter = threading.Thread(target=_report, args=(node, done, at))
    reporter.start()
    try:
        for k, (name, compile_module) in enumerate(modules):
            at[0] = f'{k} of {len(modules)}, {name.removeprefix("rlml_slam.")}'
            compile_module()
    finally:
        done.set()
        reporter.join()


def _report(node: Any, done: threading.Event, at: list[str]) -> None:
    """Log and diagnose what is compiled, until it is done."""
    began = time.monotonic()
    publisher = node.create_publisher(
        rclpy_class('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', 10
    )
    name = node.get_fully_qualified_name().lstrip('/')
    while not done.wait(PERIOD):
        said = f'compiling kernels: {at[0]} ({time.monotonic() - began:.0f} s)'
        node.get_logger().info(f'{said}; `rlml warm-up` does it once for all')
        health = Health(Level.DEGRADED, (said,))
        publisher.publish(encode.diagnostics(make_rclpy, 0, name, health, {}))
    node.destroy_publisher(publisher)
