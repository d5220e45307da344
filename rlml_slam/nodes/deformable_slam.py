# SPDX-License-Identifier: Apache-2.0
"""Executable ``deformable_slam``: the robot and the features of a moving, deforming carrier."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped

from rlml_slam.deformable.slam import DeformableSlam
from rlml_slam.params import DeformableParameters, Parameters
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.diagnostics import HealthPublisher, map_id
from rlml_slam.ros.managed_node import ManagedNode
from rlml_slam.ros.message_guard import Listener
from rlml_slam.ros.run import run
from rlml_slam.ros.sensor_input import STREAMS
from rlml_slam.ros.sensors import RELIABLE, SENSOR, Sensors
from rlml_slam.ros.systems.deformable_messages import EstimatePublisher, read_velocity
from rlml_slam.types import Observation

KEPT = 6000  # updates whose cost the diagnostics report: 10 minutes at 10 Hz


class DeformableSlamNode(ManagedNode):
    """Drives a DeformableSlam with detections; all stamps are those of the input."""

    def __init__(self, **options: Any) -> None:
        super().__init__('deformable_slam', DeformableParameters, **options)

    def build(self) -> None:
        """The estimator with its topics."""
        p: DeformableParameters = self.params
        self.slam = DeformableSlam(p)
        self._map_frame = p.node.map_frame
        self._cost = np.zeros((KEPT, 2))  # wall and CPU time of an update [s]
        self._updates = 0
        self.answers = EstimatePublisher(self, p)
        self.velocity = Listener(self, TwistStamped, 'carrier_velocity', self.announce, SENSOR)
        # the few features of a carrier may be all that is ever seen
        node = replace(p.node, trust_ids=True)
        shared = Parameters(node=node, motion=p.motion, reflector=p.reflector)
        streams = [s for s in STREAMS if s != 'scan']
        self.sensors = Sensors(self, shared, streams, self.process, self.restart)
        self.health = HealthPublisher(self, self.sensors, self.figures)
        Listener(self, PoseWithCovarianceStamped, 'initialpose', self.start_at, RELIABLE)

    def process(self, observation: Observation) -> None:
        """One observation: estimate and publish."""
        wall, cpu = time.perf_counter(), time.thread_time()
        # after a pause, the detections would overtake the velocities in the queue beside theirs
        self.velocity.drain()
        frame = self.slam.process(observation)
        if self.slam.estimate is not None:
            self.answers.publish(self.slam.estimate, self.slam.velocity)
        self.health.update(frame)
        spent = time.perf_counter() - wall, time.thread_time() - cpu
        self._cost[self._updates % KEPT] = spent
        self._updates += 1

    def announce(self, msg: TwistStamped) -> None:
        """The carrier's velocity from the stamp of a message on."""
        self.slam.announce(*read_velocity(msg, self.params.node))

    def start_at(self, msg: PoseWithCovarianceStamped) -> None:
        """Restart at a pose of the map."""
        start = decode.start_pose(msg, self._map_frame)
        self.slam.begin_at(start.pose, start.cov)
        self.get_logger().info(f'begins at {np.round(start.pose, 3).tolist()}')

    def restart(self, _: bool) -> None:
        """Forget everything: the clock jumped back."""
        self.slam.restart()

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        estimate = self.slam.estimate
        out: dict[str, object] = {
            'features': 0 if estimate is None else len(estimate.features.keys),
            'map id': map_id(None),
        }
        if self._updates:
            wall, cpu = 1e3 * np.percentile(self._cost[: self._updates], 99, axis=0)
            out['wall time of an update, p99 [ms]'] = f'{wall:.2f}'
            out['CPU time of an update, p99 [ms]'] = f'{cpu:.2f}'
        return out


def main() -> int:
    """Run the node."""
    return run(DeformableSlamNode)


if __name__ == '__main__':
    sys.exit(main())
