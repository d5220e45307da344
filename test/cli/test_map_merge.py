# SPDX-License-Identifier: Apache-2.0
"""Who does the work of a merge."""

from __future__ import annotations

import gc
import sys

import pytest

from rlml_slam.cli.map import map_merge
from rlml_slam.errors import ClusterError


@pytest.mark.parametrize('jobs', [1, 2])
def test_results_come_in_order_from_this_process_and_from_workers(jobs):
    with map_merge.mapper(None, jobs) as work:
        assert work(pow, [2, 3, 5], [3, 2, 1]) == [8, 9, 5]


def test_results_come_in_order_from_a_cluster():
    distributed = pytest.importorskip('distributed')
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        map_merge.mapper(cluster.scheduler_address, 1) as work,
    ):
        assert work(pow, [2, 3, 5], [3, 2, 1]) == [8, 9, 5]


@pytest.mark.parametrize('address', ['tcp://127.0.0.1:9', 'nonsense'])
def test_address_without_scheduler_is_a_clear_error(monkeypatch, address):
    pytest.importorskip('distributed')
    monkeypatch.setattr(map_merge, 'CONNECT_S', 0.3)
    with (
        pytest.raises(ClusterError, match=f'no scheduler of Dask answers at {address}'),
        map_merge.mapper(address, 1),
    ):
        pass
    gc.collect()  # Dask closes such a client when it is collected


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with (
        pytest.raises(ClusterError, match="'distributed': pip install"),
        map_merge.mapper('tcp://127.0.0.1:9', 1),
    ):
        pass
