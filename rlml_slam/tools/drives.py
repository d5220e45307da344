# SPDX-License-Identifier: Apache-2.0
"""A simulated drive as a list, so that several systems can be given the same one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rlml_slam import warm_up
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.params import SimulatorParameters
from rlml_slam.rlml.slam import Slam
from rlml_slam.simulation.simulation import GroundTruth, Message, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.tools.record import Truth
from rlml_slam.tools.tum import Trajectory
from rlml_slam.types import Frame, Imu, Odometry, Scan


def simulate(parameters: SimulatorParameters, seed: int) -> tuple[list[Message], Truth]:
    """All messages of one drive in order of arrival, and its truth."""
    simulation = Simulation(load_world(parameters.node.world), parameters, seed)
    messages = [event.message for event in simulation]
    points, ids = simulation.true_reflectors()
    true = [(m.stamp, m.T_map_base) for m in messages if isinstance(m, GroundTruth)]
    path = Trajectory(
        np.array([t for t, _ in true], dtype=np.int64), np.array([x for _, x in true])
    )
    return messages, Truth(path, True, ids, points)


def feed(slam: Slam | EkfSlam, messages: Sequence[Message]) -> list[list[Frame]]:
    """All messages in order of arrival; the frames that they gave."""
    warm_up.compile_loaded()
    out = []
    for message in messages:
        if isinstance(message, Odometry):
            out.append(slam.add_odometry(message))
        elif isinstance(message, Imu):
            out.append(slam.add_imu(message))
        elif isinstance(message, Scan):
            out.append(slam.add_scan(message))
        elif not isinstance(message, GroundTruth):
            out.append(slam.add_detections(message))
    out.append(slam.finish())
    return out
