# SPDX-License-Identifier: Apache-2.0
"""``rlml check``: a running robot, heard for ten seconds: what is there, and what is wrong."""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rlml_slam.cli.main import between
from rlml_slam.cli.support.robot_setup import Finding, RobotSetup
from rlml_slam.cli.support.service_call import asking, domain, others
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.params import Node, Parameters, from_mapping, read_yaml
from rlml_slam.ros.sensor_input import STREAMS
from rlml_slam.ros.tf import TF_MESSAGE

STATIC = 'tf_static'
CLOCK = 'rosgraph_msgs/msg/Clock'


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml check``."""
    parser = subparsers.add_parser(
        'check',
        help='a running robot: topics, transforms and clocks, and what is wrong',
        description='Listens for a while, and says what is missing or wrong with the line to '
        'type. Turn the robot meanwhile: then the mounting of the laser is checked as well. '
        'Exit code 0: nothing is wrong, 1: something is.',
    )
    parser.add_argument(
        '--seconds', type=between(0.1, 1e5), default=10.0, metavar='S', help='to listen'
    )
    parser.add_argument('--config', type=Path, metavar='YAML', help='ROS parameter file')
    parser.add_argument(
        '--scan', metavar='TOPIC', help='of the scans (default: the parameter scan_topic)'
    )
    parser.add_argument('--namespace', metavar='NS', help='of the topics (default: none)')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Listen, and say what was heard."""
    values = read_yaml(args.config) if args.config else {}
    values |= {'scan_topic': args.scan} if args.scan else {}
    params: Parameters = from_mapping(values)
    setup = RobotSetup(params)
    with asking(args.namespace) as node:
        topics = topics_of(node, params.node)
        listen(node, setup, topics, args.seconds)
        findings = [*of_nobody(node, setup)] or [
            *of_names(node),
            *of_publishers(node, setup, topics),
            *setup.findings(),
        ]
        rows = [row(node, stream, topic, setup) for stream, (topic, _) in topics.items()]
    wrong = [f for f in findings if f.is_wrong]
    if args.json:
        print(json.dumps({'topics': rows, 'findings': [vars(f) for f in findings]}))
    else:
        print('\n'.join(words(rows, findings)))
    return 1 if wrong else 0


def topics_of(node: Any, n: Node) -> dict[str, tuple[str, str]]:
    """Full name and type of the topic of each stream."""
    chosen = [('tf', '/tf', TF_MESSAGE), (STATIC, '/tf_static', TF_MESSAGE)]
    for stream in ('reflectors', 'imu', 'odom', 'scan'):
        parameter, kind, *_ = STREAMS[stream]
        chosen.insert(0, (stream, getattr(n, parameter), kind))
    return {stream: (node.resolve_topic_name(name), kind) for stream, name, kind in chosen}


def listen(
    node: Any, setup: RobotSetup, topics: dict[str, tuple[str, str]], seconds: float
) -> None:
    """Hear all topics for a while; by /clock where a bag or a simulator publishes it."""
    import rclpy
    from rclpy.parameter import Parameter
    from rclpy.qos import DurabilityPolicy, QoSProfile

    from rlml_slam.ros.codecs.message_types import rclpy_class
    from rlml_slam.ros.message_guard import LARGE, Listener
    from rlml_slam.ros.sensors import MOTION, SENSOR

    own = [0]  # [ns] time of a simulator in the namespace, whose /clock is remapped
    remapped = set[str]()  # streams of the namespace, which /tf of other robots are not
    keep, latched = [], QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for stream, (topic, kind) in topics.items():
        found = rclpy_class(kind)
        if found is None:
            continue
        qos = latched if stream == STATIC else SENSOR if stream == 'scan' else MOTION

        def take(msg: Any, stream: str = stream, is_own: bool = False) -> None:
            if is_own:
                remapped.add(stream)
            elif stream in remapped:
                return
            simulated = own[0] or node.get_clock().now().nanoseconds
            setup.hear(stream, msg, time.monotonic(), simulated)

        keep.append(Listener(node, found, topic, take, qos, LARGE))
        if stream in ('tf', STATIC) and node.get_namespace() != '/':  # where it is remapped
            keep.append(Listener(node, found, stream, partial(take, is_own=True), qos, LARGE))

    def keep_time(msg: Any) -> None:
        own[0] = msg.clock.sec * 10**9 + msg.clock.nanosec

    if node.get_namespace() != '/':
        keep.append(Listener(node, rclpy_class(CLOCK), 'clock', keep_time, SENSOR, LARGE))
    end = time.monotonic() + seconds
    is_simulated = False
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
        if not is_simulated and node.count_publishers('/clock'):
            node.set_parameters([Parameter('use_sim_time', value=True)])
            is_simulated = True


def of_nobody(node: Any, setup: RobotSetup) -> Iterator[Finding]:
    """Nothing runs here, or is seen from here."""
    if not others(node) and not setup.heard:
        yield Finding(
            f'no node is seen in ROS_DOMAIN_ID {domain()}',
            'start the robot; or export ROS_DOMAIN_ID=<as on the robot>',
        )


def of_names(node: Any) -> Iterator[Finding]:
    """Nodes that have one name, of which services reach any."""
    for name, count in Counter(full for full, _, _ in others(node)).items():
        if count > 1:
            yield Finding(
                f'{count} nodes have the name {name}: is it started twice?',
                'stop one, or -r __ns:=/r2 for a second robot',
            )


def of_publishers(
    node: Any, setup: RobotSetup, topics: dict[str, tuple[str, str]]
) -> Iterator[Finding]:
    """Sensors that two nodes publish, types and qualities of service that do not fit."""
    for stream, (topic, kind) in topics.items():
        found = node.get_publishers_info_by_topic(topic)
        if stream in ('odom', 'imu', 'scan') and len(found) > 1:
            yield Finding(
                f'{topic} has {len(found)} publishers: {", ".join(map(name_of, found))}',
                f'ros2 topic info {topic} --verbose; stop one of them, or remap it',
            )
        for publisher in found:
            if publisher.topic_type != kind:
                yield Finding(f'{topic} of {name_of(publisher)} is a {publisher.topic_type}')
            if stream == STATIC and publisher.qos_profile.durability.name == 'VOLATILE':
                yield Finding(
                    f'{topic} of {name_of(publisher)} is not latched (durability volatile): '
                    'who comes later hears nothing of it',
                    'ros2 run tf2_ros static_transform_publisher, which latches',
                )
            yield from refused_by(node, topic, publisher)
        if stream == 'scan' and not setup.heard[stream].arrivals:
            others = [
                t
                for t, kinds in node.get_topic_names_and_types()
                if kind in kinds and t != topic and node.count_publishers(t)
            ]
            if others:
                yield Finding(
                    f'scans are on {", ".join(sorted(others))}, not on {topic}',
                    f'-p scan_topic:={sorted(others)[0]}',
                )


def refused_by(node: Any, topic: str, publisher: Any) -> Iterator[Finding]:
    """Who listens reliably to one that publishes with best effort: it hears nothing."""
    if publisher.qos_profile.reliability.name != 'BEST_EFFORT':
        return
    for listener in node.get_subscriptions_info_by_topic(topic):
        if listener.qos_profile.reliability.name == 'RELIABLE':
            yield Finding(
                f'{name_of(listener)} asks for reliable {topic}, and {name_of(publisher)} gives '
                'best effort: it hears nothing',
                f'set the reliability of {topic} in {name_of(listener)} to best_effort',
            )


def name_of(endpoint: Any) -> str:
    """Full name of the node of an endpoint."""
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'


def row(node: Any, stream: str, topic: str, setup: RobotSetup) -> dict[str, Any]:
    """What was heard on a topic."""
    heard = setup.heard[stream]
    found = node.get_publishers_info_by_topic(topic)
    return {
        'topic': topic,
        'publishers': sorted(map(name_of, found)),
        'reliability': sorted({p.qos_profile.reliability.name.lower() for p in found}),
        'messages': len(heard.arrivals),
        'rate_hz': round(heard.rate, 1),
        'age_ms': round(1e3 * heard.age) if heard.ages else None,
        'frames': sorted(heard.frames)[:8],
    }


def words(rows: list[dict[str, Any]], findings: list[Finding]) -> list[str]:
    """The table of topics, then the findings with the line to type."""
    cells = [['topic', 'of', 'Hz', 'age [ms]', 'QoS', 'frames']]
    for r in rows:
        cells.append([
            r['topic'], ', '.join(r['publishers']) or 'nobody', f'{r["rate_hz"]:g}',
            '' if r['age_ms'] is None else str(r['age_ms']), ', '.join(r['reliability']),
            ', '.join(r['frames']),
        ])  # fmt: skip
    out = [aligned(cells), '']
    for f in sorted(findings, key=lambda f: not f.is_wrong):
        out.append(f'{"WRONG" if f.is_wrong else "note"}: {f.text}')
        out += [f'       {f.line}'] if f.line else []
    if not any(f.is_wrong for f in findings):
        out.append('nothing is wrong')
    return out
