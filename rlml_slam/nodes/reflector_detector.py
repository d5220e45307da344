# SPDX-License-Identifier: Apache-2.0
"""Executable ``reflector_detector``: reflectors from the intensities of laser scans."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from rlml_slam.params import DetectorParameters, Parameters
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.managed_node import ManagedNode
from rlml_slam.ros.run import run
from rlml_slam.ros.sensors import SENSOR, Sensors
from rlml_slam.ros.systems.detector_diagnostics import DetectorHealth
from rlml_slam.sensing.mirror import mirrored_detections
from rlml_slam.sensing.reflectors.reflector_detector import IntensityCheck, detect
from rlml_slam.types import Observation


class ReflectorDetectorNode(ManagedNode):
    """Answers every scan with its reflectors, in the scan's frame and at its stamp.

    Odometry and IMU, where there are, take out the robot's motion during the sweep.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('reflector_detector', DetectorParameters, **options)

    def build(self) -> None:
        """The topics."""
        n = replace(self.params.node, use_scan=True, detect_reflectors='off')
        self._publisher = self.create_publisher(
            rclpy_class('sensor_msgs/msg/PointCloud2'), n.reflectors_topic, SENSOR
        )
        shared = Parameters(node=n, motion=self.params.motion)
        streams = ('scan', 'odom', 'imu')
        self.sensors = Sensors(self, shared, streams, self.process, self.restart)
        self.health = DetectorHealth(self, self.sensors)
        self.intensities = IntensityCheck()

    def process(self, observation: Observation) -> None:
        """One scan: detect and publish; no reflectors are published as an empty cloud."""
        scan = observation.scan
        if scan is None or observation.T_base_laser is None or observation.sweep is None:
            return
        found = detect(scan, self.params.detector)
        seen = found.at_stamp(scan, observation.T_base_laser, observation.sweep)
        if self.sensors.hangs(scan.frame_id):
            seen = mirrored_detections(seen)  # as the laser has them
        fault = self.intensities.fault(scan)
        if not fault:  # an empty cloud says that there is no reflector
            self._publisher.publish(encode.detections(make_rclpy, seen, found.intensities))
        self.health.update(scan, found, fault)

    def restart(self, _: bool) -> None:
        """The clock jumped back: scans are independent of each other, nothing is forgotten."""


def main() -> int:
    """Run the node."""
    return run(ReflectorDetectorNode)


if __name__ == '__main__':
    sys.exit(main())
