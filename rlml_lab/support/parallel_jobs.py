# SPDX-License-Identifier: Apache-2.0
"""Independent tasks of a study over processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

Task = TypeVar('Task', bound=tuple[Any, ...])
Result = TypeVar('Result')


def each(
    function: Callable[..., Result], tasks: Sequence[Task], jobs: int
) -> Iterator[tuple[Task, Result]]:
    """(task, function(*task)) as they become ready, from this process where one is enough."""
    if jobs == 1:
        yield from ((task, function(*task)) for task in tasks)
        return
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        pending = {pool.submit(function, *task): task for task in tasks}
        yield from ((pending[done], done.result()) for done in as_completed(pending))
