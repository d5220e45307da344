# SPDX-License-Identifier: Apache-2.0
"""Signals that end a process, held where they must not strike."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def held_interrupts() -> Iterator[Callable[[], None]]:
    """SIGINT and SIGTERM are held until the yielded function is called; it raises the interrupt.

    Raised anywhere, it could strike while a child is being started, which nobody would end then,
    or in an import, where it is ignored or becomes another error.
    """
    caught: list[int] = []

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    # those that whoever started this process has it ignore stay ignored
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) != signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread():
        numbers = []  # they strike another one
    before = [signal.signal(n, lambda number, _frame: caught.append(number)) for n in numbers]
    try:
        yield check
    finally:
        for n, handler in zip(numbers, before, strict=True):
            signal.signal(n, handler)
