# SPDX-License-Identifier: Apache-2.0
"""The real buffer of tf2, of Debian's python3-tf2, answers as the rules that tests use."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tf2_rules import Buffer, Refused

from rlml_lab.dropin.buffer_core import INSTALL, BufferCore, is_installed

MS = 1_000_000
EDGES = ('map', 'odom'), ('odom', 'base_link')

pytestmark = pytest.mark.skipif(not is_installed(), reason=f'no tf2: {INSTALL}')


@pytest.fixture
def core():
    with BufferCore() as core:
        yield core


def add(core, rules, stamp, edge, pose):
    rules.add(stamp, edge, pose)
    half = 0.5 * pose[2]
    core.add(stamp, edge, (*pose[:2], 0.0), (0.0, 0.0, math.sin(half), math.cos(half)))


def planar(found):
    return np.array([*found[:2], 2.0 * math.atan2(found[5], found[6])])


def test_transforms_of_a_drive_are_answered_and_refused_alike(core):
    """Map to odom as it is published: exact at scans, and dated ahead by half a second."""
    rng, rules, now, refused = np.random.default_rng(3), Buffer(), 50_000 * MS, 0
    poses = {edge: np.array([1.0, -2.0, 0.3]) for edge in EDGES}
    for k in range(1500):
        now += 20 * MS
        for edge in EDGES:
            poses[edge] = poses[edge] + rng.normal(0.0, [0.02, 0.02, 0.01])
        add(core, rules, now, EDGES[1], poses[EDGES[1]])
        if k % 5 == 0:
            add(core, rules, now - 100 * MS, EDGES[0], poses[EDGES[0]])
        add(core, rules, now + 500 * MS - 1, EDGES[0], poses[EDGES[0]])
        for stamp in now + rng.integers(-11_000 * MS, 60 * MS, 3):
            found = core.ask(int(stamp), ('map', 'base_link'))
            try:
                T = rules.chain(int(stamp), *EDGES)
            except Refused:
                assert found is None
                refused += 1
                continue
            assert found is not None, core.why
            np.testing.assert_allclose(planar(found), T, atol=1e-5)
    assert 100 < refused < 2000


def test_what_lies_ahead_of_the_newest_is_refused(core):
    add(core, Buffer(), 7 * MS, EDGES[0], np.zeros(3))
    assert core.ask(7 * MS, EDGES[0]) is not None
    assert core.ask(7 * MS + 1, EDGES[0]) is None
    assert 'extrapolation' in core.why
