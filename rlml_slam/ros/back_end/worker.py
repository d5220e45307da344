# SPDX-License-Identifier: Apache-2.0
"""One thread for heavy work, so that subscriptions keep draining; jobs run in order.

It runs at a lower priority: on a machine with few cores, the poses of the front end come first.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rlml_slam.errors import FileFormatError, MapError

NICE = 5  # of the thread


class Worker:
    """Runs jobs one after the other.

    What a job raises goes to ``report``, in the worker's thread, and the next one runs. A map that
    cannot be used (MapError, FileFormatError) is raised by ``check``.
    """

    def __init__(self, report: Callable[[BaseException], None]) -> None:
        self._report = report
        self._pool = ThreadPoolExecutor(max_workers=1, initializer=_step_back)
        self._failed: BaseException | None = None
        self._given = 0
        self._done = 0

    @property
    def backlog(self) -> int:
        """Jobs that are waiting or running."""
        return self._given - self._done

    def submit(self, job: Callable[[], Any]) -> Future[Any]:
        """Run ``job`` after all that were given before."""
        self._given += 1
        future = self._pool.submit(job)
        future.add_done_callback(self._finish)
        return future

    def _finish(self, future: Future[Any]) -> None:
        self._done += 1
        failed = None if future.cancelled() else future.exception()
        if isinstance(failed, MapError | FileFormatError):
            self._failed = failed
        elif failed is not None:
            self._report(failed)

    def check(self) -> None:
        """Raise what a job raised, once."""
        failed, self._failed = self._failed, None
        if failed is not None:
            raise failed

    def close(self) -> None:
        """Finish the running job and forget the others."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _step_back() -> None:
    """Lower the priority of this thread, where the system has priorities of threads."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
