# SPDX-License-Identifier: Apache-2.0
"""A cluster on this machine, or the one that runs already."""

from __future__ import annotations

import gc
import sys

import pytest

from rlml_lab.support import cluster
from rlml_slam.errors import ClusterError

pytest.importorskip('distributed')


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
    # Dask closes such a client when it is collected; in the start of another one it would wait for
    # itself
    gc.collect()


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with (
        pytest.raises(ClusterError, match=r"'distributed': pip install"),
        cluster.open_client(None, 1),
    ):
        pass
