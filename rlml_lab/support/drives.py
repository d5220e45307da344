# SPDX-License-Identifier: Apache-2.0
"""A simulated drive as a list, so that several systems can be given the same one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rlml_slam import warm_up
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.evaluation.run_record import Truth
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.ros.sensor_input import Out, Target
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.simulation.simulation import GroundTruth, Message, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Frame, Imu, Observation, Odometry, Scan


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
    return [*(feed_one(slam, m) for m in messages), slam.finish()]


def observe(
    messages: Sequence[Message], params: Parameters, simulator: SimulatorParameters
) -> list[Observation]:
    """What a system's sequencer makes of all messages: the same for every system."""
    synchronizer = Synchronizer(params)
    synchronizer.set_sensor_pose(simulator.node.laser_frame, np.array(simulator.node.laser_pose))
    return [o for m in messages for o in feed_one(synchronizer, m)] + synchronizer.flush()


def process(slam: Slam | EkfSlam, observations: Sequence[Observation]) -> list[list[Frame]]:
    """All observations in order; the frames that they gave."""
    warm_up.compile_loaded()
    return [*(slam.process([o]) for o in observations), slam.finish()]


def feed_one(target: Target[Out], message: Message) -> list[Out]:
    """One message to a system or a synchronizer; what became ready by it."""
    if isinstance(message, Odometry):
        return target.add_odometry(message)
    if isinstance(message, Imu):
        return target.add_imu(message)
    if isinstance(message, Scan):
        return target.add_scan(message)
    return [] if isinstance(message, GroundTruth) else target.add_detections(message)
