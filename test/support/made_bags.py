# SPDX-License-Identifier: Apache-2.0
"""Short bags: of simulated drives, and the beginnings of others."""

from __future__ import annotations

from pathlib import Path

from rlml_slam.cli.simulate import write_bag
from rlml_slam.params import SimulatorParameters, from_mapping
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world_file import load_world


def simulated_bag(path: Path, world: str = 'room', seed: int = 1, duration: float = 3.0) -> Path:
    """A bag of some seconds."""
    values = {'world': world, 'seed': seed, 'duration': duration}
    path.parent.mkdir(parents=True, exist_ok=True)
    parameters = from_mapping(values, SimulatorParameters)
    write_bag(Simulation(load_world(world), parameters), path)
    return path


def beginning(bag: Path, out: Path, seconds: float) -> Path:
    """The first seconds of a bag as a bag."""
    with BagReader(bag) as source, BagWriter(out) as written:
        for topic in source.topics.values():
            written.add_topic(topic.name, topic.msgtype, source.is_latched(topic.name))
        for time, topic, message in source.messages():
            if time > source.start + seconds * 1e9:
                break
            written.write(topic, message, time)
    return out
