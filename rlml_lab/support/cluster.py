# SPDX-License-Identifier: Apache-2.0
"""The cluster that works: a scheduler that runs already, or worker processes on this machine.

Queue, retries and transport are those of Dask distributed.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rlml_slam.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 30.0  # [s] within which a scheduler has to answer
# A nanny starts its worker again; Dask would take out one that is absent this [s] after its first
# end. Dask blames each task that a worker holds for its end: of many bags it holds but the one
# that it does, of fewer than three it may hold another one.
LOCAL = {
    'distributed.deploy.lost-worker-timeout': 1e7,
    'distributed.scheduler.worker-saturation': 1.0,
}


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def open_client(cluster: str | None, jobs: int = 0) -> Iterator[Client]:
    """The client of the scheduler at ``cluster`` (tcp://HOST:PORT, tls://HOST:PORT).

    Without an address: ``jobs`` worker processes on this machine, one per core where 0, each with
    one thread, which end with the context. Raises ClusterError where there is no scheduler or the
    packages of the extra ``fleet`` are missing.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ModuleNotFoundError as e:
        raise ClusterError(
            f'a cluster needs the Python package {e.name!r}: pip install "rlml_slam[fleet]"'
        ) from e
    # where a scheduler ends, its client raises; the traceback in the log says no more
    logging.getLogger('distributed.client').setLevel(logging.CRITICAL)
    if cluster is not None:
        try:
            client = Client(cluster, timeout=CONNECT_S)
        except (OSError, ValueError, TypeError) as e:
            raise ClusterError(f'no scheduler of Dask answers at {cluster}: {e}') from e
        with client:
            yield client
        return
    with (
        dask.config.set(LOCAL),
        LocalCluster(
            n_workers=jobs or cores(), threads_per_worker=1, host='127.0.0.1',
            dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL,
        ) as local,
        Client(local) as client,
    ):  # fmt: skip
        yield client
