# SPDX-License-Identifier: Apache-2.0
"""``rlml call``: services and ``initialpose`` of a running node, where there is no ROS."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import re
import time
from typing import Any

import numpy as np

from rlml_slam.cli.support.service_call import PATIENCE, answer_of, asking, client_of, message_of
from rlml_slam.errors import InputError

POSE, SET = 'initialpose', 'set'
NAME = 'map_file_name'  # the parameter with the name under which a map is saved
RVIZ = np.diag([0.25, 0.25, 0.0685])  # [m², m², rad²]: covariance of its "2D Pose Estimate"
SWITCH = {'on': True, 'off': False}
# service -> type, and the field of its request that takes the argument
SERVICES = {
    'save_map': ('std_srvs', 'Trigger', None),
    'load_map': ('nav_msgs', 'LoadMap', 'map_url'),
    'save_incident': ('std_srvs', 'Trigger', None),
    'reset': ('std_srvs', 'Trigger', None),
    'relocalize': ('std_srvs', 'Trigger', None),
    'set_localization_mode': ('std_srvs', 'SetBool', 'data'),
    'pause_new_measurements': ('std_srvs', 'SetBool', 'data'),
}


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml call``."""
    parser = subparsers.add_parser(
        'call',
        help='a service of a running node: save_map, relocalize and so on',
        description='Calls a service of a running node and prints its answer.',
    )
    names = [*SERVICES, POSE, SET]
    # -1,2,90 is no option: Python 3.14 reads it so
    parser._negative_number_matcher = re.compile(r'-\.?\d')
    parser.add_argument('service', metavar='SERVICE', choices=names, help=', '.join(names))
    parser.add_argument(
        'argument', metavar='ARGUMENT', nargs='?',
        help='of load_map the name of a map, which save_map takes as well, to save under another '
        'one from then on; of the two that switch something on or off; of initialpose x,y,angle '
        '[m, degrees]; of set NAME=VALUE, a parameter that may change while the node runs',
    )  # fmt: skip
    parser.add_argument(
        '--node', metavar='NAME',
        help='the running node (default: /back_end, of save_incident and initialpose '
        '/front_end)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Call it and print what it says."""
    if args.service == POSE:
        print(give_pose(args.node or '/front_end', args.argument or ''))
        return 0
    if args.service == SET:
        parameter, equals, text = (args.argument or '').partition('=')
        if not equals:
            raise InputError(f'set: {args.argument or ""!r} is no NAME=VALUE')
        with asking() as asker:
            before = set_parameter(asker, args.node or '/back_end', parameter, text)
        print(f'{parameter}: {before} -> {text}')
        return 0
    package, name, field = SERVICES[args.service]
    fields = {} if field is None else {field: value_of(args.service, field, args.argument)}
    if field is None and args.argument is not None and args.service != 'save_map':
        raise InputError(f'{args.service} takes no argument')
    node = args.node or ('/front_end' if args.service == 'save_incident' else '/back_end')
    kind = getattr(importlib.import_module(f'{package}.srv'), name)
    with asking() as asker:
        renames = args.service == 'save_map' and args.argument is not None
        if renames:
            client_of(asker, node, args.service, kind)  # no other name where nothing is saved
        before = set_parameter(asker, node, NAME, args.argument) if renames else ''
        answer = answer_of(asker, node, args.service, kind, fields)
        if renames and not answer.success:
            with contextlib.suppress(InputError):  # what it was refused for is said below
                set_parameter(asker, node, NAME, before)
        if name != 'LoadMap':
            print(message_of(answer))
        elif answer.result != kind.Response.RESULT_SUCCESS:
            raise InputError(f'load_map: {answer.map.header.frame_id}')
        else:
            print(f'{args.argument}: loaded')
    return 0


def give_pose(node: str, argument: str) -> str:
    """Publish where the robot is; InputError where it is no pose, or nobody listens."""
    from rclpy.duration import Duration

    from rlml_slam.ros.codecs.encode import pose_with_covariance
    from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class

    try:
        x, y, degrees = (float(word) for word in argument.split(','))
    except ValueError:
        x = y = degrees = np.nan
    if not np.isfinite([x, y, degrees]).all():
        raise InputError(f'{POSE}: {argument!r} is no x,y,angle [m, degrees]')
    message = pose_with_covariance(make_rclpy, 0, '', np.array([x, y, np.radians(degrees)]), RVIZ)
    topic = '/'.join(['', *node.strip('/').split('/')[:-1], POSE])
    with asking() as asker:
        publisher = asker.create_publisher(
            rclpy_class('geometry_msgs/msg/PoseWithCovarianceStamped'), topic, 10
        )
        end = time.monotonic() + PATIENCE
        while not publisher.get_subscription_count():
            if time.monotonic() > end:
                raise InputError(f'{topic}: nobody listens')
            time.sleep(0.05)
        publisher.publish(message)
        publisher.wait_for_all_acked(Duration(seconds=PATIENCE))
    return f'{topic}: x = {x:g} m, y = {y:g} m, {degrees:g} degrees: sent'


def set_parameter(asker: Any, node: str, name: str, text: str) -> str:
    """Set a parameter from the words of its value; those of the one before.

    InputError where the node has none of that name, or refuses it.
    """
    from rcl_interfaces.srv import GetParameters, SetParameters
    from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python

    asked = {'names': [name]}
    (before,) = answer_of(asker, node, 'get_parameters', GetParameters, asked).values or (None,)
    kind = Parameter.Type.NOT_SET if before is None else Parameter.Type(before.type)
    if kind == Parameter.Type.NOT_SET:
        raise InputError(f'{node} has no parameter {name!r}')
    value: Any = text
    try:
        if kind == Parameter.Type.DOUBLE:
            value = float(text)
        elif kind != Parameter.Type.STRING:
            value = parameter_value_to_python(get_parameter_value(text))
    except Exception as e:  # of whatever reads YAML there
        raise InputError(f'{name}: {text!r} is no value of it') from e
    given = [Parameter(name, value=value).to_parameter_msg()]
    answer = answer_of(asker, node, 'set_parameters', SetParameters, {'parameters': given})
    if not answer.results[0].successful:
        why = str(answer.results[0].reason)
        raise InputError(why if name in why else f'{name}: {why}')
    return str(parameter_value_to_python(before))


def value_of(service: str, field: str, argument: str | None) -> str | bool:
    """The argument as the request has it; InputError where it is none."""
    if argument is None:
        raise InputError(f'{service} needs an argument')
    if field == 'map_url':
        return argument
    if argument not in SWITCH:
        raise InputError(f'{service}: {argument!r} is neither on nor off')
    return SWITCH[argument]
