# SPDX-License-Identifier: Apache-2.0
"""A fleet's replays on a cluster, and the table of them."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rlml_lab.fleet.replay_job import Job, failed, replay_bag
from rlml_lab.fleet.results import Record, Results
from rlml_slam.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

TABLE, TIMES = 'fleet', 'fleet_times.csv'


def replay_all(
    client: Client, jobs: Sequence[Job], progress: Callable[[int, str], None]
) -> list[Record]:
    """The records of all jobs, in their order.

    ``progress`` is called with the number that is done and a note with the time left. A bag at
    which several workers ended gets a row that says so. Raises ClusterError where the cluster
    ends, or a worker has other code; what was done until then is found again.
    """
    from distributed import as_completed

    waiting = {client.submit(replay_bag, job, pure=False): k for k, job in enumerate(jobs)}
    records: dict[int, Record] = {}
    began, problems, found = time.monotonic(), 0, 0
    for future in as_completed(list(waiting)):
        k = waiting.pop(future)
        records[k] = _record_of(future, jobs[k])
        problems += records[k].row['status'] != 'ok'
        found += bool(records[k].times.get('reused'))
        n = len(records)
        left = (time.monotonic() - began) / n * (len(jobs) - n)
        progress(n, f'{n} of {len(jobs)}, {found} found again, {problems} with a problem, '
                    f'{span(left)} left')  # fmt: skip
    return [records[k] for k in range(len(jobs))]


def _record_of(future: Any, job: Job) -> Record:
    from distributed.scheduler import KilledWorker

    if future.cancelled():
        raise ClusterError('the scheduler has ended; run again: what is done is found')
    error = future.exception()
    if isinstance(error, ClusterError):
        raise error
    if isinstance(error, KilledWorker):
        return failed(job, f'{error.allowed_failures + 1} workers ended at it: out of memory?')
    if error is not None:
        return failed(job, f'{type(error).__name__}: {error}')
    record: Record = future.result()
    return record


def span(seconds: float) -> str:
    """A time for people."""
    if seconds < 90.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 5400.0 else f'{seconds / 3600.0:.1f} h'


def write_tables(results: Results, records: Sequence[Record]) -> None:
    """fleet.parquet, fleet.csv and fleet.json, a row per run; fleet_times.csv: what each cost."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    results.write_all(records)
    columns = columns_of(r.row for r in records)
    data = {c: [r.row.get(c) for r in records] for c in columns}
    sink = io.BytesIO()
    pq.write_table(pa.table(data), sink)
    results.write(sink.getvalue(), f'{TABLE}.parquet')
    results.write(csv_of(columns, [r.row for r in records]), f'{TABLE}.csv')
    times = [{'name': r.name, **r.times} for r in records]
    results.write(csv_of(columns_of(times), times), TIMES)


def columns_of(rows: Iterable[dict[str, Any]]) -> list[str]:
    """Names of all columns, in the order in which they appear."""
    return list(dict.fromkeys(c for row in rows for c in row))


def csv_of(columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> bytes:
    """A table as text, empty cells where a row lacks a column."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
