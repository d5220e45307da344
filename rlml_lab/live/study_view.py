# SPDX-License-Identifier: Apache-2.0
"""``study view``: `rlml view` beside a live drive, with many browsers and one that hangs.

Prints frames per second, how many of the laser's scans a browser did not get, the time from a
frame's arrival in the viewer to its arrival in a browser, and the viewer's share of a core. Two
frames that become ready at once share a message. The browsers are WebSocket clients that draw
nothing.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import socket
import tempfile
import time
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tornado.websocket import websocket_connect

from rlml_slam.cli.support.live_session import node
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.params import Laser, Simulator

Heard: TypeAlias = tuple[float, list[float]]

SETTLE = 5.0  # [s] before anything is counted
HANDSHAKE = (
    'GET /messages HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n'
    'Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n'
    'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n'
)


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study view``."""
    parser = subparsers.add_parser('view', help='cost and latency of the live viewer')
    parser.add_argument('--browsers', type=int, default=10, help='default: %(default)s')
    parser.add_argument('--seconds', type=float, default=30.0, help='default: %(default)s')


def run(args: argparse.Namespace) -> int:
    """Drive, watch, and print the figures; 1 where one is missed."""
    domain = {
        'ROS_DOMAIN_ID': str(free_domain()), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }  # fmt: skip
    with socket.create_server(('127.0.0.1', 0)) as probe:
        port = probe.getsockname()[1]
    with (
        tempfile.TemporaryDirectory(prefix='rlml_view_') as folder,
        Processes(Path(folder), domain) as processes,
    ):
        values = {'laser_pose': list(Simulator().laser_pose), 'map_directory': folder}
        processes.start('view', ['rlml_slam', 'view', '--port', str(port)])
        processes.start('slam', node('slam', values | {'map_update_interval': 1.0}))
        processes.start('simulator', node('simulator', {'repeat': 'true'}))
        found = asyncio.run(watch(processes, port, args))
    print(json.dumps(found))
    good = found['lost'] == 0 and found['per_second'] >= 10.0 and found['core_share'] < 0.1
    return int(not (good and found['latency_p99_ms'] <= 300.0))


async def watch(processes: Processes, port: int, args: argparse.Namespace) -> dict[str, float]:
    """The figures of so many seconds, from the first frame on."""
    sockets: list[Any] = []
    while len(sockets) < args.browsers:
        try:
            sockets.append(await websocket_connect(f'ws://127.0.0.1:{port}/messages'))
        except OSError:
            processes.check('view', 'slam', 'simulator')
            await asyncio.sleep(0.2)
    with socket.create_connection(('127.0.0.1', port)) as hanging:  # which never reads
        hanging.sendall(HANDSHAKE.format(port=port).encode())
        await _frame(sockets[0])
        # they read from the beginning: what waits for a reader is not the viewer's latency
        settled = time.monotonic() + SETTLE
        await asyncio.gather(*(_listen(s, settled) for s in sockets))
        before, began = processes.usage('view'), time.monotonic()
        until = began + args.seconds
        each = await asyncio.gather(*(_listen(s, until) for s in sockets))
        after, elapsed = processes.usage('view'), time.monotonic() - began
    for s in sockets:
        s.close()
    assert before is not None
    assert after is not None
    latency = np.array([ms for heard in each for ms, _ in heard])
    frames = [[t for _, of in heard for t in of] for heard in each]
    rate = Laser().rate
    lost = [round((of[-1] - of[0]) * rate) + 1 - len(of) for of in frames]
    return {
        'browsers': args.browsers,
        'per_second': round(min(len(of) for of in frames) / elapsed, 1),
        'lost': max(lost),
        'latency_median_ms': round(float(np.median(latency)), 1),
        'latency_p99_ms': round(float(np.percentile(latency, 99)), 1),
        'core_share': round((after.cpu_s - before.cpu_s) / elapsed, 4),
    }


async def _frame(browser: Any) -> Heard:
    """Latency [ms] and times [s] of the frames of the next message that has any."""
    while True:
        text = await browser.read_message()
        assert text is not None, 'the viewer has disconnected a browser'
        message = json.loads(text)
        if 'stamp' in message:
            return 1e3 * time.time() - message['stamp'], message['stream']['frames']['t']


async def _listen(browser: Any, until: float) -> list[Heard]:
    out = [await _frame(browser)]
    while time.monotonic() < until:
        out.append(await _frame(browser))
    return out
