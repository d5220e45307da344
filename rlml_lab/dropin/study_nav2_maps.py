# SPDX-License-Identifier: Apache-2.0
"""``study nav2-maps``: localization in maps of nav2 without reflectors, by the size of a cell.

The walls of a simulated world are drawn as others draw them: a cell is occupied where there is a
wall in it. So a wall lies anywhere in its cells, and all that is seen of it is off by the same.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.support.drives import simulate
from rlml_slam import se2, warm_up
from rlml_slam.evaluation.metrics import run_errors
from rlml_slam.evaluation.run_record import FrameLog, Run, Truth
from rlml_slam.maps import nav2_map, saved_map
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Node, Parameters, SimulatorParameters, from_mapping
from rlml_slam.recordings.products import collect
from rlml_slam.se2 import Array
from rlml_slam.simulation.simulation import Message
from rlml_slam.simulation.world import World
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Detections, Level, Odometry, Scan

STEP = 0.005  # [m] between the points of a wall that are drawn
SETTLED = 20  # frames, from which on the errors count
YAWS = (0.0, 0.7)  # [rad] of the lattice


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study nav2-maps``."""
    parser = subparsers.add_parser('nav2-maps', help='localization by the size of a cell')
    parser.add_argument('--world', nargs='+', default=['hall', 'room'], metavar='NAME')
    parser.add_argument('--cell', type=float, nargs='+', default=[0.025, 0.05, 0.1], help='[m]')
    parser.add_argument('--seeds', type=int, default=4, help='(default: %(default)s)')
    parser.add_argument('--duration', type=float, default=60.0, help='of a drive [s]')


def run(args: argparse.Namespace) -> int:
    """A row for each world, size of a cell and yaw of the lattice."""
    print('world, cell [cm], yaw: position rms [cm], largest; heading rms [°]; NEES (3 is ideal)')
    for world in args.world:
        values = {'world': world, 'duration': args.duration}
        simulator: SimulatorParameters = from_mapping(values, SimulatorParameters)
        drives = [simulate(simulator, seed) for seed in range(args.seeds)]
        for cell in args.cell:
            for yaw in YAWS:
                found = [
                    localize(drawn(load_world(world), cell, yaw, seed), *drive, simulator)
                    for seed, drive in enumerate(drives)
                ]
                print(f'{world}, {100 * cell:g}, {yaw:g}: {row(found)}', flush=True)
    return 0


def drawn(world: World, cell: float, yaw: float, seed: int) -> OccupancyGrid:
    """The walls of a world in its map frame, on a lattice that lies anywhere."""
    g, out = world.without_movers().geometry(0.0), []
    for x0, y0, x1, y1 in g.segments[:, :4]:
        n = max(2, int(np.hypot(x1 - x0, y1 - y0) / STEP))
        out.append(np.linspace((x0, y0), (x1, y1), n))
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    for x, y, r in g.discs[:, :3]:
        out.append(np.stack([x + r * np.cos(turn), y + r * np.sin(turn)], -1))
    points = se2.transform(se2.inverse(world.start), np.concatenate(out))
    turned = points @ se2.rotation(yaw)
    rest = np.random.default_rng(seed).uniform(0.0, cell, 2)
    low = np.floor(turned.min(axis=0) / cell) * cell - 10 * cell + rest
    at = np.floor((turned - low) / cell).astype(int)
    cells = np.zeros(at.max(axis=0)[::-1] + 10, dtype=np.int8)
    cells[at[:, 1], at[:, 0]] = 100
    corner = se2.rotation(yaw) @ low
    return OccupancyGrid(cell, (float(corner[0]), float(corner[1])), cells, yaw)


def localize(
    grid: OccupancyGrid, messages: list[Message], truth: Truth, simulator: SimulatorParameters
) -> tuple[Array, Array, float]:
    """Errors (n, 3), NEES (n,), and the share of frames that are OK."""
    slam, log = Slam(Parameters(node=Node(mode='localization'))), FrameLog()
    slam.set_sensor_pose(simulator.node.laser_frame, np.array(simulator.node.laser_pose))
    warm_up.compile_loaded()
    with tempfile.TemporaryDirectory() as folder:
        slam.use_map(saved_map.load(nav2_map.save(grid, Path(folder) / 'map')[1]))
    for m in messages:
        if isinstance(m, Odometry):
            log.add(slam.add_odometry(m))
        elif isinstance(m, Scan):
            log.add(slam.add_scan(m))
        elif isinstance(m, Detections):
            continue
    log.add(slam.finish())
    result: Run = collect(slam, log, '', truth)
    errors = run_errors(result)
    assert errors is not None
    ok = np.mean([level == Level.OK for level in result.frames.levels[SETTLED:]])
    return errors.live.errors[SETTLED:], errors.nees[SETTLED:], float(ok)


def row(found: list[tuple[Array, Array, float]]) -> str:
    """Errors of all drives, mean NEES with its spread over drives."""
    e = np.concatenate([errors for errors, _, _ in found])
    distance = 100.0 * np.hypot(e[:, 0], e[:, 1])
    means = [float(np.nanmean(n)) for _, n, _ in found]
    return (
        f'{np.sqrt(np.mean(distance**2)):.2f}, {distance.max():.2f}; '
        f'{np.degrees(np.sqrt(np.mean(e[:, 2] ** 2))):.3f}; '
        f'{np.mean(means):.2f} ({min(means):.2f} to {max(means):.2f}); '
        f'OK {np.mean([ok for _, _, ok in found]):.3f}'
    )
