# SPDX-License-Identifier: Apache-2.0
"""``rlml call``: the services of a running node, where no ``ros2`` is installed."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

from rlml_slam.cli.support.service_call import answer_of, asking, message_of
from rlml_slam.errors import InputError

PATIENCE = 3.0  # [s] for the next diagnostics, which come once a second
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
    parser.add_argument('service', metavar='SERVICE', choices=SERVICES, help=', '.join(SERVICES))
    parser.add_argument(
        'argument', metavar='ARGUMENT', nargs='?',
        help='of load_map the name of a map, which save_map takes as well, to save under another '
        'one; of the two that switch something on or off',
    )  # fmt: skip
    parser.add_argument(
        '--node', metavar='NAME',
        help='the running node (default: /back_end, of save_incident /front_end)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Call it and print what it says."""
    package, name, field = SERVICES[args.service]
    fields = {} if field is None else {field: value_of(args.service, field, args.argument)}
    if field is None and args.argument is not None and args.service != 'save_map':
        raise InputError(f'{args.service} takes no argument')
    node = args.node or ('/front_end' if args.service == 'save_incident' else '/back_end')
    kind = getattr(importlib.import_module(f'{package}.srv'), name)
    with asking() as asker:
        if args.service == 'save_map' and args.argument is not None:
            rename(asker, node, args.argument)
        answer = answer_of(asker, node, args.service, kind, fields)
        if name != 'LoadMap':
            print(message_of(answer))
        elif answer.result != kind.Response.RESULT_SUCCESS:
            raise InputError(f'load_map: {answer.map.header.frame_id}')
        else:
            print(f'{args.argument}: loaded')
    return 0


def rename(asker: Any, node: str, name: str) -> None:
    """Save under another name from now on; InputError where the node refuses it."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    given = [Parameter('map_file_name', value=name).to_parameter_msg()]
    answer = answer_of(asker, node, 'set_parameters', SetParameters, {'parameters': given})
    if not answer.results[0].successful:
        raise InputError(answer.results[0].reason)


def value_of(service: str, field: str, argument: str | None) -> str | bool:
    """The argument as the request has it; InputError where it is none."""
    if argument is None:
        raise InputError(f'{service} needs an argument')
    if field == 'map_url':
        return argument
    if argument not in SWITCH:
        raise InputError(f'{service}: {argument!r} is neither on nor off')
    return SWITCH[argument]
