# SPDX-License-Identifier: Apache-2.0
"""``rlml convert``: a recorded log becomes a bag, which everything else reads."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rlml_slam.cli.main import between
from rlml_slam.datasets import carmen
from rlml_slam.datasets.text_file import SECOND
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.systems.simulator_messages import TRUE_REFLECTORS
from rlml_slam.se2 import Array
from rlml_slam.types import Detections, Odometry, Scan

SQLITE_SUFFIXES = ('.db3', '.sqlite3')
ODOM, BASE, WORLD = 'odom', 'base_link', 'world'


@dataclass(frozen=True)
class Recording:
    """What goes into a bag. ``sensors``: T_base_sensor (3,) by frame.

    ``truth`` and ``true_reflectors`` are in the frame ``world``; a truth with NaN headings has
    positions only.
    """

    odometry: Sequence[Odometry]
    scans: Sequence[Scan] = ()
    detections: Sequence[Detections] = ()
    sensors: Mapping[str, Array] = field(default_factory=dict)
    truth: Trajectory | None = None
    true_reflectors: Detections | None = None


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml convert carmen``."""
    parser = subparsers.add_parser(
        'convert', help='a recorded log becomes a bag',
        epilog='In a checkout, rlml-lab convert reads MR.CLAM, Victoria Park and LEGO data sets.',
    )  # fmt: skip
    kinds = parser.add_subparsers(dest='kind', metavar='FORMAT', required=True)

    log = kinds.add_parser('carmen', help='CARMEN log: FLASER, ROBOTLASER1, RAWLASER + ODOM')
    log.add_argument('log', metavar='LOG', type=Path, help='.log or .clf, also .gz or .xz')
    log.add_argument(
        '--max-range',
        type=between(0.0, 1e4),
        metavar='M',
        help='ranges from here on are no returns',
    )
    log.add_argument(
        '--field-of-view',
        type=between(1.0, 360.0),
        metavar='DEG',
        help='span of the beams of FLASER lines',
    )
    log.add_argument('--strict', action='store_true', help='fail at the first broken line')
    add_output_arguments(log)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """The bag that is written, and how."""
    parser.add_argument('bag', metavar='BAG', type=Path, help='folder to be written')
    parser.add_argument(
        '--format', choices=('mcap', 'sqlite3'),
        help='storage of the bag (default: mcap, or sqlite3 if BAG ends with .db3)',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Convert, and say what was written and what was left out."""
    return write(args, *_read_carmen(args))


def write(args: argparse.Namespace, recording: Recording, counts: Mapping[str, int]) -> int:
    """Write the bag that the arguments name, and say what is in it; the exit code."""
    written = write_recording(args.bag, recording, storage_of(args.bag, args.format))
    summary = {'bag': str(args.bag), 'messages': written, 'source': counts}
    if args.json:
        print(json.dumps(summary))
    else:
        print(f'{args.bag}: ' + ', '.join(f'{n} {topic}' for topic, n in written.items()))
        print('read: ' + ', '.join(f'{n} {what}' for what, n in counts.items()))
    return 0


def storage_of(bag: Path, wanted: str | None) -> Literal['mcap', 'sqlite3']:
    """The storage that is asked for, else the one of the suffix, else mcap."""
    if wanted == 'sqlite3' or (wanted is None and bag.suffix in SQLITE_SUFFIXES):
        return 'sqlite3'
    return 'mcap'


def _read_carmen(args: argparse.Namespace) -> tuple[Recording, dict[str, int]]:
    fov = None if args.field_of_view is None else math.radians(args.field_of_view)
    log = carmen.read_carmen(args.log, args.max_range, fov, args.strict)
    if log.first_error:
        print(
            f'rlml: {log.counts["broken"]} broken lines left out, the first: {log.first_error}',
            file=sys.stderr,
        )
    if log.set_back > SECOND:
        print(
            'rlml: the clock of the scans was set back, by '
            f'{log.set_back / SECOND:.1f} s at most: what it calls the same time is mixed up',
            file=sys.stderr,
        )
    sensors = {carmen.LASER_FRAME: log.T_base_laser}
    return Recording(log.odometry, log.scans, sensors=sensors), dict(log.counts)


def write_recording(
    path: Path, recording: Recording, storage: Literal['mcap', 'sqlite3'] = 'mcap'
) -> dict[str, int]:
    """Write a bag in the order of stamps; the number of messages of each topic."""
    counts: dict[str, int] = {}
    with BagWriter(path, storage) as bag:
        if recording.sensors:
            bag.add_topic('/tf_static', 'tf2_msgs/msg/TFMessage', latched=True)
        if recording.true_reflectors is not None:
            bag.add_topic(f'/{TRUE_REFLECTORS}', 'sensor_msgs/msg/PointCloud2', latched=True)
        for stamp, topic, message in sorted(_messages(recording), key=lambda m: m[0]):
            bag.write(topic, message, stamp)
            counts[topic] = counts.get(topic, 0) + 1
    return counts


def _messages(recording: Recording) -> Iterator[tuple[int, str, Any]]:
    """(stamp, topic, message), odometry before what was measured at the same stamp."""
    streams = (recording.odometry, recording.scans, recording.detections)
    start = min(items[0].stamp for items in streams if items)
    if recording.sensors:
        transforms = [
            encode.transform(make_bag, start, (BASE, frame), T)
            for frame, T in recording.sensors.items()
        ]
        yield start, '/tf_static', encode.tf_message(make_bag, transforms)
    if recording.true_reflectors is not None:
        cloud = encode.detections(make_bag, recording.true_reflectors)
        yield start, f'/{TRUE_REFLECTORS}', cloud
    none = np.zeros((3, 3))
    for o in recording.odometry:
        yield (o.stamp, '/odom', encode.odometry(make_bag, o.stamp, (ODOM, BASE), o.pose, none))
    for s in recording.scans:
        yield s.stamp, '/scan', encode.laser_scan(make_bag, s)
    for d in recording.detections:
        yield d.stamp, '/reflectors', encode.detections(make_bag, d)
    if recording.truth is not None:
        for stamp, pose in zip(recording.truth.stamps, recording.truth.poses, strict=True):
            yield int(stamp), '/ground_truth', _truth(int(stamp), pose)


def _truth(stamp: int, pose: Array) -> Any:
    """Odometry, or a PointStamped where the heading is not known."""
    if np.isfinite(pose[2]):
        return encode.odometry(make_bag, stamp, (WORLD, BASE), pose, np.zeros((3, 3)))
    return make_bag(
        'geometry_msgs/msg/PointStamped',
        header=encode.header(make_bag, stamp, WORLD),
        point=encode.vector(make_bag, pose[0], pose[1], 0.0, 'Point'),
    )
