# SPDX-License-Identifier: Apache-2.0
"""Global searches beside the graph: frames are mapped on while one takes its time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.worker import Worker
from rlml_slam.slam.conversation import Search
from rlml_slam.slam.relocalization.pose_test import locate
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Verdict

DELAY = 'RLML_SEARCH_DELAY'  # environment variable [s], for studies of slow machines


class Searcher:
    """Runs searches one after the other; ``on_result`` is called in a thread of its own.

    Every answer comes ``delay`` [s] late; None: what the environment variable DELAY says.
    """

    def __init__(
        self,
        params: Parameters,
        on_result: Callable[[int, Relocation], None],
        report: Callable[[BaseException], None],
        delay: float | None = None,
    ) -> None:
        self._p = params
        self._on_result = on_result
        self.delay = float(os.environ.get(DELAY, '0')) if delay is None else delay
        self._report = report
        self.worker = Worker(report)
        self._ends = threading.Event()

    def submit(self, search: Search) -> None:
        """Run a search after those that were given before."""
        self.worker.submit(lambda: self._run(search))

    def _run(self, search: Search) -> None:
        try:
            found = locate(search, self._p)
        except Exception as e:  # who asked waits for an answer
            self._report(e)
            found = Relocation(Verdict.NOT_SEARCHED, f'the search failed: {e}')
        if not self._ends.wait(self.delay):
            self._on_result(search.number, found)

    def close(self) -> None:
        """Finish the running search and forget the others."""
        self._ends.set()
        self.worker.close()
