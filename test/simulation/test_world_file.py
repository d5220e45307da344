# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import FileFormatError
from rlml_slam.simulation.world import REFLECTOR, RETRO
from rlml_slam.simulation.world_file import load_world, parse_world, world_names

MINIMAL = """
start: [0, 0, 0]
route: [[0, 0], [1, 0]]
"""


def test_the_package_brings_the_four_worlds():
    assert {'hall', 'corridor', 'symmetric', 'yard'} <= set(world_names())


@pytest.mark.parametrize('name', world_names())
def test_every_world_of_the_package_loads_and_says_what_it_is(name):
    world = load_world(name)
    assert world.name == name
    assert world.description
    geometry = world.geometry(0.0)
    assert len(geometry.surface) == len(geometry.segments) + len(geometry.discs)
    # every reflector has exactly one object, and only reflectors are retro-reflective
    marked = geometry.surface[:, REFLECTOR]
    assert sorted(marked[marked >= 0]) == list(range(len(world.reflectors)))
    assert np.array_equal(geometry.surface[:, RETRO] > 0, marked >= 0)
    assert np.hypot(*(world.route[0] - world.start[:2])) < 0.1


def test_hall_closes_its_loop_and_has_reflectors_enough():
    world = load_world('hall')
    assert 12 <= len(world.reflectors) <= 20
    length = np.hypot(*np.diff(world.route, axis=0).T).sum()
    assert 85.0 < length < 110.0
    again = np.hypot(*(world.route[1:] - world.start[:2]).T)
    assert again.min() < 0.5


def test_symmetric_hall_is_itself_after_half_a_turn():
    world = load_world('symmetric')
    turned = se2.transform(np.array([0.0, 0.0, math.pi]), world.reflectors.points)
    for p in turned:
        assert np.hypot(*(world.reflectors.points - p).T).min() < 1e-9
    ends = world.static.segments[:, :4]
    for segment in -ends:
        assert np.abs(ends - segment).sum(1).min() < 1e-9


def test_corridor_shows_reflectors_both_ways_at_both_ends_of_the_route():
    world = load_world('corridor')
    x = world.reflectors.points[:, 0]
    for end in world.route[[0, -1], 0]:
        assert ((x < end) & (x > end - 20.0)).any()
        assert ((x > end) & (x < end + 20.0)).any()
    assert len(load_world('yard').static.segments) == 0


def test_a_world_file_is_loaded_by_its_path(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text(MINIMAL)
    assert load_world(path).name == 'mine'
    assert len(load_world(str(path)).reflectors) == 0


@pytest.mark.parametrize(
    ('text', 'match'),
    [
        ('[1, 2', 'not YAML'),
        ('just text', 'is not a mapping'),
        ('start: [0, 0, 0]', 'route is missing'),
        ('start: [0, 0]\nroute: [[0, 0]]', 'start is not 3 finite numbers'),
        ('start: [0, 0, .nan]\nroute: [[0, 0]]', 'start is not 3 finite numbers'),
        ('start: [0, 0, x]\nroute: [[0, 0]]', 'start is not an array of numbers'),
        ('start: [0, 0, 0]\nroute: [[0, 0], [0, 0]]', 'same point twice'),
        (MINIMAL + 'wals: []', "'wals' is unknown; known are"),
        (MINIMAL + 'walls: {}', 'walls is not a list'),
        (MINIMAL + 'walls: [1]', r'walls\[0\]: is not a mapping'),
        (MINIMAL + 'walls: [{points: [[0, 0]]}]', r'walls\[0\]: points has fewer than 2'),
        (MINIMAL + 'walls: [{points: [[0, 0], [1, 1, 1]]}]', r'points is not an array'),
        (MINIMAL + 'walls: [{points: [[0, 0], [1, 1]], glossy: 3}]', 'glossy = 3 is not true'),
        (MINIMAL + 'walls: [{points: [[0, 0], [1, 1]], reflectance: 3}]', r'outside \[0, 1\]'),
        (MINIMAL + 'boxes: [{at: [0, 0], size: [1, -1]}]', r'boxes\[0\]: size is not positive'),
        (MINIMAL + 'pillars: [{at: [0, 0]}]', r'pillars\[0\]: diameter is missing'),
        (MINIMAL + 'pillars: [{at: [0, 0], diameter: big}]', 'is not a number'),
        (MINIMAL + f'pillars: [{{at: [0, 0], diameter: {10**400}}}]', r'diameter is outside \['),
        (MINIMAL + f'pillars: [{{at: [0, {10**400}], diameter: 1}}]', 'at is not an array'),
        (MINIMAL + 'reflectors: [{at: [0, 0]}]', 'diameter or else width'),
        (MINIMAL + 'reflectors: [{at: [0, 0], width: 0.1}]', 'normal is missing'),
        (MINIMAL + 'reflectors: [{at: [0, 0], width: 0.1, normal: [0, 0]}]', 'normal is zero'),
        (
            MINIMAL + 'reflectors: [{at: [0, 0], diameter: 0.1, id: 3}, '
            '{at: [0, 1], diameter: 0.1, id: 3}]',
            r'reflectors\[1\]: id = 3 is used twice',
        ),
        (MINIMAL + 'movers: [{shape: cone, route: [[0, 0], [1, 1]]}]', "'cone' is none of disc"),
        (MINIMAL + 'movers: [{diameter: 1, speed: 1, route: [[0, 0]]}]', 'fewer than 2 points'),
        (
            MINIMAL + 'movers: [{diameter: 1, speed: 1, route: [[0, 0], [1, 1], [0, 0]]}]',
            'closes by itself',
        ),
    ],
)  # fmt: skip
def test_a_bad_world_file_is_refused_with_its_place(tmp_path, text, match):
    with pytest.raises(FileFormatError, match=match):
        parse_world(text, 'bad')
    path = tmp_path / 'bad.yaml'
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r'bad\.yaml: '):
        load_world(path)


def test_an_unknown_world_is_refused_with_the_known_ones():
    with pytest.raises(FileFormatError, match='no such world; there are corridor, hall'):
        load_world('hal')
    with pytest.raises(FileFormatError, match='cannot be read: No such file'):
        load_world('missing.yaml')


def test_a_mover_goes_round_its_route_at_its_speed():
    text = MINIMAL + (
        'movers: [{shape: box, size: [2, 1], route: [[0, 0], [4, 0], [4, 3]], speed: 2, start: 1}]'
    )
    mover = parse_world(text, 'w').movers[0]
    pose, velocity = mover.pose_at(0.0)
    np.testing.assert_allclose(pose, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(velocity, [2.0, 0.0])
    pose, velocity = mover.pose_at(2.5)  # 6 m on: 2 m up the second leg
    np.testing.assert_allclose(pose, [4.0, 2.0, math.pi / 2])
    np.testing.assert_allclose(mover.pose_at(6.0)[0], pose * 0 + [1.0, 0.0, 0.0], atol=1e-12)
    corners = mover.geometry(0.0).segments[:, :2]
    assert sorted(map(tuple, corners)) == [(0.0, -0.5), (0.0, 0.5), (2.0, -0.5), (2.0, 0.5)]
