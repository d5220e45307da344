# SPDX-License-Identifier: Apache-2.0
"""The whole map of a running back end, as a replay has it at its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from rlml_slam.errors import RlmlError
from rlml_slam.evaluation.run_record import Run
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_table import closure_table
from rlml_slam.slam.store import map_file

PATIENCE = 30.0  # [s] in which it answers: it may have keyframes to work off
NAME = 'map'


def save(node: Any, executor: SingleThreadedExecutor, check: Callable[[], None]) -> str:
    """Have the back end write its map into its map_directory; why it did not, or nothing.

    ``check`` is called while it takes, and may raise.
    """
    client = node.create_client(Trigger, 'back_end/save_map')
    deadline = time.monotonic() + PATIENCE
    while not client.service_is_ready() and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.1)
        check()
    future = client.call_async(Trigger.Request())
    deadline = time.monotonic() + PATIENCE
    while not future.done() and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.1)
        check()
    if not future.done():
        future.cancel()
        return f'the map was not saved: no answer of the back end within {PATIENCE:g} s'
    answer = future.result()
    return '' if answer.success else f'the map was not saved: {answer.message}'


def take(run: Run, folder: Path) -> str:
    """Add the map that was saved into a folder, and its tables, to a run; else the problem."""
    try:
        _take(run, folder)
    except RlmlError as e:
        return f'the map that was saved cannot be read: {e}'
    return ''


def _take(run: Run, folder: Path) -> None:
    run.stored = map_file.load(folder / f'{NAME}.rlml')
    back_end = BackEnd(map_file.parameters_of(run.stored))
    map_file.restore(run.stored, back_end)
    run.closure_table = closure_table(back_end.loop_closer.records)
    run.reflector_states = tuple(back_end.reflector_states())
