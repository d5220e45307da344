# SPDX-License-Identifier: Apache-2.0
"""Suggested posts close no way: what a robot could reach stays joined, and a path stays free."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from rlml_slam.planning import site as sites
from rlml_slam.planning.free_ways import MARGIN, leave_ways
from rlml_slam.planning.mounts import out_of_the_way, wall_mounts
from rlml_slam.planning.site import DIAMETER, Site
from rlml_slam.se2 import Array
from rlml_slam.simulation.world_file import parse_world

HALF = 0.3  # [m] of the robot


def corridor(width: float) -> Site:
    """From (0, 0) to (8, width)."""
    return sites.of_world(parse_world(
        f'start: [1, {width / 2}, 0.0]\nroute: [[1, {width / 2}], [2, {width / 2}]]\n'
        f'walls: [{{points: [[0, 0], [8, 0], [8, {width}], [0, {width}]], closed: true}}]\n'
        'reflectors: []', 'corridor'))  # fmt: skip


def rooms(seed: int) -> Site:
    """Two rooms with a door of 0.5 to 1.1 m, and a box that leaves as much beside it."""
    rng = np.random.default_rng(seed)
    wide, high, door, gap = *rng.uniform(3.0, 4.0, 2), *rng.uniform(0.5, 1.1, 2)
    x, y, size = wide / 2, rng.uniform(0.3, high - 1.4), high - 2.4
    return sites.of_world(parse_world(
        f'start: [0.5, {high - 0.5}, 0.0]\nroute: [[0.5, {high - 0.5}], [0.6, {high - 0.5}]]\n'
        f'walls: [{{points: [[0, 0], [{wide}, 0], [{wide}, {high}], [0, {high}]], closed: true}},'
        f' {{points: [[{x}, 0], [{x}, {y}]]}}, {{points: [[{x}, {y + door}], [{x}, {high}]]}}]\n'
        f'boxes: [{{at: [{x + gap + 0.3}, {high / 2}], size: [0.6, {size}], '
        f'yaw: {rng.uniform(-0.1, 0.1)}}}]\nreflectors: []', 'rooms'))  # fmt: skip


def parts(site: Site, posts: Array) -> int:
    """Parts into which posts break what a robot reaches, on a grid of 1 cm, by exact distances."""
    x, y = np.meshgrid(*(np.arange(0.0, 4.0, 0.01),) * 2)
    points = np.stack([x.ravel(), y.ravel()], -1)
    ends = site.walls.segments[:, :4].reshape(-1, 2)
    before = (points > ends.min(axis=0)).all(axis=1) & (points < ends.max(axis=0)).all(axis=1)
    for a, b in ends.reshape(-1, 2, 2):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        before &= np.hypot(*(a + share[:, None] * (b - a) - points).T) >= HALF
    gap = np.hypot(*(points[:, None] - posts).transpose(2, 0, 1)).min(axis=1)
    label, count = ndimage.label(before.reshape(x.shape))
    after = (before & (gap >= HALF + 0.5 * DIAMETER)).reshape(x.shape)
    more = 0
    for k in range(1, count + 1):
        left, n = ndimage.label(after & (label == k))
        more += max(int((np.bincount(left.ravel(), minlength=n + 1)[1:] > 200).sum()) - 1, 0)
    return more


def test_posts_on_both_sides_of_doors_and_gaps_leave_them_free():
    refused = closed = 0
    for seed in range(12):
        site = rooms(seed)
        on_walls = wall_mounts(site, 0.7, HALF)
        assert len(on_walls) > 15
        assert parts(site, on_walls) == 0, seed
        on_all = wall_mounts(site, 0.7, 0.0)  # as if robots were points
        refused += len(on_all) - len(on_walls)
        closed += parts(site, on_all) > 0
    assert refused > 10
    assert closed > 3  # what is refused matters


@pytest.mark.parametrize('width', [1.1, 1.2, 1.3, 2.0])
def test_free_standing_post_leaves_the_width_of_a_robot_on_one_side(width):
    """A gap of 0.585 m to the centres of cells is none of 0.6 m."""
    site, y = corridor(width), np.linspace(0.05, width - 0.05, 60)
    for x in (4.0, 4.013, 4.03):
        posts = np.stack([np.full(60, x), y], -1)
        allowed = np.array([leave_ways(site, post[None], HALF)[0] for post in posts])
        beside = np.maximum(y, width - y) - 0.5 * DIAMETER
        assert not allowed[beside < 2.0 * HALF].any()
        assert allowed[beside > 2.0 * HALF + 0.1].all()


def test_posts_that_close_a_way_only_together_are_not_all_taken():
    for width, allowed in ((3.4, True), (2.2, False)):
        posts = np.array([[4.0, share * width] for share in (0.25, 0.5, 0.75)])
        site = corridor(width)
        assert all(leave_ways(site, post[None], HALF)[0] for post in posts)
        assert leave_ways(site, posts, HALF).tolist() == [True, True, allowed]


def test_present_reflectors_narrow_a_way_too():
    site, post = corridor(1.6), np.array([[4.0, 0.15]])
    assert leave_ways(site, post, HALF).all()
    assert not leave_ways(site.with_posts(np.array([[4.0, 0.8]])), post, HALF).any()


def test_path_is_kept_free_between_its_poses_too():
    site = corridor(2.0)
    path = np.array([[0.5, 0.45], [7.5, 0.45]])
    free = wall_mounts(site, 0.5, HALF, path)
    assert 10 < len(free) < len(wall_mounts(site, 0.5, HALF))
    ahead = (free[:, 0] > 0.5) & (free[:, 0] < 7.5)
    assert free[ahead, 1].min() >= 0.45 + HALF + 0.5 * DIAMETER + MARGIN
    poles = np.array([[4.0, 0.8], [4.0, 0.9]])
    np.testing.assert_array_equal(out_of_the_way(site, poles, HALF, path), poles[1:])
