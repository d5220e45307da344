# SPDX-License-Identifier: Apache-2.0
"""Child processes that live and die together, and a ROS domain that nobody else is in."""

from __future__ import annotations

import atexit
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from rlml_slam.cli.support.usage import Usage, usage
from rlml_slam.errors import RlmlError

GRACE = 5.0  # [s] in which a child has to end after SIGINT
LAST_LINES = 15  # of a dead child's output are shown
_RESERVED: list[socket.socket] = []  # by this process, one for each of its domains


class Processes:
    """Named children, as a context manager: whatever happens, none outlives it.

    The output of each goes to ``<folder>/<name>.log``.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = {**os.environ, **environment}
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Start ``python -m`` with the arguments, in a session of its own."""
        with self._log(name).open('wb') as log:
            self._children[name] = subprocess.Popen(
                [sys.executable, '-m', *arguments], env=self._environment,
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip

    def _log(self, name: str) -> Path:
        return self._folder / f'{name}.log'

    def has_ended(self, name: str) -> bool:
        """Whether a child is done; RlmlError with its last words if it failed."""
        code = self._children[name].poll()
        if code is None:
            return False
        if code != 0:
            raise RlmlError(f'{name} ended with exit code {code}:\n{self.last_words(name)}')
        return True

    def check(self, *names: str) -> None:
        """RlmlError, with its last words, if one of the children is not running any more."""
        for name in names:
            if self.has_ended(name):
                raise RlmlError(f'{name} ended too early:\n{self.last_words(name)}')

    def last_words(self, name: str) -> str:
        """The last lines of a child's output."""
        text = self._log(name).read_text(encoding='utf-8', errors='replace')
        return '\n'.join(f'  {line}' for line in text.splitlines()[-LAST_LINES:])

    def usage(self, name: str) -> Usage | None:
        """CPU time and memory of a running child; None where the system does not say."""
        return usage(self._children[name].pid, time.monotonic())

    def stop(self) -> None:
        """End all children: SIGINT first, SIGKILL for those that do not listen."""
        for child in self._children.values():
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
        deadline = time.monotonic() + GRACE
        for child in self._children.values():
            try:
                child.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def free_domain() -> int:
    """A ROS domain that nobody on this machine uses; this process has it until it ends."""
    domains = list(range(1, 102))  # beyond these the ports are those of outgoing connections
    random.SystemRandom().shuffle(domains)
    for domain in domains:
        # RTPS: 7400 + 250 domain for multicast, + 10 + 2 k for the unicast of participant k
        ports = [7400 + 250 * domain + offset for offset in (0, 10, 12, 14, 16)]
        if (own := _reserve(domain)) is None:
            continue
        if all(map(_is_free, ports)):
            _RESERVED.append(own)
            atexit.register(own.close)
            return domain
        own.close()
    raise RlmlError('no free ROS domain on this machine')


def _reserve(domain: int) -> socket.socket | None:
    """What keeps other processes that ask for a domain from this one; None where another has it.

    A name of Linux's abstract sockets is free again when its process ends, whatever ends it.
    """
    own = socket.socket(socket.AF_UNIX)
    try:
        if sys.platform.startswith('linux'):
            own.bind(f'\0rlml_slam domain {domain}')
    except OSError:
        own.close()
        return None
    return own


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True
