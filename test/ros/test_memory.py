# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys

import pytest

from rlml_slam.ros import memory

# blocks too small to be mapped one by one, freed but for the last, which holds the heap up
PROGRAM = """
import os
from rlml_slam.ros.memory import give_back
def resident():
    with open('/proc/self/statm') as f:
        return int(f.read().split()[1]) * os.sysconf('SC_PAGESIZE')
blocks = [bytes([1]) * 60_000 for _ in range(2000)]
del blocks[:-1]
before = resident()
give_back()
print(before - resident())
"""


# large blocks between small ones that stay, after one that lets glibc raise its limits
BETWEEN = """
import os
from rlml_slam.ros.memory import keep_large_apart
def resident():
    with open('/proc/self/statm') as f:
        return int(f.read().split()[1]) * os.sysconf('SC_PAGESIZE')
if {apart}:
    keep_large_apart()
bytes([1]) * 30_000_000
pairs = [(bytes([1]) * 1_000_000, bytes([1]) * 60_000) for _ in range(100)]
before = resident()
small = [b for _, b in pairs]
del pairs
print(before - resident())
"""


def given_back(program):
    # what a cluster of Dask sets for its workers would change what is tested
    env = {k: v for k, v in os.environ.items() if not k.startswith('MALLOC_')}
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, check=True, env=env
    )
    return int(done.stdout)


@pytest.mark.skipif(memory._GLIBC is None, reason='no glibc')
def test_free_memory_is_given_back():
    assert given_back(PROGRAM) > 50_000_000  # of 120 MB


@pytest.mark.skipif(memory._GLIBC is None, reason='no glibc')
def test_large_arrays_are_given_back_whatever_stays_between_them():
    assert given_back(BETWEEN.format(apart=True)) > 90_000_000  # of 100 MB
    assert given_back(BETWEEN.format(apart=False)) < 50_000_000


def test_without_glibc_nothing_happens(monkeypatch):
    monkeypatch.setattr(memory, '_GLIBC', None)
    memory.give_back()
    memory.keep_large_apart()
