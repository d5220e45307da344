# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rlml_lab.studies.study_front_end import system
from rlml_lab.support.drives import feed, simulate
from rlml_slam.params import SimulatorParameters, from_mapping
from rlml_slam.simulation.simulation import START
from rlml_slam.slam.front_end.degeneracy import Degeneracy
from rlml_slam.types import Level

STRONG = 1e6  # [1/m^2, 1/rad^2]
BARE = """
start: [0.0, 0.0, 0.0]
route: [[0.0, 0.0], [60.0, 0.1]]
walls:
  - {points: [[95.0, -1.2], [-35.0, -1.2]]}
  - {points: [[-35.0, 1.2], [95.0, 1.2]]}
"""
POSTS = """
boxes:
"""
POST = '  - {{at: [{:.2f}, {:.2f}], size: [0.1, 0.1]}}\n'


def held_across(direction):
    """Information (3, 3) of a match that leaves one direction (3,) open."""
    d = np.array(direction) / np.linalg.norm(direction)
    return STRONG * (np.eye(3) - np.outer(d, d))


def noisy(rng, angle=0.4):
    return np.array([np.cos(angle), np.sin(angle), 0.0]) + 1e-3 * rng.standard_normal(3)


def test_noise_of_many_normals_does_not_hold_a_pose_along_the_wall():
    rng, steady = np.random.default_rng(0), Degeneracy()
    raw = [held_across(noisy(rng)) for _ in range(2000)]
    sums = np.array(
        [np.sum(raw[1000:], 0), np.sum([steady.cleared(H, 0.0) for H in raw][1000:], 0)]
    )
    least = np.linalg.eigvalsh(sums)[:, 0]
    # the noise of two directions squared, by 1000 scans; then that of a mean of as many
    assert least[0] > 500.0 * STRONG * 1e-6
    assert least[1] < 0.02 * least[0]


def test_a_direction_is_of_the_map_while_submaps_are_turned():
    steady = Degeneracy()
    for heading in (0.0, 0.53, -1.0):
        open_ = np.array([np.cos(0.4 - heading), np.sin(0.4 - heading), 0.0])
        cleared = steady.cleared(held_across(open_), heading)
        np.testing.assert_allclose(cleared @ open_, 0.0, atol=1e-6 * STRONG)


def test_another_wall_begins_anew():
    steady = Degeneracy()
    steady.cleared(held_across([1.0, 0.0, 0.0]), 0.0)
    H = held_across([np.cos(0.1), np.sin(0.1), 0.0])
    np.testing.assert_allclose(steady.cleared(H, 0.0), H, atol=1e-6 * STRONG)


def test_what_holds_all_directions_is_left_as_it_is():
    H = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(Degeneracy().cleared(H, 0.3), H)


def driven(world, p, seed, seconds):
    """Errors along and across (n, 2), sigmas along and levels (n,) of a drive on scans alone."""
    p = from_mapping({'world': str(world), **p}, SimulatorParameters)
    messages, truth = simulate(p, seed)
    messages = [m for m in messages if m.stamp < START + seconds * 1_000_000_000]
    frames = [f for some in feed(system(p, {}, 'scan alone'), messages) for f in some]
    true = truth.trajectory
    at = np.searchsorted(true.stamps, [f.stamp for f in frames])
    errors = np.abs([f.T_map_base[:2] for f in frames] - true.poses[at, :2])
    sigmas = np.sqrt([f.cov_map[0, 0] for f in frames])
    return errors, sigmas, np.array([f.health.level for f in frames])


@pytest.mark.parametrize('seed', [0, 1])
def test_robot_without_odometry_in_a_bare_corridor_says_that_it_is_lost(tmp_path, seed):
    world = tmp_path / 'bare.yaml'
    world.write_text(BARE)
    errors, sigmas, levels = driven(world, {}, seed, 7)
    assert errors[:, 0].max() > 3.0
    assert errors[levels == Level.OK, 0].max() < 0.05
    assert levels[-1] == Level.LOST
    assert (errors[5:, 0] < 3.0 * sigmas[5:]).all()
    # and across it, it is not
    assert errors[:, 1].max() < 0.02


@pytest.mark.parametrize('seed', [0, 1])
def test_posts_that_look_alike_do_not_tell_such_a_robot_where_it_is(tmp_path, seed):
    rng = np.random.default_rng(seed)
    posts = [
        POST.format(x, 1.15 * side)
        for side in (-1, 1)
        for x in np.cumsum(rng.uniform(4.0, 12.0, 12)) - 35.0
    ]
    world = tmp_path / 'posts.yaml'
    world.write_text(BARE + POSTS + ''.join(posts))
    laser = {'laser.beams': 360, 'laser.range_max': 12.0, 'speed': 1.0}
    errors, sigmas, levels = driven(world, laser, seed, 20)
    assert errors[:, 0].max() > 3.0
    assert errors[levels == Level.OK, 0].max() < 1.0
    known = levels != Level.LOST
    assert (errors[known, 0][5:] < 3.0 * sigmas[known][5:]).all()
    assert (levels[-20:] == Level.LOST).all()
