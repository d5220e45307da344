# SPDX-License-Identifier: Apache-2.0
"""``rlml live``: a bag played to the live nodes; what replay does, but over DDS and in time."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.live_session import LISTENERS, Source, drive
from rlml_slam.evaluation.run_record import Origin
from rlml_slam.params import Parameters, Player, changed, from_mapping, read_yaml
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.recordings.origin import source_of
from rlml_slam.report.outputs import make_folder, write_outputs
from rlml_slam.report.summary import print_summary
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs.decode import frame
from rlml_slam.ros.sensor_input import PLACED, STREAMS


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml live``."""
    parser = subparsers.add_parser('live', help='play a bag to the live nodes, then a report')
    parser.add_argument('bag', metavar='BAG', type=Path, help='as for replay')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='results go here')
    parser.add_argument('--config', metavar='YAML', type=Path, help='ROS parameter file')
    parser.add_argument(
        '--rate', type=float, default=1.0, metavar='X',
        help='seconds of the recording per second (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--mcap', metavar='FILE', type=Path,
        help='inputs and all that the nodes publish as one file for Foxglove, RViz and others',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print metrics.json and no more')


def run(args: argparse.Namespace) -> int:
    """Play, listen, write the results, and say what they are."""
    params = from_mapping(read_yaml(args.config)) if args.config else Parameters()
    # a wrong value is refused here, before three processes start
    Player(bag=str(args.bag), rate=args.rate)
    with BagReader(args.bag) as bag:
        inputs = BagInputs(bag, params)
        truth = inputs.truth()
        played = source(args, params, bag, inputs)
    out = make_folder(args.out)
    result = drive(played, out, args.json)
    result.truth = truth
    result.origin = Origin(args.command_line, changed(params), source_of(args.bag))
    return print_summary(result, write_outputs(result, out), out, args.json)


def source(
    args: argparse.Namespace, params: Parameters, bag: BagReader, inputs: BagInputs
) -> Source:
    """The bag in the place of a robot."""
    duration = max(1e-9 * (bag.end - bag.start), 1e-3)
    # nodes listen to the topics that replay takes, and to its frames
    system: dict[str, Any] = {STREAMS[s][0]: topic for s, topic in inputs.topics.items()}
    system |= {f: getattr(inputs.params.node, f) for f in ('odom_frame', 'base_frame')}
    sensor = next(s for s in PLACED if s in inputs.topics)
    system |= sensor_place(bag, inputs, inputs.topics[sensor])
    return Source(
        f'{Path(args.bag).resolve().name}, live',
        'bag_player',
        {
            'bag': Path(args.bag).resolve(), 'rate': float(args.rate),
            'wait_for_subscribers': LISTENERS, 'wait_for_topic': inputs.topics[sensor],
        },
        lambda recorder: recorder.elapsed() / duration,
        system,
        args.config,
        (inputs.topics[sensor], STREAMS[sensor][1]),
        # a survey and a map to localize in are in the map_directory of the parameter file
        keeps_map=not (
            params.back_end.survey or params.node.continue_map or params.node.mode != 'mapping'
        ),
        mcap=args.mcap,
        inputs={t: bag.topics[t].msgtype for t in inputs.shown()},
    )  # fmt: skip


def sensor_place(bag: BagReader, inputs: BagInputs, topic: str) -> dict[str, Any]:
    """Parameters for where a topic's sensor sits, for nodes that have no tf2_msgs to hear it."""
    for _, _, message in bag.messages([topic]):
        ends = inputs.params.node.base_frame, frame(message.header.frame_id)
        pose = inputs.extrinsics.pose(*ends)
        if pose is None:
            break
        place = [float(v) for v in pose]
        return {'laser_pose': place, 'laser_upside_down': inputs.extrinsics.hangs(*ends)}
    return {'laser_pose': list(inputs.params.node.laser_pose)}
