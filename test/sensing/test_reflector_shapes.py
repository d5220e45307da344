# SPDX-License-Identifier: Apache-2.0
"""All scans of one reflector together say whether it is flat or round."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.params import Detector
from rlml_slam.sensing.reflectors.bright_spots import COLUMNS, ODDS, SURE, TILTED
from rlml_slam.sensing.reflectors.reflector_detector import detect
from rlml_slam.sensing.reflectors.reflector_shapes import EXPECTED, MEMORY, ReflectorShapes
from rlml_slam.types import Scan

BOTH = Detector(diameter=0.08, flat_width=0.08, divergence=0.0)
SIGMA = 0.01
HERE = np.zeros(2)
AWAY = np.array([[2.0, 0.0]])


def scan_of(is_flat, r, rng, tilt=0.0, beams=1440):
    """A reflector of 8 cm straight ahead, in darkness."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False) + rng.uniform(0, 2e-3)
    x = r * np.tan(angles)
    lit = (np.abs(angles) < 1.0) & (np.abs(x) < 0.04 * (np.cos(tilt) if is_flat else 1.0))
    depth = x * np.tan(tilt) if is_flat else -np.sqrt(np.maximum(0.04**2 - x**2, 0.0))
    ranges = np.where(lit, r + depth + rng.normal(0.0, SIGMA, beams), 8.0)
    bright = np.where(lit, 6000.0, 100.0)
    return Scan(
        1, 'laser', angles[0], 2.0 * np.pi / beams, 0.0, 0.1, 30.0,
        ranges.astype(np.float32), bright.astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize(('is_flat', 'tilt'), [(False, 0.0), (True, 0.0), (True, 0.7)])
@pytest.mark.parametrize('r', [1.5, 4.0])
def test_the_shape_of_a_reflector_is_found(is_flat, tilt, r):
    """No scan at 4 m decides: five beams of 1 cm of noise on 2 cm of depth. Many do."""
    rng, shapes = np.random.default_rng(3), ReflectorShapes()
    single, errors, normalized = [], [], []
    for k in range(100):
        found = detect(scan_of(is_flat, r, rng, tilt), BOTH)
        if len(found) != 1:
            continue
        single.append(found.odds[0])
        odds = shapes.update(k * 10**8, found.points, HERE, found.rows)
        known = found.with_odds(odds, BOTH.diameter)
        errors.append(known.points[0, 0] - r)
        normalized.append(errors[-1] ** 2 / known.cov[0, 0, 0])
    assert len(errors) > 40
    assert (odds[0] > 3.0) == is_flat
    assert (odds[0] < -3.0) == (not is_flat)
    assert np.abs(single).min() < 3.0
    assert np.isnan(known.diameters[0]) == is_flat
    assert abs(np.mean(errors[60:])) < 0.005  # 3 sigma of 40 scans
    assert np.mean(normalized) < 2.0


def test_one_scan_says_how_far_it_may_be_off():
    """Without the scans before, the covariance has both shapes: 1 is consistent."""
    rng = np.random.default_rng(1)
    normalized = []
    for k in range(200):
        found = detect(scan_of(k % 2 == 0, 5.0, rng), BOTH)
        if len(found) == 1:
            normalized.append((found.points[0, 0] - 5.0) ** 2 / found.cov[0, 0, 0])
    assert 0.5 < np.mean(normalized) < 1.5


def rows(odds, tilted=0.0):
    out = np.zeros((1, COLUMNS))
    out[0, ODDS], out[0, TILTED] = odds, tilted
    return out


PRIOR = np.log(EXPECTED[1] / EXPECTED[0])


def test_reflectors_are_what_most_are():
    shapes = ReflectorShapes()
    assert shapes.prior == PRIOR
    for k in range(6):
        shapes.update(k * 2 * MEMORY, AWAY + k, HERE, rows(-5.0))
    assert shapes.prior == pytest.approx(np.log(EXPECTED[1] / (EXPECTED[0] + 6.0)))
    odds = shapes.update(20 * MEMORY, AWAY, HERE, rows(0.0))
    assert odds[0] == shapes.prior


def test_what_is_elsewhere_or_long_ago_is_another_one():
    shapes = ReflectorShapes()
    assert shapes.update(0, AWAY, HERE, rows(1.0))[0] == 1.0 + PRIOR
    assert shapes.update(10, AWAY + 0.1, HERE, rows(1.0))[0] == 2.0 + PRIOR
    assert shapes.update(20, AWAY + 1.0, HERE, rows(1.0))[0] == 1.0 + PRIOR
    assert shapes.update(2 * MEMORY, AWAY, HERE, rows(1.0))[0] == 1.0 + PRIOR
    assert shapes.update(2 * MEMORY + 1, AWAY, HERE, rows(-99.0))[0] == -SURE + shapes.prior


def test_a_tilt_counts_once_from_each_view():
    shapes = ReflectorShapes()
    for _ in range(5):
        odds = shapes.update(1, AWAY, HERE, rows(0.0, -1.0))
    assert odds[0] == pytest.approx(PRIOR - 1.0)
    odds = shapes.update(2, AWAY, np.array([1.9, 1.0]), rows(0.0, 3.0))
    assert odds[0] == pytest.approx(PRIOR + 2.0)


def test_the_order_of_the_scans_of_a_view_does_not_matter():
    """The first scan of a view is no better than the others: the mean of their tilts counts."""
    tilts = np.random.default_rng(2).normal(0.0, 3.0, 8)
    for order in (tilts, tilts[::-1], np.sort(tilts)):
        shapes = ReflectorShapes()
        for tilted in order:
            odds = shapes.update(1, AWAY, HERE, rows(0.1, tilted))
        assert odds[0] == pytest.approx(PRIOR + 0.8 + tilts.mean())
    odds = shapes.update(2, AWAY, np.array([1.9, 1.0]), rows(0.0, 0.5))
    assert odds[0] == pytest.approx(PRIOR + 0.8 + tilts.mean() + 0.5)


def test_two_reflectors_side_by_side_are_two():
    shapes = ReflectorShapes()
    both = np.concatenate([AWAY, AWAY + np.array([0.0, 0.15])])
    for _ in range(3):
        odds = shapes.update(1, both, HERE, np.concatenate([rows(1.0), rows(-1.0)]))
    assert odds.tolist() == pytest.approx([PRIOR + 3.0, PRIOR - 3.0])


def test_a_shape_that_does_not_fit_is_excluded():
    found = detect(scan_of(False, 2.0, np.random.default_rng(0)), Detector(divergence=0.0))
    assert found.odds[0] == -SURE
    assert found.cov[0, 0, 0] < 0.02**2
