# SPDX-License-Identifier: Apache-2.0
"""Reflectors that should be seen and are not: said where nothing hides them, and nowhere else."""

import math
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, drive, observations

from rlml_slam.errors import ParameterError
from rlml_slam.params import Parameters
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.landmarks.visibility import expected, sectors
from rlml_slam.types import Level

ORIGIN = np.array([0.2, 0.0])


def ring(radius, start=-np.pi, end=np.pi):
    a = np.linspace(start, end, 1440)
    return ORIGIN + radius * np.stack([np.cos(a), np.sin(a)], -1)


def test_reflector_before_the_walls_is_expected():
    pose = np.array([1.0, 2.0, 0.5])
    reflector = pose[:2] + 3.0 * np.array([[np.cos(0.6), np.sin(0.6)]])
    assert expected(pose, reflector, ring(5.0), ORIGIN, 10.0).all()
    assert expected(pose, reflector, ring(2.9), ORIGIN, 10.0).all()


def test_hidden_far_or_unscanned_reflectors_are_not_expected():
    reflector = np.array([[3.2, 0.0]])
    assert not expected(np.zeros(3), reflector, ring(2.0), ORIGIN, 10.0).any()
    assert not expected(np.zeros(3), reflector, ring(5.0), ORIGIN, 3.0).any()
    assert not expected(np.zeros(3), reflector, ring(5.0, 0.1, 6.2), ORIGIN, 10.0).any()
    assert not expected(np.zeros(3), reflector, np.zeros((0, 2)), ORIGIN, 10.0).any()


def healths(change):
    """Health of each frame of a drive, of whose frames after 4 s ``change`` makes others."""
    front_end = FrontEnd(Parameters())
    out = []
    for k, o in enumerate(observations(ROOM, drive((0.4, 0.3, 8.0)))):
        out.append(front_end.process(change(o) if k >= 40 else o).health)
    return out


def without_detections(o):
    d = o.detections
    return replace(
        o,
        detections=replace(
            d, points=d.points[:0], cov=d.cov[:0], ids=d.ids[:0], diameters=d.diameters[:0]
        ),
    )


def test_reflectors_that_are_no_longer_detected_degrade_the_health():
    seen = healths(without_detections)
    assert all(h.level is Level.OK for h in seen[20:45])
    last = seen[-1]
    assert last.level is Level.DEGRADED
    assert any('of' in r and 'expected reflectors' in r for r in last.reasons)


def test_nothing_is_said_where_all_is_seen_or_no_one_looks():
    for change in (lambda o: o, lambda o: replace(o, detections=None)):
        assert not any('expected' in r for h in healths(change) for r in h.reasons)


@pytest.mark.parametrize(
    ('muted', 'due'),
    [((0.0, 0.0), [True, True]), ((-0.3, 0.3), [False, True]), ((0.3, -0.3), [True, False]),
     ((2.8, -2.8), [True, False]), ((-4.0, 0.1, 3.0, 3.3), [False, False])],
)  # fmt: skip
def test_nothing_is_expected_in_a_muted_sector(muted, due):
    a = np.linspace(-np.pi, np.pi, 720)
    scan = 6.0 * np.stack([np.cos(a), np.sin(a)], -1)
    ahead_and_behind = np.array([[4.0, 0.0], [-4.0, 0.0]])
    out = expected(
        np.zeros(3), ahead_and_behind, scan, np.zeros(2), math.inf, sectors(muted)
    )  # fmt: skip
    assert out.tolist() == due


def test_sectors_are_pairs():
    with pytest.raises(ParameterError, match='3 bearings: pairs of begin and end'):
        sectors((0.0, 1.0, 2.0))
