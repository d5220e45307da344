# SPDX-License-Identifier: Apache-2.0
"""Independent tasks of a study over the workers of a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

from rlml_slam.errors import ParameterError
from rlml_slam.fleet import cluster
from rlml_slam.fleet.cluster import Result, Task

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
    with cluster.open_client(address, jobs) as client:
        yield from cluster.each(client, function, tasks)
