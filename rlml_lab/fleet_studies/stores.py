# SPDX-License-Identifier: Apache-2.0
"""Bags and results in stores that are not the local file system."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fsspec

from rlml_lab.fleet.bags import find_bags
from rlml_lab.fleet.replay_job import Job, code_digest
from rlml_lab.fleet.results import Results
from rlml_lab.fleet.run import replay_all, write_tables
from rlml_lab.fleet_studies.fleet_bags import Fleet, name_of
from rlml_lab.support.cluster import open_client
from rlml_slam.params import Parameters

if TYPE_CHECKING:
    from distributed import Client


BAGS = 20


def stores(fleet: Fleet) -> dict[str, Any]:
    """The table of some bags from memory and from S3 against that of this machine."""
    from distributed import Client

    with open_client(None) as client:
        here = _table(client, _subset(fleet), str(fleet.out / 'here'))
    with Client(processes=False, n_workers=1, threads_per_worker=1) as client:
        memory = _table(client, _copied(fleet, 'memory://bags'), 'memory://runs')
    found: dict[str, Any] = {'bags': BAGS, 'memory_same_table': memory == here}
    try:
        with s3_server(), open_client(None) as client:
            bucket = f's3://fleet-{uuid.uuid4().hex[:8]}'
            fsspec.filesystem('s3').mkdir(bucket[5:])
            s3 = _table(client, _copied(fleet, f'{bucket}/bags'), f'{bucket}/runs')
        found['s3_same_table'] = s3 == here
    except ModuleNotFoundError as e:
        found['s3'] = f'not tried: no package {e.name!r}'
    return found | {'holds': memory == here and found.get('s3_same_table', True)}


def _subset(fleet: Fleet) -> str:
    """A folder with the first bags."""
    folder = fleet.out / 'first_bags'
    for name in map(name_of, range(BAGS)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if not (folder / name).exists():
            shutil.copytree(fleet.bags / name, folder / name)
    return str(folder)


def _copied(fleet: Fleet, url: str) -> str:
    """The same bags in another store."""
    fs, root = fsspec.core.url_to_fs(url)
    for name in map(name_of, range(BAGS)):
        for file in sorted(Path(fleet.bags, name).iterdir()):
            fs.pipe_file(f'{root}/{name}/{file.name}', file.read_bytes())
    return url


def _table(client: Client, bags: str, out: str) -> bytes:
    """fleet.parquet of a run."""
    jobs = [Job(b, Parameters(), out, code_digest(), report=False) for b in find_bags([bags])]
    assert len(jobs) == BAGS
    write_tables(Results(out), replay_all(client, jobs, lambda n, note: None))
    with fsspec.open(f'{out}/fleet.parquet') as f:
        data: bytes = f.read()
    return data


@contextmanager
def s3_server() -> Iterator[None]:
    """A server of S3 on loopback (moto), which this process and its children use."""
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer('127.0.0.1', 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    changed = {
        'FSSPEC_S3_ENDPOINT_URL': f'http://{host}:{port}', 'AWS_ACCESS_KEY_ID': 'test',
        'AWS_SECRET_ACCESS_KEY': 'test', 'AWS_DEFAULT_REGION': 'us-east-1',
    }  # fmt: skip
    before = {k: os.environ.get(k) for k in changed}
    os.environ.update(changed)
    fsspec.config.set_conf_env(fsspec.config.conf)
    s3fs.S3FileSystem.clear_instance_cache()
    try:
        yield
    finally:
        server.stop()
        for k, v in before.items():
            os.environ.pop(k) if v is None else os.environ.update({k: v})
