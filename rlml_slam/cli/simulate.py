# SPDX-License-Identifier: Apache-2.0
"""``rlml simulate WORLD BAG``: a drive through a synthetic world, written as a bag."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from rlml_slam.errors import FileFormatError, ParameterError
from rlml_slam.params import SimulatorParameters, from_mapping, read_yaml
from rlml_slam.plain_yaml import parse_yaml
from rlml_slam.ros.bags.bag import BagWriter
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.ros.systems.simulator_messages import TOPICS, TRUE_REFLECTORS, SimulatedMessages
from rlml_slam.ros.tf import TF_MESSAGE
from rlml_slam.simulation.robot import SECOND
from rlml_slam.simulation.simulation import START, Simulation
from rlml_slam.simulation.world_file import load_world, world_names
from rlml_slam.types import Odometry


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand; it calls :func:`run`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        'simulate',
        help='write a bag of a drive through a synthetic world',
        description='Writes odometry, IMU, scans, reflector detections, the static transform and '
        'the ground truth of a simulated drive. The same arguments give the same bytes.',
    )
    worlds = ', '.join(world_names())
    parser.add_argument('world', metavar='WORLD', help=f'{worlds}, or a world file (.yaml)')
    parser.add_argument('bag', metavar='BAG', type=Path, help='folder to be written')
    parser.add_argument('--seed', type=int, help='seed of all noise')
    parser.add_argument('--duration', type=float, metavar='S', help='stop after S seconds')
    parser.add_argument(
        '--format', choices=('mcap', 'sqlite3'), default='mcap', help='storage of the bag'
    )
    parser.add_argument('--config', type=Path, metavar='YAML', help="the simulator's parameters")
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='one parameter, such as laser.beams=360 or markers.ids=true; may be repeated',
    )
    parser.add_argument(
        '--tf-only', action='store_true',
        help='as most robots record: of the sensors only the scans, odometry as odom to base_link '
        'on /tf, no reflectors',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')
    parser.set_defaults(run=run)
    return parser


def parameters_of(args: argparse.Namespace) -> SimulatorParameters:
    """The parameters of the file, then of --set, then of the other options."""
    values: dict[str, Any] = read_yaml(args.config, SimulatorParameters) if args.config else {}
    values.update(_assignment(text) for text in args.set)
    values['world'] = args.world
    for name in ('seed', 'duration'):
        if getattr(args, name) is not None:
            values[name] = getattr(args, name)
    parameters: SimulatorParameters = from_mapping(values, SimulatorParameters)
    n = parameters.node
    if n.duration == 0.0 and (n.repeat or n.drive == 'cmd_vel'):
        raise ParameterError('a bag of a drive without an end needs --duration')
    return parameters


def _assignment(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition('=')
    if not equals:
        raise ParameterError(f'--set {text}: is not NAME=VALUE')
    try:
        return name.strip(), parse_yaml(value, f'--set {text}')
    except FileFormatError as e:
        raise ParameterError(f'--set {text}: the value is not YAML') from e


def run(args: argparse.Namespace) -> int:
    """Write the bag and say what is in it."""
    parameters = parameters_of(args)
    simulation = Simulation(load_world(parameters.node.world), parameters)
    counts = write_bag(simulation, args.bag, args.format, args.tf_only)
    size = sum(f.stat().st_size for f in args.bag.iterdir())
    summary = {
        'bag': str(args.bag),
        'world': simulation.world.name,
        'seed': parameters.node.seed,
        'duration_s': (simulation.time - START) / SECOND,
        'bytes': size,
        'messages': counts,
    }
    if args.json:
        print(json.dumps(summary))
    else:
        listed = ', '.join(f'{n} {topic}' for topic, n in counts.items())
        print(f'{args.bag}: {summary["duration_s"]:.1f} s, {size / 1e6:.2f} MB; {listed}')
    return 0


def write_bag(
    simulation: Simulation, path: Path, storage: Any = 'mcap', tf_only: bool = False
) -> dict[str, int]:
    """Write the whole drive; the number of messages of each topic.

    With ``tf_only`` odometry is on /tf, and there are neither IMU nor detections.
    """
    convert = SimulatedMessages(make_bag, simulation.parameters)
    topics = {topic: kind for topic, (kind, _) in TOPICS.items()}
    if tf_only:
        topics = {t: topics[t] for t in ('scan', 'ground_truth')} | {'tf': TF_MESSAGE}
    counts: Counter[str] = Counter(dict.fromkeys(topics, 0))
    with BagWriter(path, storage) as bag:
        bag.add_topic('/tf_static', TF_MESSAGE, latched=True)
        bag.add_topic(f'/{TRUE_REFLECTORS}', 'sensor_msgs/msg/PointCloud2', latched=True)
        for topic, kind in topics.items():
            bag.add_topic(f'/{topic}', kind)
        bag.write('/tf_static', convert.laser_transform(), START)
        bag.write(f'/{TRUE_REFLECTORS}', convert.true_reflectors(simulation), START)
        for event in with_progress(simulation):
            if tf_only and isinstance(event.message, Odometry):
                topic, message = 'tf', convert.odom_transform(event.message)
            else:
                topic, message = convert(event.message)
            if topic in topics:
                bag.write(f'/{topic}', message, event.time)
                counts[topic] += 1
    return dict(counts)


def with_progress(simulation: Simulation) -> Iterable[Any]:
    """The simulation's events, with a bar on a terminal's standard error."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(f'simulating {simulation.world.name}', total=1.0)
        for k, event in enumerate(simulation):
            if k % 500 == 0:
                bar.update(task, completed=simulation.progress)
            yield event
