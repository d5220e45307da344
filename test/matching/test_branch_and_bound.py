# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_rooms import ROOM, built, path, scan, walls

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.matching.scans import branch_and_bound, search_pyramid
from rlml_slam.matching.scans.block_search import Goal, search
from rlml_slam.matching.scans.branch_and_bound import Criteria, Window, wide
from rlml_slam.matching.scans.search_pyramid import Pyramid
from rlml_slam.matching.scans.submap import P_MAX, P_MIN, Submap
from rlml_slam.matching.scans.voxel_filter import thin

BOX = walls((-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0))
TRUE = np.array([0.4, -0.3, 0.5])


@pytest.fixture(scope='module')
def room() -> Submap:
    return built(ROOM, path(), sigma=0.01)


@pytest.fixture(scope='module')
def pyramid(room) -> Pyramid:
    return Pyramid(room)


@pytest.fixture(scope='module')
def points():
    return thin(scan(ROOM, TRUE, 360, sigma=0.01), 0.05, 150)


def cells_of(pyramid):
    """The cells without what they are padded by."""
    v = pyramid.levels
    grid = v.cells[: len(v.cells) - search_pyramid.LANES].reshape(-1, v.columns)
    before = search_pyramid.BEFORE
    return grid[before : before + v.rows, before : before + v.width]


def searched(pyramid, points, pose, half_width, half_angle, **criteria):
    return wide(
        pyramid, points, Window(pose, (half_width, half_width), half_angle), Criteria(**criteria)
    )


def brute_force(pyramid, points, pose, n, thetas):
    """Sums (angles, rows, columns) of every candidate."""
    grid = cells_of(pyramid).astype(np.int64)
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
    found = searched(
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
    found = searched(pyramid, points, np.array([-1.0, 1.0, -2.0]), 3.0, np.pi)
    error = se2.between(TRUE, found.best.pose)
    # half a cell and half a step of the angle, and the noise
    assert np.hypot(error[0], error[1]) < 0.06
    assert abs(error[2]) < 0.02
    assert found.best.score > 0.5
    assert found.second is None or found.second.score < 0.85 * found.best.score
    # nearly all of the poses are never looked at
    poses = len(branch_and_bound.angles(points, pyramid.resolution, np.pi)) * 121**2
    assert found.lookups < 0.05 * poses * len(points)


def test_symmetric_box_has_a_second_place_as_good(points):
    submap = built(BOX, np.zeros((1, 3)))
    pyramid = Pyramid(submap)
    seen = thin(scan(BOX, TRUE, 360), 0.05, 300)
    found = searched(pyramid, seen, np.zeros(3), 1.0, np.pi)
    opposite = np.array([-TRUE[0], -TRUE[1], TRUE[2] - np.pi])
    for expected in (TRUE, opposite):
        errors = [np.abs(se2.between(expected, c.pose)) for c in (found.best, found.second)]
        assert min(e.max() for e in errors) < 0.08
    assert found.second.score > 0.9 * found.best.score


def test_score_below_the_minimum_is_no_candidate(pyramid):
    noise = np.random.default_rng(0).uniform(-2, 2, size=(100, 2))
    assert searched(pyramid, noise, np.zeros(3), 0.5, 0.2, min_score=0.6).best is None
    with pytest.raises(InputError, match='no points'):
        searched(pyramid, np.zeros((0, 2)), np.zeros(3), 0.5, 0.2)


@pytest.mark.parametrize('side', [8, 4, 2])
def test_levels_bound_the_blocks_below_them(pyramid, side):
    v = pyramid.levels
    level = {8: v.eight, 4: v.four, 2: v.two}[side]
    cells = v.cells[: len(v.cells) - search_pyramid.LANES].reshape(-1, v.columns).astype(int)
    rng = np.random.default_rng(side)
    for _ in range(200):
        i, j = rng.integers(0, np.array(cells.shape) - 100)
        extent = 0 if side == 2 else int(rng.integers(30))
        at = search_pyramid.place(level, i, j, extent)
        assert at >= 0
        value = level.data[at] & 15
        block = cells[i : i + side + extent, j : j + side + extent]
        # no less than the largest cell of the block, and no more than that of a wider window
        assert 17 * value >= block.max()
        if value:
            size = next(w for w in level.windows if w >= side + extent + level.phase - 1)
            wider = cells[max(i - 1, 0) : i + size + 1, max(j - 1, 0) : j + size + 1]
            assert 17 * (value - 1) < wider.max()
        if side < 8:  # the value of the row of blocks below is in the upper bits
            assert level.data[at] >> 4 == level.data[at + level.columns] & 15


def test_points_that_move_too_far_within_a_block_count_as_hits(pyramid):
    assert search_pyramid.place(pyramid.levels.eight, 80, 80, 100) == -1
    near = 0.2 * np.random.default_rng(0).standard_normal((40, 2)) + [1.0, 0.0]
    far = np.vstack([near, [[60.0, 0.0], [0.0, -80.0]]])  # of cells that angles move by hundreds
    window, least = (0.5, np.pi), {'second_share': 0.0}
    pose = np.zeros(3)
    thetas = branch_and_bound.angles(far, pyramid.resolution, np.pi)
    sums = brute_force_far(pyramid, far, pose, 10, thetas)
    found = searched(pyramid, far, pose, *window, **least)
    assert found.best.score == pytest.approx(score(sums.max(), len(far)), abs=1e-12)


def brute_force_far(pyramid, points, pose, n, thetas):
    """As brute_force(), of points of which some are far outside."""
    grid = cells_of(pyramid).astype(np.int64)
    rows, columns = grid.shape
    sums = np.zeros((len(thetas), 2 * n + 1, 2 * n + 1), dtype=np.int64)
    for a, theta in enumerate(thetas):
        at = se2.transform(pose + np.array([0.0, 0.0, theta]), points)
        cells = np.floor(at / pyramid.resolution).astype(int) - pyramid.corner
        for i in range(-n, n + 1):
            for j in range(-n, n + 1):
                q, r = cells[:, 0] + j, cells[:, 1] + i
                inside = (q >= 0) & (q < columns) & (r >= 0) & (r < rows)
                sums[a, i + n, j + n] = grid[r[inside], q[inside]].sum()
    return sums


@pytest.mark.parametrize('far', [np.nan, np.inf, 1e9, 1e300])
def test_points_that_no_beam_reaches_cost_bounded_work(pyramid, points, far):
    moved = points + np.array([far, 0.0])
    thetas = branch_and_bound.angles(moved, pyramid.resolution, np.pi)
    assert len(thetas) < 100_000
    assert len(branch_and_bound.angles(points, pyramid.resolution, np.pi)) < 1000


@pytest.mark.parametrize('far', [np.nan, np.inf, 1e9, -1e9, 2.0**32 * 0.05, 1e300])
def test_point_that_is_in_no_grid_meets_no_cell(pyramid, points, far):
    """2^32 cells further on is no cell of the grid, though 32 bits are the same."""
    mixed, away = (
        np.vstack([points, points[::8] + np.array([x, 0.0])]) for x in (far, 500.0)
    )  # fmt: skip
    window = Window(TRUE, (0.5, 0.5), 0.1)
    thetas = branch_and_bound.angles(points, pyramid.resolution, 0.1)
    sums = []
    for of in (mixed, away):
        lattice = branch_and_bound.lattice_of(pyramid, of, window, thetas)
        found = np.full((2, 4), -1, dtype=np.int64)
        endless = branch_and_bound.ENDLESS
        goal = Goal(-1, 0.0, 0.7, 10.0, 10.0, False, endless, -1, endless)
        search(pyramid.levels, lattice, goal, found)
        sums.append(found[0])
    np.testing.assert_array_equal(*sums)
    # nor does a pose
    found = searched(pyramid, points, np.array([far, 0.0, 0.0]), 0.5, 0.1)
    assert found.best is None or found.best.score == pytest.approx(P_MIN)


def test_sums_of_many_points_do_not_overflow(pyramid, points):
    many = np.tile(points, (6, 1))
    few, all_ = (searched(pyramid, p, TRUE, 0.5, 0.1) for p in (points, many))
    np.testing.assert_array_equal(few.best.pose, all_.best.pose)
    assert few.best.score == pytest.approx(all_.best.score, abs=1e-12)


def test_window_around_another_lattice_point_finds_the_same(pyramid, points):
    start = np.array([-1.0, 1.0, -2.0])
    whole = searched(pyramid, points, start, 3.0, np.pi)
    shifted = searched(pyramid, points, start + np.array([0.5, -0.5, 0.0]), 3.0, np.pi)
    assert shifted.best.score == pytest.approx(whole.best.score, abs=1e-12)
    np.testing.assert_allclose(shifted.best.pose, whole.best.pose, atol=1e-9)


def test_window_of_mapped_places_leaves_out_what_nobody_saw(pyramid, points):
    def far(mapped):
        pose = np.array([40.0, 0.0, 0.0])
        return wide(pyramid, points, Window(pose, (5.0, 3.0), np.pi, mapped))

    assert far(False).lookups > 0
    assert far(True).lookups == 0
    everywhere = Window(np.zeros(3), (40.0, 30.0), np.pi)
    found = [wide(pyramid, points, replace(everywhere, mapped=m)) for m in (False, True)]
    np.testing.assert_array_equal(found[0].best.pose, found[1].best.pose)
    assert found[1].lookups < 0.8 * found[0].lookups


def test_search_ends_when_its_budget_does(pyramid, points):
    whole = searched(pyramid, points, np.zeros(3), 3.0, np.pi)
    assert whole.complete
    assert searched(pyramid, points, np.zeros(3), 3.0, np.pi, budget=whole.lookups).complete
    for share in (0.99, 0.3):  # ends while blocks are divided, while the first are bounded
        budget = int(share * whole.lookups)
        cut = searched(pyramid, points, np.zeros(3), 3.0, np.pi, budget=budget)
        assert not cut.complete
        # a block at most beyond it
        assert cut.lookups < budget + 200 * len(points)


def test_weak_ones_are_found_in_the_same_search_and_only_within_their_budget(pyramid, points):
    def of(**criteria):
        return searched(pyramid, points, np.zeros(3), 3.0, np.pi, **criteria)

    best = of(min_score=0.1).best
    usual = of(min_score=best.score + 0.05)
    assert usual.best is None  # so it is a weak one
    weak = of(min_score=best.score + 0.05, weak_score=best.score - 0.05)
    np.testing.assert_array_equal(weak.best.pose, best.pose)
    assert weak.second is None
    # no more look-ups than without weak ones, as soon as the budget is used up
    cut = of(min_score=best.score + 0.05, weak_score=best.score - 0.05, weak_budget=0)
    assert cut.best is None
    assert cut.complete
    assert cut.lookups == pytest.approx(usual.lookups, rel=0.05)


@pytest.mark.parametrize('weak_budget', [0, 100_000, branch_and_bound.ENDLESS])
def test_usual_pose_and_second_one_are_the_same_where_weak_ones_are_looked_for(
    pyramid, points, weak_budget
):
    start, span = np.zeros(3), (3.0, np.pi)
    usual = searched(pyramid, points, start, *span, min_score=0.4, second_share=0.5)
    also = searched(
        pyramid, points, start, *span, min_score=0.4, second_share=0.5, weak_score=0.2,
        weak_budget=weak_budget,
    )  # fmt: skip
    assert usual.second is not None
    for one, other in ((usual.best, also.best), (usual.second, also.second)):
        assert one.score == other.score
        np.testing.assert_array_equal(one.pose, other.pose)


def test_search_is_the_same_to_the_last_bit(room, points):
    results = [searched(Pyramid(room), points, np.zeros(3), 1.0, np.pi) for _ in range(2)]
    assert results[0].best.pose.tobytes() == results[1].best.pose.tobytes()
    assert results[0].lookups == results[1].lookups
