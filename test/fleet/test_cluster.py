# SPDX-License-Identifier: Apache-2.0
"""A cluster on this machine, or the one that runs already."""

from __future__ import annotations

import os
import sys

import pytest

from rlml_slam.errors import ClusterError
from rlml_slam.fleet import cluster

pytest.importorskip('distributed')


def square(x: int) -> tuple[int, int]:
    return x * x, os.getpid()


def test_every_task_is_computed_once_in_other_processes():
    tasks = [(x,) for x in (1, 2, 2, 3)]
    with cluster.open_client(None, 2) as client:
        found = list(cluster.each(client, square, tasks))
    assert sorted((t[0], r[0]) for t, r in found) == [(1, 1), (2, 4), (2, 4), (3, 9)]
    assert os.getpid() not in {r[1] for _, r in found}


def test_address_without_scheduler_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(cluster, 'CONNECT_S', 0.3)
    with (
        pytest.raises(ClusterError, match=r'no scheduler of Dask answers at tcp://127.0.0.1:9'),
        cluster.open_client('tcp://127.0.0.1:9'),
    ):
        pass
    with (
        pytest.raises(ClusterError, match='no scheduler of Dask answers at nonsense'),
        cluster.open_client('nonsense'),
    ):
        pass


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with (
        pytest.raises(ClusterError, match=r"'distributed': pip install"),
        cluster.open_client(None, 1),
    ):
        pass
