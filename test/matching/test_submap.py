# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_rooms import ROOM, scan

from rlml_slam import params
from rlml_slam.errors import InputError
from rlml_slam.matching.scans.submap import (
    FREE,
    LEVELS,
    NEVER_HIT,
    P_MAX,
    P_MIN,
    STEP,
    Submap,
    probability_of,
    update_table,
    value_of,
)
from rlml_slam.matching.scans.surfaces import fill

P = params.Submap(resolution=0.1, p_hit=0.7, p_miss=0.4)
ORIGIN = np.array([0.05, 0.05])
OFF_CENTRE = np.array([0.053, 0.041])  # no diagonal meets the corners of cells


def at(submap: Submap, x: float, y: float) -> float:
    j = int(np.floor(x / submap.resolution)) - submap.corner[0]
    i = int(np.floor(y / submap.resolution)) - submap.corner[1]
    return float(submap.probability()[i, j])


def odds(p: float) -> float:
    return p / (1.0 - p)


def read(submap: Submap, x: float, y: float) -> float:
    """What a match reads of the cell at (x, y)."""
    j, i = np.floor(np.array([x, y]) / submap.resolution).astype(int) - submap.corner
    return float(P_MIN + STEP * (int(submap.values[i, j]) - 1.0))


def test_value_and_probability_are_inverse_and_clamped():
    p = np.array([0.0, P_MIN, 0.3, 0.7, P_MAX, 1.0])
    back = probability_of(value_of(p))
    # a value is rounded to the nearest level
    np.testing.assert_allclose(back, np.clip(p, P_MIN, P_MAX), atol=0.51 * STEP)
    assert np.isnan(probability_of(np.zeros(1, dtype=np.uint16)))[0]


def test_ray_misses_up_to_the_cell_before_the_hit_and_nothing_else_is_known():
    submap = Submap(P)
    submap.insert(np.array([[1.05, 0.05]]), ORIGIN)
    for x in np.arange(0.05, 0.9, 0.1):
        assert at(submap, x, 0.05) == pytest.approx(P.p_miss, abs=NEVER_HIT * STEP)
    assert np.isnan(at(submap, 0.95, 0.05))
    assert at(submap, 1.05, 0.05) == pytest.approx(P.p_hit, abs=STEP)
    assert int(np.isfinite(submap.probability()).sum()) == 10


@pytest.mark.parametrize('angle', np.linspace(-np.pi, np.pi, 23))
def test_ray_in_any_direction_is_a_connected_chain_of_cells(angle):
    submap = Submap(P)
    end = ORIGIN + 2.03 * np.array([np.cos(angle), np.sin(angle)])
    submap.insert(end[None], ORIGIN)
    known = np.argwhere(np.isfinite(submap.probability()))
    hit = (np.floor(end / 0.1) - submap.corner).astype(int)[::-1]
    start = (np.floor(ORIGIN / 0.1) - submap.corner).astype(int)[::-1]
    # every crossed cell once: |di| + |dj| cells before the hit, of which the last is left out
    assert len(known) == np.abs(hit - start).sum()
    offset = (known - start)[:, ::-1] @ np.array([-np.sin(angle), np.cos(angle)])
    assert np.abs(offset).max() <= np.sqrt(0.5) + 1.0


def test_hits_and_misses_multiply_the_odds():
    submap = Submap(P)
    for _ in range(2):
        submap.insert(np.array([[1.05, 0.05]]), ORIGIN)
    expected = odds(P.p_hit) ** 2 / (1.0 + odds(P.p_hit) ** 2)
    assert at(submap, 1.05, 0.05) == pytest.approx(expected, abs=2 * STEP)
    expected = odds(P.p_miss) ** 2 / (1.0 + odds(P.p_miss) ** 2)
    assert at(submap, 0.55, 0.05) == pytest.approx(expected, abs=2 * NEVER_HIT * STEP)


def test_match_reads_a_cell_that_was_only_missed_as_free():
    """Eq. 68: from P_MIN, as an unknown cell, to FREE at a probability of a half."""
    submap = Submap(P)
    submap.insert(np.array([[1.05, 0.05]]), ORIGIN)
    expected = P_MIN + (FREE - P_MIN) / (0.5 - P_MIN) * (P.p_miss - P_MIN)
    assert read(submap, 0.55, 0.05) == pytest.approx(expected, abs=STEP)
    assert read(submap, 1.05, 0.05) == pytest.approx(P.p_hit, abs=STEP)
    submap.insert(np.array([[0.55, 0.05]]), ORIGIN)
    assert read(submap, 0.55, 0.05) > 0.5


@pytest.mark.parametrize('misses', [0, 1, 3])
def test_hit_after_misses_only_multiplies_the_odds_of_what_the_misses_left(misses):
    submap, away = Submap(P), np.array([[3.05, 0.05]])
    for _ in range(misses):
        submap.insert(away, ORIGIN)
    submap.insert(np.array([[1.05, 0.05]]), ORIGIN)
    expected = odds(P.p_miss) ** misses * odds(P.p_hit)
    # the scale of cells that were never hit has steps that are twenty times as long
    assert odds(at(submap, 1.05, 0.05)) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize('p_miss', [0.01, 0.3, 0.45, 0.46, 0.49])
def test_no_miss_raises_the_probability_of_any_cell(p_miss):
    values = np.arange(1, LEVELS + 1, dtype=np.uint16)
    before, after = probability_of(values), probability_of(update_table(p_miss)[1:])
    assert (after <= before + 0.51 * STEP).all()
    assert probability_of(update_table(p_miss)[:1])[0] < 0.5


@pytest.mark.parametrize('p_hit', [0.51, 0.55, 0.7, 0.99])
def test_cell_that_was_hit_is_none_that_was_only_missed(p_hit):
    values = np.arange(1, LEVELS + 1, dtype=np.uint16)
    before, after = probability_of(values), update_table(p_hit)[1:]
    assert after.min() > value_of(FREE)
    expected = np.clip(
        odds(before) * odds(p_hit) / (1.0 + odds(before) * odds(p_hit)), FREE, P_MAX
    )
    np.testing.assert_allclose(probability_of(after), expected, atol=1.01 * STEP)


def test_cell_that_was_hit_loses_its_odds_miss_by_miss_and_is_free_in_the_end():
    submap, away = Submap(P), np.array([[3.05, 0.05]])
    submap.insert(np.array([[1.05, 0.05]]), ORIGIN)
    expected, before = odds(P.p_hit), P.p_hit
    for _ in range(12):
        submap.insert(away, ORIGIN)
        expected *= odds(P.p_miss)
        now = read(submap, 1.05, 0.05)
        assert now < before or now == pytest.approx(P_MIN, abs=STEP)
        if expected > 1.01 * odds(FREE):
            assert odds(now) == pytest.approx(expected, rel=0.01)
        else:
            assert now <= 1.01 * FREE
        before = now
    assert now == pytest.approx(P_MIN, abs=STEP)


def test_probability_stays_between_its_bounds():
    submap = Submap(P)
    for _ in range(60):
        submap.insert(np.array([[1.05, 0.05]]), ORIGIN)
    assert at(submap, 1.05, 0.05) == pytest.approx(P_MAX, abs=STEP)
    assert at(submap, 0.55, 0.05) == pytest.approx(P_MIN, abs=STEP)


def test_cell_counts_once_per_insertion_and_hits_win():
    submap = Submap(P)
    # ten beams through the cell of one hit, three hits in it
    fan = [[3.05, 0.05 + 1e-3 * k] for k in range(10)]
    submap.insert(np.array([*fan, [1.05, 0.05], [1.06, 0.05], [1.04, 0.05]]), ORIGIN)
    assert at(submap, 1.05, 0.05) == pytest.approx(P.p_hit, abs=STEP)
    assert at(submap, 0.55, 0.05) == pytest.approx(P.p_miss, abs=NEVER_HIT * STEP)


def test_growing_grid_changes_none_of_its_cells():
    once, grown = Submap(P), Submap(P)
    near = np.array([[1.05, 0.05], [0.35, -0.65]])
    far = np.array([[-4.35, 2.0], [3.0, -5.0], [0.0, 6.0]])
    grown.insert(near, ORIGIN)
    grown.insert(far, ORIGIN)
    once.insert(far, ORIGIN)
    once.insert(near, ORIGIN)
    for x in np.arange(-4.9, 4.0, 0.3):
        for y in np.arange(-5.4, 6.3, 0.3):
            inside = []
            for m in (once, grown):
                b = m.bounds
                ok = b[0] <= x < b[2] and b[1] <= y < b[3]
                inside.append(at(m, x, y) if ok else np.nan)
            # odds commute up to the rounding of two levels
            np.testing.assert_allclose(inside[0], inside[1], atol=2 * STEP)
    assert once.bounds[2] >= 3.0
    assert grown.insertions == grown.version == 2


def test_gap_between_neighbours_on_a_wall_is_filled():
    submap = Submap(P)
    wall = np.stack([np.full(5, 2.05), np.linspace(-1.0, 1.0, 5) + 0.05], -1)
    submap.insert(wall, ORIGIN)
    inner = [at(submap, 2.05, y) for y in np.arange(-0.45, 0.5, 0.1)]
    np.testing.assert_allclose(inner, P.p_hit, atol=STEP)
    lonely = Submap(P)
    lonely.insert(wall * np.array([1.0, 2.0]), ORIGIN)  # one metre apart: may be a door
    assert int((lonely.probability() > 0.5).sum()) == 5


def rays_of(kind, rng):
    """End points (n, 2) as seen from OFF_CENTRE."""
    angles = np.linspace(-np.pi, np.pi, 700)
    if kind == 'room':
        return scan(ROOM, np.zeros(3), beams=700, sigma=0.01) + OFF_CENTRE
    if kind == 'near and far':
        ranges = rng.uniform(0.0, 8.0, 700)
    elif kind == 'any order':
        ranges, angles = rng.uniform(0.0, 8.0, 700), rng.permutation(angles)
    else:  # a few directions of many rays each, along the axes and diagonals of the grid as well
        ranges, angles = rng.uniform(0.0, 8.0, 700), np.round(angles * 8 / np.pi) * np.pi / 8
    return OFF_CENTRE + ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)


@pytest.mark.parametrize('kind', ['room', 'near and far', 'any order', 'alike'])
def test_scan_touches_what_its_rays_touch_one_by_one(kind):
    points = rays_of(kind, np.random.default_rng(7))
    whole = Submap(P)
    whole.insert(points, OFF_CENTRE)
    touched = np.zeros(whole.values.shape, dtype=bool)
    filled = fill(points, P.resolution)
    for point, kept in zip(filled, grazing(filled - OFF_CENTRE), strict=True):
        one, ray = Submap(P), point - OFF_CENTRE
        end = OFF_CENTRE + ray * (1.0 - kept / max(np.hypot(*ray), P.resolution))
        one.insert(end[None], OFF_CENTRE)
        missed, (j, i) = one.values > 0, np.subtract(one.corner, whole.corner)
        column, row = cell_of(end) - one.corner
        missed[row, column] = False
        touched[i : i + missed.shape[0], j : j + missed.shape[1]] |= missed
        column, row = cell_of(point) - whole.corner
        touched[row, column] = True
    np.testing.assert_array_equal(whole.values > 0, touched)


def cell_of(point):
    return np.floor(point / P.resolution).astype(int)


def grazing(rays):
    """Length (n,) [m] before the end of each ray that is within a cell of a neighbour's line."""
    out = np.zeros(len(rays))
    for k, ray in enumerate(rays):
        for other in rays[[m for m in (k - 1, k + 1) if 0 <= m < len(rays)]]:
            length, (x, y) = max(np.hypot(*ray), 1e-12), ray - other
            along, beside = ray @ (x, y) / length, abs(ray[0] * y - ray[1] * x) / length
            if 0.0 < along < 0.5 * length:
                out[k] = max(out[k], along * min(1.0, P.resolution / max(beside, 1e-12)))
    return out


def test_rays_that_graze_a_wall_do_not_wear_it_off():
    """Far along it, end points are apart, and rays to the farther ones run within its cells."""
    submap, at_y = Submap(P), 1.0 + 0.5 * P.resolution
    angles = np.radians(np.arange(4.0, 91.0))
    for x in np.arange(0.0, 3.0, 0.1):
        points = np.stack([x + at_y / np.tan(angles), np.full(len(angles), at_y)], -1)
        submap.insert(points, np.array([x, 0.0]))
    for x in np.arange(4.05, 12.0, 0.1):
        assert not at(submap, x, at_y) < 0.5


def test_what_is_kept_back_of_rays_is_near_the_walls_alone():
    """A square room from near its corner, of which walls run away from the laser."""
    submap, laser, far = Submap(P), np.array([0.53, 0.41]), 6.0
    angles = np.radians(np.arange(0.25, 360.0, 0.5))
    way = np.stack([np.cos(angles), np.sin(angles)], -1)
    reach = np.where(way > 0.0, (far - laser) / way, -laser / way).min(axis=1)
    submap.insert(laser + reach[:, None] * way, laser)
    for x, y in np.random.default_rng(0).uniform(0.35, far - 0.35, size=(500, 2)):
        assert at(submap, x, y) < 0.5


def test_same_insertions_give_the_same_bytes():
    rng = np.random.default_rng(3)
    scans = [rng.normal(size=(200, 2)) * 4 for _ in range(5)]
    a, b = Submap(P), Submap(P)
    for m in (a, b):
        for s in scans:
            m.insert(s, ORIGIN)
    assert a.values.tobytes() == b.values.tobytes()


def test_scan_without_points_and_bad_values():
    submap = Submap(P)
    submap.insert(np.zeros((0, 2)), ORIGIN)
    assert not np.isfinite(submap.probability()).any()
    with pytest.raises(InputError, match='not finite'):
        submap.insert(np.array([[np.nan, 0.0]]), ORIGIN)
    with pytest.raises(InputError, match='not finite'):
        submap.insert(np.array([[1.0, 0.0]]), np.array([np.inf, 0.0]))
    assert submap.insertions == 1


def test_complete_submap_shows_the_same_in_less_memory():
    submap = Submap()
    a = np.linspace(0.0, 6.0, 200)
    submap.insert(np.stack([5.0 * np.cos(a), 3.0 * np.sin(a)], -1), np.zeros(2))
    submap.insert(np.stack([5.5 * np.cos(a) + 0.3, 3.5 * np.sin(a)], -1), np.array([0.3, 0.0]))
    before, walls = submap.bounds, submap.walls()
    known, bytes_ = submap.values[submap.values != 0].copy(), submap.values.nbytes
    submap.complete()
    np.testing.assert_array_equal(submap.values[submap.values != 0], known)
    np.testing.assert_allclose(submap.walls(), walls, atol=1e-12)
    assert (submap.bounds[:2] >= before[:2]).all()
    assert submap.values.nbytes < bytes_
    assert submap.knows(walls) == 1.0
    assert submap.knows(walls + 100.0) == 0.0
    assert submap.knows(np.vstack([walls, walls + 100.0])) == 0.5
