# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

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


@pytest.mark.skipif(memory._TRIM is None, reason='no glibc')
def test_free_memory_is_given_back():
    done = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, check=True)
    assert int(done.stdout) > 50_000_000  # of 120 MB


def test_without_glibc_nothing_happens(monkeypatch):
    monkeypatch.setattr(memory, '_TRIM', None)
    memory.give_back()
