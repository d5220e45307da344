# SPDX-License-Identifier: Apache-2.0
"""Nodes that start in a moment: processes that fork from one that has imported everything.

Each is a process of its own, as one that was started by hand, but for the seconds of imports.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
from collections.abc import Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

from rlml_slam.cli.support.processes import LAST_LINES
from rlml_slam.errors import RlmlError

PRELOADED = ('rlml_slam.nodes.front_end', 'rlml_slam.nodes.back_end')
PATIENCE = 5.0  # [s] in which a node has to end after SIGTERM


class ForkedNodes:
    """Named nodes, as a context manager: whatever happens, none outlives it.

    The output of each goes to ``<folder>/<name>.log``, of all its starts.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder, self._environment = folder.resolve(), dict(environment)
        self._context = multiprocessing.get_context('forkserver')
        self._context.set_forkserver_preload([__name__, *PRELOADED])
        self._nodes: dict[str, BaseProcess] = {}
        self._folder.mkdir(parents=True, exist_ok=True)
        for old in self._folder.glob('*.log'):
            old.unlink()

    def __enter__(self) -> ForkedNodes:
        return self

    def __exit__(self, *_: object) -> None:
        for one in self._nodes.values():
            one.terminate()
        for one in self._nodes.values():
            one.join(PATIENCE)
            one.kill()
            one.join()

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Start ``python -m`` with the arguments."""
        words = (list(arguments), str(self._log(name)), self._environment)
        self._nodes[name] = self._context.Process(target=_run, args=words, daemon=True)
        self._nodes[name].start()

    def kill(self, *names: str) -> None:
        """End nodes at once, by SIGKILL."""
        for name in names:
            self._nodes[name].kill()
        for name in names:
            self._nodes[name].join()

    def check(self) -> None:
        """RlmlError, with its last words, if one of the nodes is not running any more."""
        for name, one in self._nodes.items():
            if not one.is_alive():
                text = self._log(name).read_text(encoding='utf-8', errors='replace')
                last = '\n'.join(text.splitlines()[-LAST_LINES:])
                raise RlmlError(f'{name} ended with exit code {one.exitcode}:\n{last}')

    def _log(self, name: str) -> Path:
        return self._folder / f'{name}.log'


def _run(arguments: list[str], log: str, environment: dict[str, str]) -> None:
    """In the new process: what ``python -m`` does."""
    os.environ.update(environment)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for number in (1, 2):
        os.dup2(file, number)
    sys.argv = arguments
    sys.exit(importlib.import_module(arguments[0]).main())
