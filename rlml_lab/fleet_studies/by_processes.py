# SPDX-License-Identifier: Apache-2.0
"""A fleet's replays by the command: scheduler, workers and client are processes of their own."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import rlml_lab
from rlml_lab.fleet_studies.fleet_bags import Fleet

WORKER_KILLS = 5
PATIENCE_S = 3600.0


def by_hand(fleet: Fleet) -> dict[str, Any]:
    """Scheduler and two workers are started first; the table is that of worker processes."""
    with cluster() as address:
        figures = finished(replay(fleet, 'by_hand', '--cluster', address))
    same = fleet.table('by_hand') == fleet.table('workers_1')
    return {'bags': figures['bags'], 'same_table': same, 'holds': same}


def kills(fleet: Fleet) -> dict[str, Any]:
    """Five times a worker is killed, then the client; a second run does the rest."""
    out, rng, n = fleet.out / 'kills', np.random.default_rng(0), len(fleet.jobs(fleet.out))
    client = replay(fleet, 'kills', '--jobs', '2')
    killed = 0
    # spread over the first part of the run; the client is killed after them
    for share in np.sort(rng.uniform(0.05, 0.6, WORKER_KILLS)):
        wait_for(client, lambda share=share: done(out) >= share * n)
        wait_for(client, lambda: workers_of(client.pid))
        os.kill(int(rng.choice(workers_of(client.pid))), signal.SIGKILL)
        killed += 1
    wait_for(client, lambda: done(out) >= 0.7 * n)
    client.kill()
    client.communicate()
    before = done(out)
    figures = finished(replay(fleet, 'kills', '--jobs', '2'))
    names = [p.parent for p in out.rglob('run.json')]
    same = fleet.table('kills') == fleet.table('workers_1')
    return {
        'bags': figures['bags'], 'workers_killed': killed, 'clients_killed': 1,
        'done_before': before, 'found_again': figures['found_again'],
        'lost': n - len(names), 'computed_twice': before - figures['found_again'],
        'same_table': same,
        'holds': same and len(names) == n and 0 < before == figures['found_again'] < n,
    }  # fmt: skip


def replay(fleet: Fleet, name: str, *options: str) -> subprocess.Popen[str]:
    """The command, as a process."""
    words = ['fleet', 'replay', str(fleet.bags), '--out', str(fleet.out / name), '--no-report']
    command = [sys.executable, '-m', 'rlml_lab', *words, '--json', *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())


def finished(client: subprocess.Popen[str]) -> dict[str, Any]:
    """What the command printed."""
    figures: dict[str, Any] = json.loads(client.communicate(timeout=PATIENCE_S)[0])
    return figures


def environment() -> dict[str, str]:
    """With this checkout first."""
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(
        [str(Path(rlml_lab.__file__).parents[1]), os.environ.get('PYTHONPATH', '')])}  # fmt: skip


@contextmanager
def cluster() -> Iterator[str]:
    """Scheduler and two workers on loopback, as somebody starts them by hand; the address."""
    with socket.create_server(('127.0.0.1', 0)) as s:
        port = s.getsockname()[1]
    address = f'tcp://127.0.0.1:{port}'
    dask = [sys.executable, '-m', 'dask']
    quiet: dict[str, Any] = {'stderr': subprocess.DEVNULL, 'env': environment()}
    place = ['--host', '127.0.0.1', '--port', str(port), '--dashboard-address', '127.0.0.1:0']
    scheduler = subprocess.Popen([*dask, 'scheduler', *place], **quiet)
    workers = subprocess.Popen(
        [*dask, 'worker', address, '--nworkers', '2', '--nthreads', '1', '--host', '127.0.0.1',
         '--dashboard-address', '127.0.0.1:0'], **quiet
    )  # fmt: skip
    try:
        yield address
    finally:
        for process in (workers, scheduler):  # workers wait for a scheduler that has ended
            process.terminate()
            process.wait(30.0)


def workers_of(client: int) -> list[int]:
    """Process ids of the workers of a client."""
    found = []
    for p in psutil.Process(client).children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it ends just now
            if 'spawn_main' in ' '.join(p.cmdline()):
                found.append(p.pid)
    return found


def done(out: Path) -> int:
    """Number of bags with results."""
    return sum(1 for _ in out.rglob('run.json'))


def wait_for(client: subprocess.Popen[str], predicate: Any) -> None:
    """Until it is true; RuntimeError where the client ends first."""
    while not predicate():
        if client.poll() is not None:
            raise RuntimeError(f'the client has ended: {client.returncode}')
        time.sleep(0.05)
