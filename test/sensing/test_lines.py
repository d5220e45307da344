# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from rlml_slam.params import Ransac
from rlml_slam.sensing.features.lines import extract
from rlml_slam.sensing.features.ransac import find_lines, fit

ORIGIN = np.zeros(2)


def room(noise=0.0, seed=0, beams=1440, half=(4.0, 3.0)):
    a = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    c, s = np.cos(a), np.sin(a)
    r = np.minimum(half[0] / np.maximum(np.abs(c), 1e-9), half[1] / np.maximum(np.abs(s), 1e-9))
    r = r + noise * np.random.default_rng(seed).standard_normal(beams)
    return r[:, None] * np.stack([c, s], -1)


def test_the_four_walls_of_a_room_are_its_lines():
    found = extract(room(), ORIGIN, Ransac())
    order = np.argsort(np.round(found.lines[:, 1] + 0.1, 6) % (2.0 * np.pi))
    rho, alpha = found.lines[order].T
    assert rho == pytest.approx([4.0, 3.0, 4.0, 3.0], abs=1e-3)
    expected = np.array([0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi])
    # +pi and -pi are one direction
    assert np.abs(np.exp(1j * alpha) - np.exp(1j * expected)).max() < 1e-3


def test_the_same_scan_gives_the_same_lines():
    p = room(0.01)
    first, second = extract(p, ORIGIN, Ransac()), extract(p, ORIGIN, Ransac())
    assert np.array_equal(first.lines, second.lines)
    assert np.array_equal(first.cov, second.cov)
    other = extract(p, ORIGIN, Ransac(seed=1))
    assert not np.array_equal(first.lines, other.lines)


def test_covariance_holds_the_spread_of_the_estimates():
    rows = []
    for seed in range(40):
        found = extract(room(0.01, seed), ORIGIN, Ransac(sigma=0.01, sigma_floor=(0.0, 0.0)))
        k = int(np.argmin(np.abs(found.lines[:, 1])))
        e = found.lines[k] - [4.0, 0.0]
        rows.append(e @ np.linalg.solve(found.cov[k], e))
    # chi2 with 2 degrees of freedom over 40 runs has mean 2 +- 0.32; readings that the tolerance
    # cuts off and corners bend it a little
    assert 1.2 < np.mean(rows) < 3.6


def test_covariance_is_of_the_perpendicular_though_the_wall_lies_aside():
    x = np.linspace(5.0, 9.0, 200)
    rng = np.random.default_rng(3)
    nees = []
    for _ in range(60):
        p = np.stack([x, 2.0 + 0.01 * rng.standard_normal(len(x))], -1)
        found = extract(p, ORIGIN, Ransac(sigma=0.01, sigma_floor=(0.0, 0.0), tolerance=0.1))
        e = found.lines[0] - [2.0, 0.5 * np.pi]
        nees.append(e @ np.linalg.solve(found.cov[0], e))
    # mean of chi2_2 over 60: 2 +- 0.26
    assert 1.2 < np.mean(nees) < 2.8


def test_too_few_readings_or_too_short_a_wall_are_no_line():
    assert len(extract(np.zeros((0, 2)), ORIGIN, Ransac()).lines) == 0
    assert len(extract(room()[:40], ORIGIN, Ransac()).lines) == 0
    short = np.stack([np.linspace(2.0, 2.5, 200), np.full(200, 1.0)], -1)
    assert len(extract(short, ORIGIN, Ransac()).lines) == 0


def test_readings_of_one_line_beyond_a_gap_are_a_line_of_their_own():
    x = np.concatenate([np.linspace(-6.0, -2.0, 200), np.linspace(2.0, 5.0, 150)])
    found = extract(np.stack([x, np.full(len(x), 3.0)], -1), ORIGIN, Ransac(max_gap=0.5))
    assert sorted(found.readings) == [150, 200]
    ends = np.sort(found.ends[:, :, 0], axis=1)
    assert np.sort(ends, axis=0) == pytest.approx(np.array([[-6.0, -2.0], [2.0, 5.0]]), abs=1e-9)


def test_lines_hold_no_reading_twice_and_none_far_from_them():
    p = np.concatenate([room(0.01, 5), np.random.default_rng(1).uniform(-2.5, 2.5, (60, 2))])
    order = np.argsort(np.arctan2(p[:, 1], p[:, 0]), kind='stable')
    draws = np.random.default_rng(0).random((100, 6))
    angle = np.arctan2(p[order, 1], p[order, 0])
    line_of = find_lines(p[order], angle, draws, 0.17, 0.04, 60, 0.5)
    assert line_of.max() == 3
    for k in range(4):
        members = np.flatnonzero(line_of == k)
        rho, a = fit(p[order], members)
        away = p[order][members] @ [np.cos(a), np.sin(a)] - rho
        # within the tolerance of the line through the first consensus, which differs by little
        assert len(members) >= 60
        assert np.abs(away).max() < 0.05
