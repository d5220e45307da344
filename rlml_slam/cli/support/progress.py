# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: a bar on a terminal, now and then a line elsewhere."""

from __future__ import annotations

import sys
import time

LINE_EVERY = 10.0  # [s] between two lines where there is no terminal


class Progress:
    """Shows how far a job is, as a context manager; costs next to nothing per update."""

    def __init__(
        self, what: str, total: float, quiet: bool = False, every: float = LINE_EVERY
    ) -> None:
        self._what, self._total = what, max(total, 1e-9)
        self._bar = None
        self._last = time.monotonic()
        self._quiet = quiet
        self._every = every
        if not quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TaskProgressColumn, TextColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(),
                TextColumn('{task.fields[note]}'), console=Console(stderr=True), transient=True,
                redirect_stdout=sys.stdout.isatty(),  # else what is printed would go to stderr
            )  # fmt: skip
            self._task = self._bar.add_task(what, total=self._total, note='')

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: float, note: str = '') -> None:
        """``done`` of the total is done; ``note`` stands behind the bar."""
        if self._bar is not None:
            self._bar.update(self._task, completed=min(done, self._total), note=note)
            return
        now = time.monotonic()
        if self._quiet or now - self._last < self._every:
            return
        self._last = now
        share = min(100.0, 100.0 * done / self._total)
        print(f'{self._what}: {share:.0f} % {note}'.rstrip(), file=sys.stderr, flush=True)
