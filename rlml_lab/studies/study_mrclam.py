# SPDX-License-Identifier: Apache-2.0
"""``study mrclam``: maps of RLML and EKF from MR.CLAM, with known ids and without.

Where a data set has no true path, a run is compared with that of RLML with known ids. Anonymous
runs are scored by the ids that they were not given: these give the frame of the true landmarks.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.datasets.mrclam import MrclamRobot, read_mrclam
from rlml_slam import se2
from rlml_slam.datasets.text_file import SECOND
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.evaluation.ate import interpolate, trajectory_errors
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import EkfParameters, from_mapping, read_yaml
from rlml_slam.recordings.bag_replay import patient
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import ANONYMOUS, Detections, Level, Odometry, Reflectors

SYSTEMS = ('rlml', 'ekf')
STAGES = ('replay', 'live')
COLUMNS = ('path[m]', 'map[m]', 'mapped', 'found', 'twice', 'false', 'OK', 'LOST')
ALIGNMENTS = 3
RADIUS = 0.5  # [m] within which a mapped landmark is a true one
MAX_GAP = 10**9  # [ns] between two poses of the path with known ids


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study mrclam``."""
    parser = subparsers.add_parser('mrclam', help='maps from MR.CLAM, with known ids and without')
    parser.add_argument('folder', metavar='DIR', type=Path, help='one data set')
    parser.add_argument('--robot', nargs='+', type=int, default=[1, 2, 3, 4, 5], metavar='N')
    parser.add_argument('--system', nargs='+', default=list(SYSTEMS), choices=SYSTEMS)
    parser.add_argument(
        '--start', type=float, default=0.0, metavar='S', help='leave out S seconds'
    )
    parser.add_argument('--config', type=Path, metavar='YAML', help='parameters that differ')


def run(args: argparse.Namespace) -> int:
    """Print a row for each robot, system and stage."""
    given = read_yaml(args.config, EkfParameters) if args.config else {}
    params: EkfParameters = from_mapping(given, EkfParameters)
    print(f'{"robot":<6}{"system":<7}{"stage":<8}{"ids":<6}', *(f'{c:>7}' for c in COLUMNS))
    for robot in args.robot:
        data = begun_at(read_mrclam(args.folder, robot), args.start)
        reference = data.truth
        for system, stage, ids in product(args.system, STAGES, ('known', 'none')):
            path, found, log = drive(data, system, stage, params, ids == 'known')
            reference = reference or path
            figures = (*evaluate(data, path, found, reference), *shares(log))
            words = (f'{v:>7.3f}' if isinstance(v, float) else f'{v:>7}' for v in figures)
            print(f'{robot:<6}{system:<7}{stage:<8}{ids:<6}', *words, flush=True)
    return 0


def begun_at(data: MrclamRobot, start: float) -> MrclamRobot:
    """The run without its first ``start`` seconds: a map should not depend on these."""
    first = data.odometry[0].stamp + int(start * SECOND)
    odometry = [o for o in data.odometry if o.stamp >= first]
    detections = [d for d in data.detections if d.stamp >= first]
    return dataclasses.replace(data, odometry=odometry, detections=detections)


def drive(
    data: MrclamRobot, system: str, stage: str, params: EkfParameters, ids: bool
) -> tuple[Trajectory, Reflectors, FrameLog]:
    """Path, landmarks and frames: of a replay, or ``live``, without what follows the end."""
    if stage == 'replay':
        params = dataclasses.replace(params, node=patient(params).node)
    slam: Slam | EkfSlam = Slam(params) if system == 'rlml' else EkfSlam(params)
    log, none = FrameLog(), ANONYMOUS
    inputs: list[Odometry | Detections] = [*data.odometry, *data.detections]
    for item in sorted(inputs, key=lambda i: i.stamp):
        if isinstance(item, Odometry):
            log.add(slam.add_odometry(item))
        else:
            given = item if ids else dataclasses.replace(item, ids=np.full(len(item), none))
            log.add(slam.add_detections(given))
    if stage == 'replay':
        log.add(slam.finish())
    else:
        log.add(slam.process(slam.synchronizer.flush()))
        if isinstance(slam, Slam):
            slam.back_end.finish()
    return Trajectory(*slam.trajectory()), slam.reflectors(), log


def evaluate(
    data: MrclamRobot, path: Trajectory, found: Reflectors, reference: Trajectory
) -> tuple[float, float, int, int, int, int]:
    """Errors [m] of path and landmarks; landmarks, true ones among them, doubles, false ones."""
    T, truth = frame_of_truth(data, path), data.landmark_points
    of = nearest(se2.transform(T, found.points), found, data)
    for _ in range(ALIGNMENTS):
        points = se2.transform(T, found.points)
        of = nearest(points, found, data)
        d = np.linalg.norm(points - truth[of], axis=-1)
        # of several for one true landmark, the nearest
        order = np.argsort(d)
        own = order[np.unique(of[order], return_index=True)[1]]
        own = own[of[own] >= 0]
        if len(own) > 1:
            T = se2.align(found.points[own], truth[of[own]])
    rmse = float(np.sqrt((d[own] ** 2).mean())) if len(own) else math.nan
    error = trajectory_errors(path, reference, True, MAX_GAP).summary()['rmse_m']
    true = int((of >= 0).sum())
    return error, rmse, len(found), len(own), true - len(own), len(found) - true


def nearest(points: Array, found: Reflectors, data: MrclamRobot) -> NDArray[np.int64]:
    """True landmark of each one found (m,), by its id or within RADIUS; -1 for none."""
    d = np.linalg.norm(points[:, None] - data.landmark_points, axis=-1)
    d[(found.ids[:, None] != ANONYMOUS) & (found.ids[:, None] == data.landmark_ids)] = 0.0
    return np.where(d.min(axis=1) < RADIUS, d.argmin(axis=1), -1)


def frame_of_truth(data: MrclamRobot, path: Trajectory) -> Array:
    """Pose (3,) of the map in the frame of the truth: median places of the detections by id."""
    ids = np.concatenate([d.ids for d in data.detections])
    z = np.concatenate([d.points for d in data.detections])
    stamps = np.repeat([d.stamp for d in data.detections], [len(d) for d in data.detections])
    poses, known = interpolate(path, stamps, MAX_GAP)
    places = se2.transform(poses, z[:, None])[:, 0]
    at = [
        np.median(places[known & (ids == i)], axis=0)
        for i in data.landmark_ids if (known & (ids == i)).any()
    ]  # fmt: skip
    seen: NDArray[np.bool_] = np.isin(data.landmark_ids, ids[known])
    return se2.align(np.array(at), data.landmark_points[seen])


def shares(log: FrameLog) -> tuple[float, float]:
    """Of the frames that are OK, and LOST."""
    levels = np.array(log.levels)
    return float((levels == Level.OK).mean()), float((levels == Level.LOST).mean())
