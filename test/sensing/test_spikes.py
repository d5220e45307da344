# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from rlml_slam.params import Spikes
from rlml_slam.sensing.features.spikes import extract, jump_spans, sum_spans
from rlml_slam.types import Scan


def scan(ranges, increment=0.01, first=-0.5):
    r = np.asarray(ranges, dtype=np.float32)
    return Scan(1, 'laser', first, increment, 0.0, 0.1, 30.0, r, np.zeros(0, np.float32))


def test_jump_finds_what_is_nearer_than_both_neighbours():
    r = np.full(100, 5.0)
    r[40:43] = 3.0
    found = extract(scan(r), Spikes(range_offset=0.1, cylindrical=False))
    assert found.beams.tolist() == [41.0]
    angle = -0.5 + 0.41
    assert found.points[0] == pytest.approx([3.1 * np.cos(angle), 3.1 * np.sin(angle)], abs=1e-6)


@pytest.mark.parametrize('diameter', [0.05, 0.1, 0.2])
def test_centre_of_a_cylinder_is_found_whatever_its_size(diameter):
    rng = np.random.default_rng(4)
    increment, errors = 0.25 * np.pi / 180.0, []
    for _ in range(200):
        distance, bearing = rng.uniform(2.0, 6.0), rng.uniform(-0.4, 0.4)
        angle = -0.5 + increment * np.arange(230)
        across = distance * np.sin(angle - bearing)
        hit = np.abs(across) < 0.5 * diameter
        r = np.full(len(angle), 9.0)
        depth = np.sqrt(0.25 * diameter**2 - across[hit] ** 2)
        r[hit] = distance * np.cos(angle[hit] - bearing) - depth
        found = extract(scan(r, increment), Spikes())
        errors.append(np.linalg.norm(found.points[0]) - distance)
    # a beam more or less is 8 mm at most of the depth, as often one as the other: 200 of them
    assert abs(np.mean(errors)) < 0.001
    assert np.std(errors) < 0.01


def test_sum_finds_one_near_beam_and_its_covariance_is_polar():
    r = np.full(100, 5.0)
    r[60] = 2.0
    p = Spikes(test='sum', sigma_range=0.05, sigma_bearing=0.01, cylindrical=False)
    found = extract(scan(r), p)
    assert found.beams.tolist() == [60.0]
    u = found.points[0] / 2.0
    t = np.array([-u[1], u[0]])
    assert u @ found.cov[0] @ u == pytest.approx(0.05**2, rel=1e-6)
    assert t @ found.cov[0] @ t == pytest.approx((2.0 * 0.01) ** 2, rel=1e-6)


def test_sum_with_reach_finds_several_near_beams_once():
    r = np.full(100, 5.0)
    r[60:63] = 2.0
    assert extract(scan(r), Spikes(test='sum')).beams.tolist() == []
    assert extract(scan(r), Spikes(test='sum', neighbour_offset=3)).beams.tolist() == [61.0]


@pytest.mark.parametrize('test', ['jump', 'sum'])
def test_edge_of_a_wall_is_no_spike(test):
    r = np.full(100, 5.0)
    r[50:] = 3.0
    assert len(extract(scan(r), Spikes(test=test)).points) == 0


@pytest.mark.parametrize('test', ['jump', 'sum'])
@pytest.mark.parametrize('nothing', [np.nan, np.inf, 0.0, -np.inf, 60.0])
def test_missing_returns_are_skipped_not_read_as_far(test, nothing):
    r = np.full(100, 5.0)
    r[40] = r[42] = nothing
    assert len(extract(scan(r), Spikes(test=test)).points) == 0
    r[41] = 3.0
    assert extract(scan(r), Spikes(test=test)).beams.tolist() == [41.0]


@pytest.mark.parametrize('test', ['jump', 'sum'])
@pytest.mark.parametrize('at', [0, 1, 359])
def test_spike_across_the_seam_of_a_full_turn_is_found(test, at):
    r = np.full(360, 5.0)
    r[[(at - 1) % 360, at]] = 3.0
    s = scan(r, 2.0 * np.pi / 360, -np.pi)
    found = extract(s, Spikes(test=test, neighbour_offset=2, max_width=0.2))
    assert found.beams.tolist() == [(at - 0.5) % 360]


def test_wide_far_and_thin_objects_are_left_out():
    r = np.full(200, 9.0)
    r[20:60], r[100:102], r[150:154] = 3.0, 8.0, 3.0
    found = extract(scan(r), Spikes(max_width=0.5, max_range=6.0, min_beams=3))
    assert found.beams.tolist() == [151.5]


def test_a_step_before_a_step_begins_at_the_nearer_one():
    assert jump_spans(np.array([9.0, 5.0, 5.0, 2.0, 5.0, 9.0]), 0.5, False) == [(3, 3)]


def test_too_short_scans_have_no_spikes():
    assert jump_spans(np.ones(2), 0.5, True) == []
    assert sum_spans(np.ones(2), 0.5, 1, True) == []
    assert len(extract(scan(np.full(50, np.nan)), Spikes()).points) == 0
