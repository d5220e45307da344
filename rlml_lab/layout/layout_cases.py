# SPDX-License-Identifier: Apache-2.0
"""Layouts to plan: small rooms by chance, and a hall of 10 000 m^2."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rlml_slam.simulation.world import World
from rlml_slam.simulation.world_file import load_world, parse_world


def small_room(seed: int) -> World:
    """A room of 6 to 14 by 5 to 10 m with boxes, and up to three reflectors on its walls."""
    rng = np.random.default_rng([29, seed])
    wide, high = rng.uniform(6.0, 14.0), rng.uniform(5.0, 10.0)
    boxes = [
        f'{{at: [{rng.uniform(2.0, wide - 2.0):.2f}, {rng.uniform(2.0, high - 2.0):.2f}], '
        f'size: [{rng.uniform(0.5, 2.0):.2f}, {rng.uniform(0.5, 1.5):.2f}]}}'
        for _ in range(rng.integers(1, 4))
    ]
    posts = [
        [(rng.uniform(0.5, wide - 0.5), 0.1), (wide - 0.1, rng.uniform(0.5, high - 0.5)),
         (rng.uniform(0.5, wide - 0.5), high - 0.1)][k]
        for k in range(rng.integers(0, 4))
    ]  # fmt: skip
    return _world(f'room {seed}', (wide, high), boxes, posts, (0.6, 0.6), (1.2, 0.6))


def large_hall() -> World:
    """A hall of 100 by 100 m with 54 racks and 100 reflectors on them and on its walls."""
    rng = np.random.default_rng(5)
    boxes, posts = [], []
    for x in np.arange(10.0, 95.0, 10.0):
        for y in np.arange(10.0, 95.0, 16.0):
            at, length = x + rng.uniform(-1.0, 1.0), rng.uniform(6.0, 10.0)
            boxes.append(f'{{at: [{at:.2f}, {y + 4.0:.2f}], size: [1.2, {length:.2f}]}}')
            posts.append((at, y + 4.0 + 0.5 * length + 0.1))
    for k in range(100 - len(posts)):
        t = rng.uniform(2.0, 98.0)
        posts.append([(t, 0.1), (t, 99.9), (0.1, t), (99.9, t)][k % 4])
    return _world('large hall', (100.0, 100.0), boxes, posts, (3.0, 3.0), (97.0, 3.0))


def depot() -> World:
    """A hall of 24 by 16 m with two rows of racks and no reflector: the example of the docs."""
    return load_world(Path(__file__).with_name('depot.yaml'))


def _world(
    name: str, size: tuple[float, float], boxes: list[str], posts: list[tuple[float, float]],
    start: tuple[float, float], end: tuple[float, float],
) -> World:  # fmt: skip
    """A rectangular room with its corner in the origin."""
    wide, high = size
    lines = [
        f'start: [{start[0]}, {start[1]}, 0.0]',
        f'route: {[list(p) for p in (start, end)]}',
        f'walls: [{{points: [[0, 0], [{wide}, 0], [{wide}, {high}], [0, {high}]], closed: true}}]',
        f'boxes: [{", ".join(boxes)}]',
        'reflectors: [' + ', '.join(f'{{at: [{x:.2f}, {y:.2f}], diameter: 0.08}}'
                                    for x, y in posts) + ']',
    ]  # fmt: skip
    return parse_world('\n'.join(lines), name)
