# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab convert``: public data sets that studies use become bags."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.datasets import lego, mrclam, victoria_park
from rlml_slam.cli.convert import WORLD, Recording, add_output_arguments, write
from rlml_slam.types import Detections


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab convert mrclam``, ``victoria-park`` and ``lego``."""
    parser = subparsers.add_parser('convert', help='public data sets become bags')
    kinds = parser.add_subparsers(dest='kind', metavar='FORMAT', required=True)

    clam = kinds.add_parser('mrclam', help='UTIAS MR.CLAM: landmarks become reflectors')
    clam.add_argument(
        'folder', metavar='DIR', type=Path, help='one data set, e.g. MRCLAM_Dataset6'
    )
    clam.add_argument('--robot', type=int, required=True, choices=range(1, 6), metavar='N')
    clam.add_argument('--no-ids', action='store_true', help='the detections are anonymous')
    clam.add_argument(
        '--depths', action='store_true',
        help="make ranges of what is logged as such: the camera's depths",
    )  # fmt: skip

    park = kinds.add_parser('victoria-park', help='Victoria Park: tree trunks become reflectors')
    park.add_argument('folder', metavar='DIR', type=Path, help='folder of the .mat files')

    robot = kinds.add_parser('lego', help='LEGO robot among cylinders: scans, ticks, camera track')
    robot.add_argument('folder', metavar='DIR', type=Path, help='folder of the robot4_*.txt files')

    for kind in (clam, park, robot):
        add_output_arguments(kind)


def run(args: argparse.Namespace) -> int:
    """Convert, and say what was written and what was left out."""
    return write(args, *_READERS[args.kind](args))


def _read_mrclam(args: argparse.Namespace) -> tuple[Recording, dict[str, int]]:
    data = mrclam.read_mrclam(args.folder, args.robot, not args.no_ids, args.depths)
    n = len(data.landmark_ids)
    known = Detections(
        data.odometry[0].stamp, WORLD, data.landmark_points, np.zeros((n, 2, 2)),
        data.landmark_ids, np.full(n, np.nan),
    )  # fmt: skip
    recording = Recording(
        data.odometry, detections=data.detections, truth=data.truth, true_reflectors=known
    )
    return recording, dict(data.counts)


def _read_victoria_park(args: argparse.Namespace) -> tuple[Recording, dict[str, int]]:
    data = victoria_park.read_victoria_park(args.folder)
    sensors = {victoria_park.LASER_FRAME: victoria_park.T_BASE_LASER}
    recording = Recording(
        data.odometry, detections=data.detections, sensors=sensors, truth=data.gps
    )
    return recording, dict(data.counts)


def _read_lego(args: argparse.Namespace) -> tuple[Recording, dict[str, int]]:
    data = lego.read_lego(args.folder)
    n = len(data.landmarks)
    known = Detections(
        data.odometry[0].stamp, WORLD, data.landmarks, np.zeros((n, 2, 2)),
        np.arange(n, dtype=np.int64), np.full(n, np.nan),
    )  # fmt: skip
    sensors = {lego.LASER_FRAME: lego.T_BASE_LASER}
    recording = Recording(
        data.odometry, data.scans, sensors=sensors, truth=data.track, true_reflectors=known
    )
    return recording, dict(data.counts)


_READERS = {
    'mrclam': _read_mrclam,
    'victoria-park': _read_victoria_park,
    'lego': _read_lego,
}
