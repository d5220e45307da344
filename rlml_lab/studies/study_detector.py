# SPDX-License-Identifier: Apache-2.0
"""``study detector``: where the reflector detector puts centres, and what it takes for them.

Simulated scans of 1440 beams: cylinders before walls (bias, spread, honesty, share detected),
rooms of glossy walls and people, and drives through the package's worlds, without any reflector
(false detections), a drive through the hall (all of it together, in motion), the time per scan.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.studies.detector_scenes import AROUND, StillLaser, cylinders, room
from rlml_slam import se2
from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import ParameterError
from rlml_slam.params import (
    Detector,
    DetectorParameters,
    Laser,
    SimulatorParameters,
    from_mapping,
    read_yaml,
)
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import sweep_time
from rlml_slam.sensing.reflectors.reflector_detector import Found, detect
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import Simulation
from rlml_slam.simulation.world_file import load_world
from rlml_slam.types import Detections, Scan

DIAMETERS = (0.04, 0.06, 0.08, 0.1)
DISTANCES = (2.0, 5.0, 10.0, 15.0, 20.0, 25.0)
PEOPLE = 5
WORLDS = ('hall', 'yard', 'corridor', 'symmetric')
HALL_FLAT = 0.12  # [m] width of the flat reflectors of the hall
MATCH = 0.3  # [m] a detection farther from every reflector is a false one


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study detector``."""
    parser = subparsers.add_parser(
        'detector', help='bias, false detections and reach of the reflector detector'
    )
    parser.add_argument(
        '--scans', type=int, default=200, metavar='N',
        help='scans per diameter and distance, each of 12 cylinders (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--rooms', type=int, default=5000, metavar='N',
        help='rooms with glossy walls and people (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--drive', type=float, default=60.0, metavar='S', help='of the hall (default: %(default)s)'
    )
    parser.add_argument('--seed', type=int, default=0, metavar='N')
    parser.add_argument('--config', type=Path, metavar='YAML', help="the detector's parameters")
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run all parts and print their figures."""
    if min(args.scans, args.rooms) < 1 or args.drive <= 0.0:
        raise ParameterError('study detector: --scans, --rooms and --drive must be positive')
    values = read_yaml(args.config, DetectorParameters) if args.config else {}
    given: DetectorParameters = from_mapping(values, DetectorParameters)
    p, laser = given.detector, Laser()
    summary: dict[str, Any] = {'cylinders': []}
    with Progress('detector', len(DIAMETERS) * len(DISTANCES) + 4, args.json) as progress:
        done = 0
        for diameter in DIAMETERS:
            for distance in DISTANCES:
                figures = evaluate_cylinders(p, laser, diameter, distance, args.scans, args.seed)
                summary['cylinders'].append(figures)
                done += 1
                progress.update(done, f'{1e3 * diameter:.0f} mm at {distance:.0f} m')
        summary['rooms'] = evaluate_rooms(p, laser, args.rooms, 0, args.seed)
        progress.update(done + 1, 'rooms')
        summary['vests'] = evaluate_rooms(p, laser, args.rooms, 1, args.seed)
        progress.update(done + 2, 'vests')
        summary['worlds'] = evaluate_worlds(p, args.drive, args.seed)
        progress.update(done + 3, 'worlds')
        summary['hall'] = evaluate_hall(p, args.drive, args.seed)
        progress.update(done + 4, 'hall')
    summary['ms_per_1440_beams'] = cost(p, laser, args.seed)
    print(json.dumps(summary) if args.json else text(summary))
    return 0


def evaluate_cylinders(
    p: Detector, laser: Laser, diameter: float, distance: float, scans: int, seed: int
) -> dict[str, Any]:
    """Errors of centres along and across the beam [mm], NEES and share detected."""
    rng = np.random.default_rng([seed, round(1e3 * diameter), round(distance)])
    still, p = StillLaser(laser, seed), replace(p, diameter=diameter, flat_width=0.0)
    errors, nees = [np.zeros((0, 2))], [np.zeros(0)]
    false = 0
    for _ in range(scans):
        geometry, centres = cylinders(rng, diameter, distance)
        found = detect(still.scan(geometry), p)
        pairs = matched(found.points, centres)
        false += len(found) - len(pairs)
        e = found.points[pairs[:, 0]] - centres[pairs[:, 1]]
        u = centres[pairs[:, 1]] / distance
        errors.append(np.stack([np.sum(u * e, -1), u[:, 0] * e[:, 1] - u[:, 1] * e[:, 0]], -1))
        nees.append(np.einsum('ni,nij,nj->n', e, np.linalg.inv(found.cov[pairs[:, 0]]), e))
    error, chi2 = 1e3 * np.concatenate(errors), np.concatenate(nees)
    count = max(len(error), 1)
    return {
        'diameter_mm': round(1e3 * diameter),
        'distance_m': distance,
        'detected': len(error) / (scans * AROUND),
        'false': false,
        'bias_along_mm': float(error[:, 0].mean()) if len(error) else None,
        'bias_across_mm': float(error[:, 1].mean()) if len(error) else None,
        'sigma_along_mm': float(error[:, 0].std()) if len(error) else None,
        'sigma_across_mm': float(error[:, 1].std()) if len(error) else None,
        'bias_error_mm': float(error.std(0).max() / count**0.5) if len(error) else None,
        'nees': float(chi2.mean()) if len(error) else None,
    }


def matched(points: Array, truth: Array) -> NDArray[np.int64]:
    """Pairs (n, 2) of indices, each of both at most once, nearest first and within MATCH."""
    if not len(points) or not len(truth):
        return np.zeros((0, 2), dtype=np.int64)
    apart = np.linalg.norm(points[:, None] - truth, axis=-1)
    pairs = []
    while apart.min() <= MATCH:
        i, j = np.unravel_index(int(apart.argmin()), apart.shape)
        pairs.append((i, j))
        apart[i], apart[:, j] = np.inf, np.inf
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def evaluate_rooms(p: Detector, laser: Laser, rooms: int, vests: int, seed: int) -> dict[str, Any]:
    """False detections in rooms without reflectors, and what bright spots were rejected for."""
    rng = np.random.default_rng([seed, 7, vests])
    still = StillLaser(laser, seed)
    false = 0
    rejected: Counter[str] = Counter()
    for _ in range(rooms):
        found = detect(still.scan(room(rng, PEOPLE, vests)), p)
        false += len(found)
        rejected.update({fate.name.lower(): n for fate, n in found.rejected.items()})
    return {
        'scans': rooms,
        'false': false,
        'false_per_1000_scans': 1e3 * false / rooms,
        'rejected': dict(sorted(rejected.items())),
    }


def evaluate_worlds(p: Detector, duration: float, seed: int) -> dict[str, Any]:
    """False detections in drives through the package's worlds, their reflectors taken away."""
    scans = false = 0
    for name in WORLDS:
        values = {'duration': duration, 'markers.enabled': False}
        parameters: SimulatorParameters = from_mapping(values, SimulatorParameters)
        world = load_world(name).without_reflectors()
        for event in Simulation(world, parameters, seed):
            if isinstance(event.message, Scan):
                scans += 1
                false += len(detect(event.message, p))
    return {'scans': scans, 'false': false, 'false_per_1000_scans': 1e3 * false / scans}


def evaluate_hall(p: Detector, duration: float, seed: int) -> dict[str, Any]:
    """A drive through the hall: detections against the reflectors that can be seen."""
    p = replace(p, flat_width=p.flat_width or HALL_FLAT)
    exact = {
        'world': 'hall', 'duration': duration, 'markers.sigma_range': 0.0,
        'markers.sigma_bearing': 0.0, 'markers.missed_share': 0.0, 'markers.false_detections': 0.0,
    }  # fmt: skip
    parameters: SimulatorParameters = from_mapping(exact, SimulatorParameters)
    T_base_laser = np.array(parameters.node.laser_pose)
    simulation = Simulation(load_world('hall'), parameters, seed)
    waiting: dict[int, Scan] = {}
    visible = hits = false = scans = 0
    everywhere, _ = simulation.true_reflectors()
    squares, chi2 = [0.0], [0.0]
    for event in simulation:
        message = event.message
        if isinstance(message, Scan):
            waiting[message.stamp] = message
        if not isinstance(message, Detections) or message.stamp not in waiting:
            continue
        scan = waiting.pop(message.stamp)
        end = scan.stamp + int(sweep_time(scan) * SECOND)
        if end > simulation.time:
            continue
        here, there = (simulation.truth(t).T_map_base for t in (scan.stamp, end))
        seen = detect(scan, p).at_stamp(scan, T_base_laser, se2.between(here, there)[None])
        pairs = matched(seen.points, message.points)
        scans += 1
        visible += len(message)
        T_laser_map = se2.inverse(se2.compose(here, T_base_laser))
        false += len(seen) - len(matched(seen.points, se2.transform(T_laser_map, everywhere)))
        hits += len(pairs)
        e = seen.points[pairs[:, 0]] - message.points[pairs[:, 1]]
        squares += list(np.sum(e * e, -1))
        chi2 += list(np.einsum('ni,nij,nj->n', e, np.linalg.inv(seen.cov[pairs[:, 0]]), e))
    return {
        'scans': scans,
        'visible': visible,
        'detected': hits / max(visible, 1),
        'false': false,
        'rmse_mm': 1e3 * float(np.mean(squares[1:])) ** 0.5 if hits else None,
        'nees': float(np.mean(chi2[1:])) if hits else None,
    }


def cost(p: Detector, laser: Laser, seed: int, scans: int = 200) -> float:
    """Median time [ms] of a scan of 1440 beams with 12 cylinders."""
    rng, still = np.random.default_rng([seed, 9]), StillLaser(laser, seed)
    made = [still.scan(cylinders(rng, p.diameter or 0.08, 6.0)[0]) for _ in range(20)]
    spent = []
    found: Found | None = None
    for k in range(scans):
        began = time.perf_counter()
        found = detect(made[k % len(made)], p)
        spent.append(time.perf_counter() - began)
    assert found is not None
    return 1e3 * float(np.median(spent)) * 1440 / laser.beams


def text(summary: Mapping[str, Any]) -> str:
    """The tables as text."""
    cells: list[Sequence[str]] = [
        ('cylinder', 'at', 'detected', 'bias along', 'across', 'σ along', 'σ across', 'NEES (2)')
    ]
    for c in summary['cylinders']:
        row = [f'{c["diameter_mm"]} mm', f'{c["distance_m"]:.0f} m', f'{c["detected"]:.1%}']
        for key in ('bias_along_mm', 'bias_across_mm', 'sigma_along_mm', 'sigma_across_mm'):
            row.append('-' if c[key] is None else f'{c[key]:.2f} mm')
        cells.append([*row, '-' if c['nees'] is None else f'{c["nees"]:.2f}'])
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    lines = ['  '.join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in cells]
    lines.append('')
    for name, what in (('rooms', 'glossy walls and people'), ('vests', 'and a vest in each')):
        r = summary[name]
        spots = ', '.join(f'{n} {why}' for why, n in r['rejected'].items()) or 'none'
        lines.append(
            f'{what}: {r["false"]} false detections in {r["scans"]} scans, '
            f'{r["false_per_1000_scans"]:.2f} per 1000; rejected bright spots: {spots}'
        )
    w = summary['worlds']
    lines.append(
        f'{", ".join(WORLDS)} without reflectors: {w["false"]} false detections in '
        f'{w["scans"]} scans'
    )
    h = summary['hall']
    if h['rmse_mm'] is not None:
        lines.append(
            f'hall, in motion: {h["detected"]:.1%} of {h["visible"]} sightings in {h["scans"]} '
            f'scans, {h["false"]} false, RMSE {h["rmse_mm"]:.1f} mm, NEES {h["nees"]:.2f} (2)'
        )
    lines.append(f'time: {summary["ms_per_1440_beams"]:.2f} ms per 1440 beams (median)')
    return '\n'.join(lines)
