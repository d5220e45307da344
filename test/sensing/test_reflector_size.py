# SPDX-License-Identifier: Apache-2.0
"""The size of cylinders is found among flat reflectors of other sizes, with an honest sigma."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_slam.sensing.reflectors.bright_spots import LIT
from rlml_slam.sensing.reflectors.reflector_size import MOST, WIDTHS, ReflectorSize

DIVERGENCE = 0.003
PERIOD = 10**8  # [ns]


def drive(
    size, diameter, flat_width, num_round, num_flat, seed=0, scans=120, speed=0.1, beams=1440
):
    """Spots that a laser on a straight way sees of reflectors around it."""
    rng, step = np.random.default_rng(seed), 2.0 * np.pi / beams
    points = rng.uniform([-2.0, -8.0], [14.0, 8.0], (num_round + num_flat, 2))
    points[:, 1] += np.where(points[:, 1] > 0.0, 1.5, -1.5)
    for k in range(scans):
        pose = np.array([speed * k, 0.0, 0.0])
        p = points - pose[:2]
        r, bearing = np.hypot(*p.T), np.arctan2(p[:, 1], p[:, 0])
        # flat ones hang on walls along the way
        width = np.where(
            np.arange(len(p)) < num_round, diameter, flat_width * np.abs(np.sin(bearing))
        )
        half = 0.5 * (width / r + DIVERGENCE)
        first, last = np.ceil((bearing - half) / step), np.floor((bearing + half) / step)
        count = last - first + 1.0
        spots = np.stack([r, count * r * step, r * step, 0.5 * (first + last)], -1)
        seen = count > 0
        size.add(k * PERIOD, p[seen], pose, spots[seen])
    return size.estimate()


@pytest.mark.parametrize(
    ('beams', 'num_flat'), [(720, 0), (1440, 0), (1440, 7), (7200, 0), (7200, 7)]
)
@pytest.mark.parametrize('given', [0.08, 0.3])
@pytest.mark.parametrize('diameter', [0.05, 0.08, 0.12, 0.2])
def test_the_size_of_cylinders_is_found_among_flat_reflectors(beams, num_flat, given, diameter):
    """4 %: half of the distance between two widths of the table, and a bit of the noise."""
    size, divergence, sigma = drive(
        ReflectorSize(given, DIVERGENCE), diameter, 1.5 * diameter, 10, num_flat, beams=beams
    )
    assert size == pytest.approx(diameter, rel=0.04)
    assert divergence == pytest.approx(DIVERGENCE, abs=0.001)
    assert abs(size - diameter) < 2.0 * sigma < 0.2 * diameter


@pytest.mark.parametrize('lit', [LIT, 0.9, 1.0])
def test_a_cylinder_that_is_dark_at_its_edges_has_the_given_size(lit):
    size, *_ = drive(ReflectorSize(0.08, DIVERGENCE), lit * 0.08 + 1e-4, 0.0, 10, 0)
    assert size == 0.08


def test_a_robot_that_stands_learns_no_more_from_many_scans():
    few, many = (
        drive(ReflectorSize(0.2, DIVERGENCE), 0.08, 0.12, 5, 3, scans=scans, speed=0.0)
        for scans in (1, 200)
    )
    assert many == few


def test_the_error_is_as_large_as_its_sigma_says():
    """Over sites of few reflectors seen for a second; a size is drawn from the prior."""
    rng, normalized = np.random.default_rng(5), []
    for seed in range(100):
        true = 0.08 if seed % 2 else rng.choice(WIDTHS[20:45])
        size, _, sigma = drive(
            ReflectorSize(0.08, DIVERGENCE), true, 1.5 * true, 4, 2, seed, scans=10
        )
        normalized.append(((size - true) / sigma) ** 2)
    assert 0.1 < np.mean(normalized) < 1.5  # what is open about lit edges is not in these widths


def test_nothing_seen_leaves_the_parameters():
    size = ReflectorSize(0.08, DIVERGENCE)
    size.add(0, np.zeros((0, 2)), np.zeros(3), np.zeros((0, 4)))
    found, divergence, sigma = size.estimate()
    assert (found, divergence) == (0.08, DIVERGENCE)
    assert sigma > 0.1


def test_a_reflector_that_is_passed_again_and_again_is_not_many():
    """Odometry has drifted meanwhile, and nobody knows that it is the same one."""
    sigmas, size = [], ReflectorSize(0.3, DIVERGENCE)
    step = 2.0 * np.pi / 1440
    for k in range(400):
        spot = np.array([[4.0, 5.0 * 4.0 * step, 4.0 * step, 10.5 + k % 2]])
        size.add(k * 120 * PERIOD, np.array([[4.0, 0.0]]), np.array([50.0 * k, 0.0, 0.0]), spot)
        if k in (100, 399):
            sigmas.append(size.estimate())
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.1)


def test_no_more_reflectors_are_remembered_than_fit():
    size, rng = ReflectorSize(0.08, DIVERGENCE), np.random.default_rng(0)
    for k in range(30):
        n = 150 if k % 2 else 30
        spots = np.stack([np.full(n, 5.0), np.full(n, 0.09), np.full(n, 0.02), np.arange(n)], -1)
        size.add(k * PERIOD, rng.uniform(-20.0, 20.0, (n, 2)), np.zeros(3), spots)
        assert len(size._points) == size._seen.shape[1] <= MOST
    assert np.isfinite(size.estimate()).all()


@pytest.mark.parametrize('given', [0.01, 1.0])
def test_given_size_that_the_table_lacks_holds_until_something_is_seen(given):
    assert ReflectorSize(given, DIVERGENCE).estimate()[0] == given
