# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab pictures``: the pictures of the documentation, from pages in a headless Chromium.

``demo``: the live page while the demo drives, and its report. ``incident``: the black box of a
robot that was carried away. ``intel``: the report of Intel Research Lab.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import csv
import io
import json
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

from PIL import Image
from tornado.httpclient import AsyncHTTPClient
from tornado.websocket import websocket_connect

from rlml_lab.live.study_incidents import drive
from rlml_slam.cli.main import main as rlml
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.errors import RlmlError
from rlml_slam.types import Level

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / 'shared' / 'data'
INTEL = Path('slam-benchmark') / 'intel' / 'intel.rebuilt.log.xz'
PARTS = ('demo', 'incident', 'intel')
BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
OPTIONS = ('--headless=new', '--no-sandbox', '--disable-gpu', '--hide-scrollbars')
SIZE = (1280, 1260)  # [pixels] of a window: the head of a page and its map
DRAWN = 12.0  # [s] after which a page has been drawn
WATCHED = 22.0  # [s] of the demo before the live page is opened
END = 300.0  # [s] for the demo
SEED = 0  # of the robot that is carried away


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare ``rlml-lab pictures``."""
    parser = subparsers.add_parser(
        'pictures', help='the pictures of the documentation, by Chromium'
    )
    parser.add_argument('--only', choices=PARTS, nargs='+', default=PARTS)
    parser.add_argument('--out', type=Path, default=ROOT / 'docs', metavar='DIR')
    parser.add_argument(
        '--data', type=Path, default=DATA, metavar='DIR', help='default: ../shared/data'
    )


def run(args: argparse.Namespace) -> int:
    """Make them; what cannot be made is said."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise RlmlError('pictures need Chromium: apt-get install chromium')
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='rlml_pictures_') as name:
        folder = Path(name)
        if 'demo' in args.only:
            demo(browser, folder, args.out)
        if 'incident' in args.only:
            incident(browser, folder, args.out)
        if 'intel' in args.only:
            log = args.data / INTEL
            if log.exists():
                intel(browser, folder, log, args.out)
            else:
                print(f'intel.png is left as it is: there is no {log}')
    return 0


def demo(browser: str, folder: Path, out: Path) -> None:
    """The live page while the robot drives, and the report."""
    environment = {
        'ROS_DOMAIN_ID': str(free_domain()), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }  # fmt: skip
    with socket.create_server(('127.0.0.1', 0)) as probe:
        port = probe.getsockname()[1]
    with Processes(folder / 'log', environment) as processes:
        arguments = ['demo', '--out', str(folder / 'demo'), '--view', str(port)]
        processes.start('demo', ['rlml_slam', *arguments])
        end = time.monotonic() + END
        while not _answers(port):
            processes.check('demo')
            time.sleep(0.5)
        time.sleep(WATCHED)
        take(browser, f'http://127.0.0.1:{port}/', out / 'live.png')
        while not processes.has_ended('demo'):
            if time.monotonic() > end:
                raise RlmlError(f'the demo takes longer than {END:.0f} s')
            time.sleep(0.5)
    take_report(browser, folder / 'demo', out / 'report.png', half(folder / 'demo'))


def incident(browser: str, folder: Path, out: Path) -> None:
    """The replay of the incident of a robot that is carried away, when it is LOST."""
    _rlml('replay', ROOT / 'bags' / 'room', '--out', folder / 'room')
    file = folder / 'room' / 'map.rlml'
    (found,) = drive(folder / 'carried', file, SEED, 1.0)
    _rlml('replay', found, '--map', file, '--out', folder / 'incident')
    with (folder / 'incident' / 'health.csv').open(encoding='utf-8', newline='') as f:
        rows = list(csv.DictReader(f))
    lost = [float(row['stamp_s']) for row in rows if row['level'] == Level.LOST.name]
    if not lost:
        raise RlmlError('the incident has no frame that is LOST')
    first = float(rows[0]['stamp_s'])
    take_report(browser, folder / 'incident', out / 'incident.png', lost[0] - first)


def intel(browser: str, folder: Path, log: Path, out: Path) -> None:
    """The map of Intel Research Lab."""
    _rlml('convert', 'carmen', log, folder / 'intel')
    _rlml('replay', folder / 'intel', '--out', folder / 'replay')
    take_report(browser, folder / 'replay', out / 'intel.png', half(folder / 'replay'))


def half(folder: Path) -> float:
    """Half of the time [s] of a run."""
    metrics = json.loads((folder / 'metrics.json').read_text(encoding='utf-8'))
    return 0.5 * float(metrics['duration_s'])


def take_report(browser: str, folder: Path, picture: Path, at: float) -> None:
    """A report with its cursor at a time [s]."""
    url = f'{(folder / "report.html").as_uri()}#t={at:.2f}'
    take(browser, url, picture)


def take(browser: str, url: str, picture: Path) -> None:
    """A picture of a page that has been drawn."""
    with tempfile.TemporaryDirectory(prefix='chromium_', ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [
                browser, *OPTIONS, f'--user-data-dir={profile}', '--remote-debugging-port=0',
                f'--window-size={SIZE[0]},{SIZE[1]}', url,
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            time.sleep(DRAWN)
            port = int((Path(profile) / 'DevToolsActivePort').read_text().split()[0])
            data = asyncio.run(_screenshot(port))
        finally:
            process.terminate()
            process.wait()
    with Image.open(io.BytesIO(data)) as image:
        image.convert('RGB').save(picture, optimize=True)
    print(f'{picture}: {picture.stat().st_size / 1e3:.0f} kB', flush=True)


async def _screenshot(port: int) -> bytes:
    """PNG of the page of a Chromium that is asked by its DevTools protocol."""
    found = await AsyncHTTPClient().fetch(f'http://127.0.0.1:{port}/json/list')
    page = next(t for t in json.loads(found.body) if t['type'] == 'page')
    socket_url = page['webSocketDebuggerUrl']
    connection = await websocket_connect(socket_url, max_message_size=1 << 28)
    await connection.write_message(json.dumps({'id': 1, 'method': 'Page.captureScreenshot'}))
    text = await connection.read_message()
    connection.close()
    if text is None:
        raise RlmlError('Chromium has ended')
    return base64.b64decode(json.loads(text)['result']['data'])


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f'http://127.0.0.1:{port}/', timeout=1.0):
            return True
    except OSError:
        return False


def _rlml(*words: str | Path) -> None:
    if rlml([*map(str, words), '--json']) != 0:
        raise RlmlError(f'failed: rlml {" ".join(map(str, words))}')
