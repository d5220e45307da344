# SPDX-License-Identifier: Apache-2.0
"""Independent tasks of a study over the workers of a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from rlml_lab.support.cluster import open_client
from rlml_slam.errors import ParameterError

if TYPE_CHECKING:
    from distributed import Client

Task = TypeVar('Task', bound=tuple[Any, ...])
Result = TypeVar('Result')

# a number of processes of this machine (0: one per core), or the address of a scheduler
Workers: TypeAlias = int | str


def add_workers(parser: argparse.ArgumentParser, jobs: int = 1) -> None:
    """Options for who works."""
    who = parser.add_mutually_exclusive_group()
    text = f'processes, 0: one per core (default: {jobs})'
    who.add_argument('--jobs', type=int, default=jobs, metavar='N', help=text)
    who.add_argument('--cluster', metavar='URL', help='scheduler of Dask, as tcp://HOST:8786')


def workers_of(args: argparse.Namespace) -> Workers:
    """Who works. ParameterError where --jobs is no number of processes."""
    if args.jobs < 0:
        raise ParameterError('--jobs must be 0 (one per core) or more')
    return args.cluster or args.jobs


def each(
    function: Callable[..., Result], tasks: Sequence[Task], workers: Workers
) -> Iterator[tuple[Task, Result]]:
    """(task, function(*task)) as they become ready, from this process where one is enough."""
    if workers == 1:
        yield from ((task, function(*task)) for task in tasks)
        return
    address, jobs = (workers, 0) if isinstance(workers, str) else (None, workers)
    with open_client(address, jobs) as client:
        yield from each_by(client, function, tasks)


def each_by(
    client: Client, function: Callable[..., Result], tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result]]:
    """(task, function(*task)) as they become ready; what a task raises is raised here."""
    from distributed import as_completed

    # each task is computed, equal ones too: Dask would find equal calls of a pure function again
    pending = {client.submit(function, *task, pure=False): task for task in tasks}
    for done in as_completed(list(pending)):
        yield pending.pop(done), done.result()
