# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import yaml

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.occupancy import OccupancyGrid, load, render, save

POSES = np.array([[0.05, 0.05, 0.0], [0.05, 0.05, np.pi / 2]])
WALL = np.stack([np.full(21, 2.0), np.linspace(-1.0, 1.0, 21)], -1)


def rendered() -> OccupancyGrid:
    return render(POSES, [WALL, WALL], [np.zeros(2), np.zeros(2)], 0.1)


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    j = int(np.floor((x - grid.origin[0]) / grid.resolution))
    i = int(np.floor((y - grid.origin[1]) / grid.resolution))
    return int(grid.cells[i, j])


def test_walls_are_occupied_rays_free_and_the_rest_unknown():
    grid = rendered()
    assert at(grid, 2.05, 0.05) == 100
    assert at(grid, 0.05, 2.05) == 100  # the same wall, seen from the turned pose
    assert at(grid, 1.0, 0.05) == 0
    assert at(grid, 2.15, 0.05) == -1
    assert at(grid, -0.1, -0.1) == -1
    assert set(np.unique(grid.cells)) <= set(range(-1, 101))


def test_cell_that_beams_only_cross_now_and_then_end_in_is_not_a_wall():
    ghosts = [np.array([[1.0, 0.0]])] + [np.array([[3.0, 0.0]])] * 19
    poses = np.tile([0.05, 0.05, 0.0], (20, 1))
    grid = render(poses, ghosts, [np.zeros(2)] * 20, 0.1)
    # 1 of 20 beams: 50 * 0.05 / 0.25
    assert at(grid, 1.05, 0.05) == 10
    assert at(grid, 3.05, 0.05) == 100


def test_map_without_scans_is_one_unknown_cell():
    grid = render(np.zeros((0, 3)), [], [], 0.1)
    np.testing.assert_array_equal(grid.cells, [[-1]])
    empty = render(np.zeros((1, 3)), [np.zeros((0, 2))], [np.zeros(2)], 0.1)
    np.testing.assert_array_equal(empty.cells, [[-1]])


def test_poses_that_are_spread_too_wide_are_refused():
    far = np.array([[0.0, 0.0, 0.0], [1e7, 1e7, 0.0]])
    with pytest.raises(MapError, match='too large'):
        render(far, [WALL, WALL], [np.zeros(2)] * 2, 0.1)


def test_saved_map_is_nav2s_and_comes_back(tmp_path):
    grid = rendered()
    pgm, meta = save(grid, tmp_path / 'floor.1')
    assert (pgm.name, meta.name) == ('floor.1.pgm', 'floor.1.yaml')
    description = yaml.safe_load(meta.read_text())
    assert description['image'] == 'floor.1.pgm'
    assert description['mode'] == 'trinary'
    assert description['origin'] == [*grid.origin, 0.0]
    back = load(meta)
    assert (back.resolution, back.origin) == (grid.resolution, grid.origin)
    np.testing.assert_array_equal(back.cells == 100, grid.cells >= 65)
    np.testing.assert_array_equal(
        back.cells == -1, (grid.cells == -1) | (abs(grid.cells - 42) < 23)
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ['floor.1.pgm', 'floor.1.yaml']


def test_first_row_of_the_image_is_the_top_of_the_map(tmp_path):
    cells = np.array([[0, 0, 0], [0, 0, 100]], dtype=np.int8)
    pgm, _ = save(OccupancyGrid(0.1, (0.0, 0.0), cells), tmp_path / 'm')
    assert pgm.read_bytes().endswith(bytes([254, 254, 0, 254, 254, 254]))


def test_saving_replaces_the_old_map_as_a_whole(tmp_path):
    save(OccupancyGrid(0.1, (0.0, 0.0), np.zeros((50, 50), dtype=np.int8)), tmp_path / 'm')
    save(OccupancyGrid(0.1, (1.0, 0.0), np.zeros((2, 3), dtype=np.int8)), tmp_path / 'm')
    back = load(tmp_path / 'm.yaml')
    assert back.cells.shape == (2, 3)
    assert back.origin == (1.0, 0.0)


def test_map_that_cannot_be_written_or_read_says_where(tmp_path):
    with pytest.raises(MapError, match=r'm\.pgm: cannot be written'):
        save(rendered(), tmp_path / 'missing' / 'm')
    with pytest.raises(MapError, match=r'm\.yaml: cannot be read'):
        load(tmp_path / 'm.yaml')


@pytest.mark.parametrize(
    ('file', 'text'),
    [
        ('m.yaml', b'image: [unclosed'),
        ('m.yaml', b'just words'),
        ('m.yaml', b'image: m.pgm\nresolution: 0.1\n'),
        ('m.yaml', b'image: m.pgm\nresolution: -1\norigin: [0, 0, 0]\n'
                   b'occupied_thresh: 0.65\nfree_thresh: 0.2\n'),
        ('m.pgm', b'P2\n2 2\n255\n0 0 0 0\n'),
        ('m.pgm', b'P5\n2 2\n255\n\x00\x00\x00'),
    ],
)  # fmt: skip
def test_malformed_file_is_named(tmp_path, file, text):
    save(rendered(), tmp_path / 'm')
    (tmp_path / file).write_bytes(text)
    with pytest.raises(FileFormatError, match=file):
        load(tmp_path / 'm.yaml')
