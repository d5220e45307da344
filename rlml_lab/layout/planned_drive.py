# SPDX-License-Identifier: Apache-2.0
"""A drive through a layout, localized in it, beside what is planned along its path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_lab.support.drives import feed_one
from rlml_slam import warm_up
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.plan import Goal, make_plan
from rlml_slam.planning.site import Site
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import GroundTruth, Simulation
from rlml_slam.simulation.world import World
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Level, Reflectors

SETTLED = 3_000_000_000  # [ns] after the start, from which errors count
SPACING = 0.1  # [m] of path between places that are planned


@dataclass(frozen=True)
class Driven:
    """RMS error [m] in its worst direction, the planned and the stated sigma [m], and OK share.

    ``along`` and ``across`` are the RMS errors in x and y of the world.
    """

    error: float
    planned: float
    stated: float
    ok_share: float
    along: float
    across: float


def drive(world: World, site: Site, goal: Goal, seed: int) -> Driven:
    """Localize in the reflectors of a site and its grid, from a known start, in a world."""
    simulator = SimulatorParameters()
    params = Parameters()
    params = replace(params, node=replace(params.node, mode='localization',
                                          map_start_pose=tuple(world.start.tolist()),
                                          map_start_sigma=(0.05, 0.05, 0.02)))  # fmt: skip
    world = replace(world.without_movers(), reflectors=site.reflectors)
    warm_up.compile_loaded()
    slam, m = Slam(params), len(site.reflectors)
    slam.set_sensor_pose(simulator.node.laser_frame, np.array(simulator.node.laser_pose))
    known = Reflectors(np.arange(m), site.reflectors.points, np.tile(1e-8 * np.eye(2), (m, 1, 1)),
                       np.full(m, -1), np.full(m, 100), site.reflectors.widths)  # fmt: skip
    slam.use_map(SavedMap(known, site.grid))
    truth: dict[int, Array] = {}
    frames = []
    for event in Simulation(world, simulator, seed):
        if isinstance(event.message, GroundTruth):
            truth[event.message.stamp] = event.message.T_world_base
        frames += feed_one(slam, event.message)
    frames += slam.finish()
    stamps = np.array(list(truth))
    path = np.array(list(truth.values()))
    counted = [f for f in frames if f.stamp > stamps[0] + SETTLED and f.stamp <= stamps[-1]]
    true = np.stack(
        [np.interp([f.stamp for f in counted], stamps, path[:, k]) for k in (0, 1)], -1
    )
    d = np.array([f.T_map_base[:2] for f in counted]) - true
    places = true[_every(true)] + 1e-9
    plan = make_plan(site, places, params, simulator, goal)
    stated = [np.linalg.eigvalsh(f.cov_map[:2, :2])[-1] for f in counted]
    return Driven(
        float(np.sqrt(np.linalg.eigvalsh(d.T @ d / len(d))[-1])),
        float(np.sqrt(np.mean(plan.driving.position**2))), float(np.sqrt(np.mean(stated))),
        float(np.mean([f.health.level is Level.OK for f in counted])),
        *(float(v) for v in np.sqrt(np.mean(d**2, axis=0))),
    )  # fmt: skip


def _every(path: Array) -> NDArray[np.int64]:
    """Indices of points (n, 2) about SPACING of travel apart."""
    lap = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    return np.asarray(np.unique(np.floor(lap / SPACING), return_index=True)[1])
