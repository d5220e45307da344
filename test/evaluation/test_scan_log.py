# SPDX-License-Identifier: Apache-2.0
"""Scans that are kept for a viewer: bounded, evenly spread."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_slam.evaluation import scan_log
from rlml_slam.evaluation.scan_log import MAX_POINTS, UNIT, ScanLog, thinned


@pytest.mark.parametrize('n', [1, 7, 8, 9, 100, 1000])
def test_scans_are_bounded_and_evenly_spread(n, monkeypatch):
    monkeypatch.setattr(scan_log, 'MAX_SCANS', 8)
    log = ScanLog()
    for k in range(n):
        log.add(k, np.full((3, 2), 0.01 * k))
    assert min(n, 4) <= len(log) <= 8
    steps = np.diff(log.stamps)
    assert log.stamps[0] == 0
    assert len(set(steps.tolist())) <= 1
    assert n - log.stamps[-1] <= max(steps, default=n)
    assert [p[0, 0] for p in log.points] == log.stamps


def test_skipped_scans_count_as_those_that_are_added(monkeypatch):
    monkeypatch.setattr(scan_log, 'MAX_SCANS', 8)
    a, b = ScanLog(), ScanLog()
    for k in range(100):
        a.add(k, np.zeros((1, 2)))
        if b.is_due():
            b.add(k, np.zeros((1, 2)))
        else:
            b.skip()
    assert a.stamps == b.stamps


@pytest.mark.parametrize('n', [0, 1, MAX_POINTS, MAX_POINTS + 1, 7200])
def test_points_are_thinned_to_a_centimetre(n):
    points = np.random.default_rng(0).uniform(-300.0, 300.0, (n, 2))
    kept = thinned(points)
    assert len(kept) <= MAX_POINTS
    step = max(1, -(-n // MAX_POINTS))
    assert_allclose(UNIT * kept, points[::step], atol=0.5 * UNIT + 1e-9)


def test_points_beyond_16_bits_are_left_out():
    kept = thinned(np.array([[1.0, 2.0], [400.0, 0.0], [np.nan, 0.0], [0.0, -np.inf]]))
    assert kept.tolist() == [[100, 200]]
