# SPDX-License-Identifier: Apache-2.0
"""The bags of a fleet, from the simulator: worlds, seeds and faults in turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rlml_lab.fleet.bags import find_bags
from rlml_lab.fleet.replay_job import Job, code_digest
from rlml_slam.cli.simulate import write_bag
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world_file import load_world

WORLDS = ('hall', 'corridor', 'room', 'yard')
FAULTS: Mapping[str, Mapping[str, Any]] = {
    'clean': {},
    'slip': {'wheels.slip_rate': 0.2},
    'misses': {'markers.missed_share': 0.3, 'markers.false_detections': 0.2},
    'lost': {'transport.lost_share': 0.1, 'transport.late_share': 0.05},
    'dropout': {'laser.dropout_share': 0.2},
}
WRONG_POSE = (0.5, 0.15, 0.05)  # of the laser in a static transform; the true one is (0.2, 0, 0)


@dataclass(frozen=True)
class Fleet:
    """Bags in a folder, and where results go."""

    bags: Path
    out: Path
    seconds: float
    reruns: int

    def jobs(self, out: Path) -> list[Job]:
        """A replay of each bag, without pictures."""
        return [
            Job(bag, Parameters(), str(out), code_digest(), report=False)
            for bag in find_bags([str(self.bags)])
        ]

    def table(self, name: str) -> bytes:
        """fleet.parquet of a run."""
        return (self.out / name / 'fleet.parquet').read_bytes()


def name_of(k: int) -> str:
    """The name of bag k: all worlds before a fault, all faults before a seed."""
    world, fault = WORLDS[k % 4], list(FAULTS)[k // 4 % len(FAULTS)]
    return f'{world}/{fault}_{k // (4 * len(FAULTS)):03d}'


def make_bag(folder: str, k: int, seconds: float, wrong_pose: bool = False) -> str:
    """Write bag k unless it is there; its name.

    With ``wrong_pose`` the drive is the same, and the static transform has WRONG_POSE.
    """
    name = name_of(k)
    path = Path(folder) / name
    if (path / 'metadata.yaml').exists():
        return name
    path.parent.mkdir(parents=True, exist_ok=True)
    world, _, fault = name.partition('/')
    values = {'world': world, 'seed': k, 'duration': seconds, **FAULTS[fault[:-4]]}
    parameters: SimulatorParameters = from_mapping(values, SimulatorParameters)
    simulation = Simulation(load_world(world), parameters)
    if wrong_pose:  # what is published; the simulated laser stays where it is
        node = replace(parameters.node, laser_pose=WRONG_POSE)
        simulation.parameters = replace(parameters, node=node)
    write_bag(simulation, path)
    return name
