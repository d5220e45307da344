# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_rooms import ROOM, built, path, scan, walls

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.matching.scans import branch_and_bound
from rlml_slam.matching.scans.submap import P_MAX, P_MIN, Submap
from rlml_slam.matching.scans.voxel_filter import thin

BOX = walls((-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0))
TRUE = np.array([0.4, -0.3, 0.5])


@pytest.fixture(scope='module')
def room() -> Submap:
    return built(ROOM, path(), sigma=0.01)


@pytest.fixture(scope='module')
def pyramid(room) -> branch_and_bound.Pyramid:
    return branch_and_bound.Pyramid(room)


@pytest.fixture(scope='module')
def points():
    return thin(scan(ROOM, TRUE, 360, sigma=0.01), 0.05, 150)


def brute_force(pyramid, points, pose, n, thetas):
    """Sums (angles, rows, columns) of every candidate."""
    grid = pyramid.levels[0].reshape(pyramid.rows, pyramid.columns).astype(np.int64)
    padded = np.pad(grid, n + 200)
    sums = np.zeros((len(thetas), 2 * n + 1, 2 * n + 1), dtype=np.int64)
    for a, theta in enumerate(thetas):
        at = se2.transform(pose + np.array([0.0, 0.0, theta]), points)
        cells = np.floor(at / pyramid.resolution).astype(int) - pyramid.corner + n + 200
        for i in range(-n, n + 1):
            for j in range(-n, n + 1):
                sums[a, i + n, j + n] = padded[cells[:, 1] + i, cells[:, 0] + j].sum()
    return sums


def score(total, n):
    return P_MIN + (P_MAX - P_MIN) * total / (255.0 * n)


@pytest.mark.parametrize('seed', range(4))
def test_branch_and_bound_equals_brute_force(pyramid, points, seed):
    rng = np.random.default_rng(seed)
    pose = TRUE + rng.normal(size=3) * [0.3, 0.3, 0.1]
    thetas = branch_and_bound.angles(points, pyramid.resolution, 0.15)
    sums = brute_force(pyramid, points, pose, 9, thetas)
    found = branch_and_bound.wide(
        pyramid, points, pose, 9 * pyramid.resolution, 0.15, separation=0.2,
        separation_angle=0.1, second_share=0.0,
    )  # fmt: skip
    assert found.best.score == pytest.approx(score(sums.max(), len(points)), abs=1e-12)
    # what is near the best is no second candidate
    a, i, j = np.unravel_index(sums.argmax(), sums.shape)
    turn = 0.1 / (thetas[1] - thetas[0])
    turns, rows, columns = np.indices(sums.shape)
    near = (abs(turns - a) <= turn) & (abs(rows - i) <= 4) & (abs(columns - j) <= 4)
    best = se2.transform(found.best.pose, points)
    shift = np.array([j - 9, i - 9]) * pyramid.resolution
    here = se2.transform(pose + np.array([*shift, thetas[a]]), points)
    np.testing.assert_allclose(best, here, atol=1e-12)
    expected = score(np.where(near, -1, sums).max(), len(points))
    assert found.second.score == pytest.approx(expected, abs=1e-12)


def test_branch_and_bound_finds_the_pose_from_anywhere(pyramid, points):
    found = branch_and_bound.wide(pyramid, points, np.array([-1.0, 1.0, -2.0]), 3.0, np.pi)
    error = se2.between(TRUE, found.best.pose)
    # half a cell and half a step of the angle, and the noise
    assert np.hypot(error[0], error[1]) < 0.06
    assert abs(error[2]) < 0.02
    assert found.best.score > 0.5
    assert found.second is None or found.second.score < 0.85 * found.best.score
    # nearly all of the poses are never looked at
    poses = len(branch_and_bound.angles(points, pyramid.resolution, np.pi)) * 121**2
    assert found.evaluated < 0.05 * poses


def test_symmetric_box_has_a_second_place_as_good(points):
    submap = built(BOX, np.zeros((1, 3)))
    pyramid = branch_and_bound.Pyramid(submap)
    seen = thin(scan(BOX, TRUE, 360), 0.05, 300)
    found = branch_and_bound.wide(pyramid, seen, np.zeros(3), 1.0, np.pi)
    opposite = np.array([-TRUE[0], -TRUE[1], TRUE[2] - np.pi])
    for expected in (TRUE, opposite):
        errors = [np.abs(se2.between(expected, c.pose)) for c in (found.best, found.second)]
        assert min(e.max() for e in errors) < 0.08
    assert found.second.score > 0.9 * found.best.score


def test_score_below_the_minimum_is_no_candidate(pyramid):
    noise = np.random.default_rng(0).uniform(-2, 2, size=(100, 2))
    assert branch_and_bound.wide(pyramid, noise, np.zeros(3), 0.5, 0.2, min_score=0.6).best is None
    with pytest.raises(InputError, match='no points'):
        branch_and_bound.wide(pyramid, np.zeros((0, 2)), np.zeros(3), 0.5, 0.2)


@pytest.mark.parametrize(('k', 'i', 'j'), [(1, 60, 70), (1, 61, 77), (2, 20, 30), (2, 33, 3)])
def test_levels_bound_the_blocks_below_them(pyramid, k, i, j):
    cells = pyramid.levels[0].reshape(pyramid.rows, pyramid.columns)
    assert pyramid.bound(k, i, j) == cells[i : i + 8**k, j : j + 8**k].max()


def test_sums_of_many_points_do_not_overflow(pyramid, points):
    many = np.tile(points, (6, 1))
    assert len(many) > 2 * branch_and_bound.CARRY_FREE
    few, all_ = (branch_and_bound.wide(pyramid, p, TRUE, 0.5, 0.1) for p in (points, many))
    np.testing.assert_array_equal(few.best.pose, all_.best.pose)
    assert few.best.score == pytest.approx(all_.best.score, abs=1e-12)


def test_batches_of_blocks_find_the_same(room, pyramid, points, monkeypatch):
    start = np.array([-1.0, 1.0, -2.0])
    whole = branch_and_bound.wide(pyramid, points, start, 3.0, np.pi)
    assert len(branch_and_bound.angles(points, 0.05, np.pi)) * 4 > branch_and_bound.BATCH
    # the same window around another lattice point covers the same places
    shifted = branch_and_bound.wide(
        pyramid, points, start + np.array([0.5, -0.5, 0.0]), 3.0, np.pi
    )
    assert shifted.best.score == pytest.approx(whole.best.score, abs=1e-12)
    np.testing.assert_allclose(shifted.best.pose, whole.best.pose, atol=1e-9)


def test_search_is_the_same_to_the_last_bit(room, points):
    results = [
        branch_and_bound.wide(branch_and_bound.Pyramid(room), points, np.zeros(3), 1.0, np.pi)
        for _ in range(2)
    ]
    assert results[0].best.pose.tobytes() == results[1].best.pose.tobytes()
    assert results[0].evaluated == results[1].evaluated
