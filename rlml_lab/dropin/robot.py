# SPDX-License-Identifier: Apache-2.0
"""A robot on the system's time: scans, and its odometry on /tf alone.

``python -m rlml_lab.dropin.robot`` drives the route of a world without end.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from rlml_lab.dropin.tf_messages import tf_message
from rlml_slam.params import Simulator, SimulatorParameters
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.run import run
from rlml_slam.ros.systems.simulator_messages import SimulatedMessages
from rlml_slam.simulation.simulation import START, GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Odometry as Wheels
from rlml_slam.types import Scan

WORLD = 'hall'
TRUTH = 'ground_truth'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Robot(Node):
    """Steps the simulation along the system's clock."""

    def __init__(self) -> None:
        super().__init__('robot')
        values = SimulatorParameters(node=Simulator(world=WORLD, repeat=True))
        self._simulation = Simulation(load_world(WORLD), values)
        self._convert = SimulatedMessages(make, values)
        kind = tf_message()
        self._tf = self.create_publisher(kind, '/tf', 100)
        self._scan = self.create_publisher(LaserScan, 'scan', qos_profile_sensor_data)
        self._truth = self.create_publisher(Odometry, TRUTH, 100)
        static = self._convert.laser_transform()
        self._static = self.create_publisher(kind, '/tf_static', LATCHED)
        self._static.publish(static)
        self._later = time.time_ns() - START  # system's time less the simulation's
        self.create_timer(0.002, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _tick(self) -> None:
        while self._simulation.time + self._later <= time.time_ns():
            for event in self._simulation.step():
                m = event.message
                self._publish(replace(m, stamp=m.stamp + self._later))

    def _publish(self, m: Any) -> None:
        if isinstance(m, Wheels):
            self._tf.publish(self._convert.odom_transform(m))
        elif isinstance(m, Scan):
            self._scan.publish(self._convert(m)[1])
        elif isinstance(m, GroundTruth):
            self._truth.publish(self._convert(m)[1])


if __name__ == '__main__':
    sys.exit(run(Robot))
