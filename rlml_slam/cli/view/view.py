# SPDX-License-Identifier: Apache-2.0
"""``rlml view``: the page of the report, live from running nodes."""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import signal
import socket
import time
from typing import Any

import rclpy
import rclpy.utilities
from rclpy.signals import SignalHandlerOptions
from tornado.httpserver import HTTPServer

from rlml_slam.cli.view.listener import ViewListener
from rlml_slam.cli.view.server import Browsers, application
from rlml_slam.errors import RlmlError
from rlml_slam.report.page import heading, page
from rlml_slam.report.viewer import viewer_page

PERIOD = 0.05  # [s] between looks at what has come
IDLE = 0.2  # [s] of the same while nobody watches
NICE = 10  # a viewer yields to whatever drives the robot


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml view``."""
    parser = subparsers.add_parser(
        'view',
        help='running nodes in a browser: map, plots and health, live',
        description='Serves the page of the report, live from running nodes. It only listens: no '
        'message, service or parameter can be sent through it. There is no password: with another '
        '--host than 127.0.0.1, everybody who reaches the port sees the map.',
    )
    parser.add_argument('--host', default='127.0.0.1', help='address (default: %(default)s)')
    parser.add_argument('--port', type=int, default=8080, help='default: %(default)s; 0: any')
    parser.add_argument(
        '--namespace', default='', metavar='NS', help='namespace of the nodes (default: none)'
    )


def run(args: argparse.Namespace) -> int:
    """Serve until it is interrupted."""
    family = socket.AF_INET6 if ':' in args.host else socket.AF_INET
    try:
        listening = socket.create_server((args.host, args.port), family=family)
    except (OSError, OverflowError) as e:
        raise RlmlError(f'{args.host}:{args.port} cannot be listened to: {e}') from e
    listening.setblocking(False)
    os.nice(NICE)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(
            'rlml_view', namespace=args.namespace, start_parameter_services=False
        )
        listener = ViewListener(node)
        browsers = Browsers(listener.snapshot)
        parts = viewer_page.parts()
        title = f'Live{args.namespace and " " + args.namespace}'
        text = page(title, [heading(title, 'From running nodes'), *parts], {}, viewer_page.head())
        port = listening.getsockname()[1]
        shown = f'[{args.host}]' if ':' in args.host else args.host
        print(f'look at http://{shown}:{port}/ (Ctrl-C ends it)', flush=True)
        gc.freeze()
        asyncio.run(_serve(listener, browsers, application(text, browsers, args.host), listening))
        node.destroy_node()
    finally:
        rclpy.utilities.try_shutdown()
        listening.close()
    return 0


async def _serve(
    listener: ViewListener, browsers: Browsers, app: Any, listening: socket.socket
) -> None:
    """Poll and send, until SIGINT or SIGTERM."""
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    server = HTTPServer(app)
    server.add_sockets([listening])
    while not ended.is_set():
        began = time.monotonic()
        message = listener.poll(bool(browsers.open))
        if message is not None:
            browsers.send(message)
        period = PERIOD if browsers.open else IDLE
        await asyncio.sleep(max(0.005, period - (time.monotonic() - began)))
    server.stop()
