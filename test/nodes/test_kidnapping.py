# SPDX-License-Identifier: Apache-2.0
"""Live nodes, and a robot that is carried away: lost within a second, found within three."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.params import Laser, Simulator, SimulatorParameters
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.systems.simulator_messages import SENSOR_TOPICS, SimulatedMessages
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import START, GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Level

KIDNAPPED = 24.0  # [s] after the whole room has been seen
P = SimulatorParameters(
    node=Simulator(world='room', duration=30.0, kidnap_time=KIDNAPPED, kidnap_distance=-9.0),
    laser=replace(Laser(), beams=360),
)


def drive(live, front, back, events, end):
    """Feed the events until ``end`` [s] as messages; the frames, and the true poses by stamp."""
    messages, truth, frames = SimulatedMessages(make, P), {}, []
    for event in events:
        if isinstance(event.message, GroundTruth):
            truth[event.message.stamp] = event.message.T_map_base
        topic, message = messages(event.message)
        last = front.last
        if topic in SENSOR_TOPICS:
            front.sensors.add(topic, message)
        if front.last is not last:
            frames.append(front.last)
            stamp = front.last.stamp
            live.spin_until(lambda t=stamp: back.health.newest >= t)
            # the searches as well: their time is not that of the simulation
            mapper = back.mapper
            for worker in (mapper.worker, mapper.searcher.worker, mapper.worker):
                worker.submit(lambda: None).result()
            if stamp > START + KIDNAPPED * SECOND:  # and so is that of an answer on its way
                live.drain(rounds=3)
        if event.time >= START + end * SECOND:
            break
    return frames, truth


def judged(frames, truth):
    """Seconds since the kidnapping, levels and errors [m] of frames."""
    stamps = np.array(sorted(truth))
    at = np.array([truth[stamps[np.abs(stamps - f.stamp).argmin()]] for f in frames])
    error = se2.between(at, np.array([f.T_map_base for f in frames]))
    t = np.array([f.stamp - START for f in frames]) * 1e-9 - KIDNAPPED
    return t, np.array([f.health.level for f in frames]), np.hypot(error[:, 0], error[:, 1])


@pytest.mark.parametrize('localizes', [False, True], ids=['mapping', 'localization'])
def test_carried_robot_is_lost_and_found_again(live, localizes):
    front = live.start(FrontEndNode, laser_pose=list(P.node.laser_pose))
    back = live.start(BackEndNode, laser_pose=list(P.node.laser_pose))
    events = iter(Simulation(load_world('room'), P, seed=1))
    front.sensors.stop_waiting()
    talk = ('rlml/frames', 'deskewed_points', 'reflectors/associated')
    heard = (
        'rlml/session_start',
        'rlml/graph_correction',
        'rlml/localization_grid',
        'rlml/localization_map',
    )
    live.spin_until(
        lambda: (
            all(front.count_subscribers(topic) == 1 for topic in talk)
            and all(back.count_subscribers(topic) == 1 for topic in heard)
            and front.control.session.mode
        )
    )
    frames, truth = drive(live, front, back, events, 20.0)
    if localizes:
        back.mapper.worker.submit(lambda: back.requests.localize(True)).result()
        live.spin_until(lambda: front.control.session.map is not None)
        frames = []
    more, also_true = drive(live, front, back, events, 40.0)
    t, levels, errors = judged([*frames, *more], truth | also_true)
    lost = t[levels == Level.LOST]
    assert 0.0 < lost[0] < 1.0
    back_at = t[(levels == Level.OK) & (t > lost[0])][0]
    assert back_at < 3.0
    # 20 ms at full speed lie between a frame and the next truth
    assert errors[(t < 0.0) | (t > back_at + 0.5)].max() < 0.08
    assert front.control.session.map is None or localizes
