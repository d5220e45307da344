# SPDX-License-Identifier: Apache-2.0
"""Tasks of a study, over the workers of a cluster."""

from __future__ import annotations

import os

import pytest

from rlml_lab.support.cluster import open_client
from rlml_lab.support.parallel_jobs import each_by

pytest.importorskip('distributed')


def square(x: int) -> tuple[int, int]:
    return x * x, os.getpid()


def test_every_task_is_computed_once_in_other_processes():
    tasks = [(x,) for x in (1, 2, 2, 3)]
    with open_client(None, 2) as client:
        found = list(each_by(client, square, tasks))
    assert sorted((t[0], r[0]) for t, r in found) == [(1, 1), (2, 4), (2, 4), (3, 9)]
    assert os.getpid() not in {r[1] for _, r in found}
