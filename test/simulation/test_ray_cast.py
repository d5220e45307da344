# SPDX-License-Identifier: Apache-2.0
import time

import numpy as np
import pytest

from rlml_slam.simulation.ray_cast import NO_OBJECT, cast
from rlml_slam.simulation.world import NOTHING, Geometry
from rlml_slam.simulation.world_file import load_world


def oracle(origins, angles, tau, geometry, max_range):
    """Every ray against every object, by solving o + t d = a + u e and |o + t d - c| = r."""
    d = np.stack([np.cos(angles), np.sin(angles)], -1)[:, None]
    columns = []
    s = geometry.segments[None]
    q = s[..., :2] + s[..., 4:6] * tau[:, None, None] - origins[:, None]
    e = s[..., 2:4] - s[..., :2]
    with np.errstate(divide='ignore', invalid='ignore'):
        det = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
        t = (q[..., 0] * e[..., 1] - q[..., 1] * e[..., 0]) / det
        u = (q[..., 0] * d[..., 1] - q[..., 1] * d[..., 0]) / det
        columns.append(np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf))
        c = geometry.discs[None]
        q = c[..., :2] + c[..., 3:5] * tau[:, None, None] - origins[:, None]
        b = (q * d).sum(-1)
        t = b - np.sqrt(b * b - (q * q).sum(-1) + c[..., 2] ** 2)
        columns.append(np.where(t > 0, t, np.inf))
    t = np.concatenate(columns, 1)
    t[t >= max_range] = np.inf
    best = t.min(1)
    return best, np.where(np.isinf(best), NO_OBJECT, t.argmin(1))


def random_scene(rng, segments, discs):
    a = rng.uniform(-10, 10, (segments, 2))
    s = np.concatenate(
        [a, a + rng.normal(0, 3, (segments, 2)), rng.normal(0, 1, (segments, 2))], 1
    )
    c = np.concatenate(
        [rng.uniform(-10, 10, (discs, 2)), rng.uniform(0.02, 1.0, (discs, 1)),
         rng.normal(0, 1, (discs, 2))], 1
    )  # fmt: skip
    return Geometry(s, c, np.zeros((segments + discs, 4)))


@pytest.mark.parametrize('seed', range(20))
def test_hits_are_those_of_trying_everything(seed):
    rng = np.random.default_rng(seed)
    geometry = random_scene(rng, rng.integers(0, 40), rng.integers(0, 20))
    n = int(rng.integers(2, 400))
    start = rng.uniform(-20, 20)
    angles = start + np.linspace(0, rng.uniform(0.1, 6.6), n)
    angles += rng.choice([0.0, 0.01]) * rng.normal(size=n)
    origins = rng.uniform(-9, 9, 2) + np.linspace(0, 1, n)[:, None] * rng.normal(0, 0.2, 2)
    tau = np.linspace(-0.05, 0.05, n)
    ranges, objects, cosines = cast(origins, angles, tau, geometry, 12.0)
    want, which = oracle(origins, angles, tau, geometry, 12.0)
    np.testing.assert_allclose(ranges, want, rtol=1e-9, atol=1e-9)
    assert np.array_equal(objects, which)
    assert (np.abs(cosines) <= 1.0 + 1e-12).all()
    assert (cosines[objects == NO_OBJECT] == 0.0).all()


@pytest.mark.parametrize('seed', range(5))
def test_unsorted_angles_over_many_turns_are_right_too(seed):
    rng = np.random.default_rng(seed)
    geometry = random_scene(rng, 15, 8)
    angles = rng.uniform(-50, 50, 100)
    origins = rng.uniform(-5, 5, (100, 2))
    ranges, objects, _ = cast(origins, angles, np.zeros(100), geometry, 30.0)
    want, which = oracle(origins, angles, np.zeros(100), geometry, 30.0)
    np.testing.assert_allclose(ranges, want, rtol=1e-9, atol=1e-9)
    assert np.array_equal(objects, which)


def test_the_cosine_is_signed_by_the_side_that_is_hit():
    wall = Geometry(np.array([[-5.0, 0, 5, 0, 0, 0]]), np.zeros((0, 5)), np.zeros((1, 4)))
    origins = np.array([[0.0, 2.0], [0.0, -2.0]])  # left of the wall's direction, and right
    angles = np.array([-np.pi / 2, np.pi / 3])
    _, objects, cosines = cast(origins, angles, np.zeros(2), wall, 30.0)
    assert list(objects) == [0, 0]
    np.testing.assert_allclose(cosines, [1.0, -np.cos(np.pi / 6)], atol=1e-12)


def test_nothing_there_is_nothing_hit():
    ranges, objects, _ = cast(np.zeros((3, 2)), np.arange(3.0), np.zeros(3), NOTHING, 30.0)
    assert np.isinf(ranges).all()
    assert (objects == NO_OBJECT).all()
    assert len(cast(np.zeros((0, 2)), np.zeros(0), np.zeros(0), NOTHING, 30.0)[0]) == 0


def test_a_point_like_segment_is_harmless():
    dot = Geometry(np.array([[1.0, 0, 1, 1e-9, 0, 0]]), np.zeros((0, 5)), np.zeros((1, 4)))
    ranges, _, _ = cast(np.zeros((8, 2)), np.linspace(0.1, 6, 8), np.zeros(8), dot, 30.0)
    assert np.isinf(ranges).all()


def test_1440_beams_in_the_hall_take_at_most_a_millisecond():
    geometry = load_world('hall').geometry(0.0)
    angles = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
    origins, tau = np.linspace([6, 7.4], [6.1, 7.4], 1440), np.linspace(-0.05, 0.05, 1440)
    times = []
    for _ in range(30):
        start = time.perf_counter()
        cast(origins, angles, tau, geometry, 30.0)
        times.append(time.perf_counter() - start)
    assert min(times) < 1e-3  # the best of them, for the machine may be busy; about 0.06 ms
