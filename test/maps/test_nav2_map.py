# SPDX-License-Identifier: Apache-2.0
"""Grids in the files of nav2's map_server, ours and those of others."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from PIL import Image
from test_occupancy import rendered

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.nav2_map import describe, load, save
from rlml_slam.maps.occupancy import OccupancyGrid

# a wall, free, unknown, and a shade between the thresholds
GREY = np.array([[0, 254, 205], [254, 254, 150]], dtype=np.uint8)
HEAD = {
    'image': 'm.png', 'resolution': 0.05, 'origin': [-1.0, 2.0, 0.0], 'negate': 0,
    'occupied_thresh': 0.65, 'free_thresh': 0.196,
}  # fmt: skip


def written(folder, image=GREY, name='m.png', **changed):
    """A map as another program writes it; the path of its description."""
    Image.fromarray(image).save(folder / name)
    (folder / 'm.yaml').write_text(yaml.safe_dump(HEAD | {'image': name} | changed))
    return folder / 'm.yaml'


def nav2_cell(pixel, has_alpha, d):
    """A cell by the rules of map_server, for one pixel (r, g, b, a) of 8 bits."""
    r, g, b, a = (v / 255.0 for v in pixel)
    used = (r, g, b, a) if d['mode'] == 'trinary' and has_alpha else (r, g, b)
    shade = sum(used) / len(used)
    occupied = shade if d['negate'] else 1.0 - shade
    if d['mode'] == 'raw':
        return round(255 * shade) if round(255 * shade) <= 100 else -1
    if d['mode'] == 'scale' and a != 1.0:
        return -1
    low, high = d['free_thresh'], d['occupied_thresh']
    if occupied > high:
        return 100
    if occupied < low:
        return 0
    return -1 if d['mode'] == 'trinary' else round(100 * (occupied - low) / (high - low))


@pytest.mark.parametrize('mode', ['trinary', 'scale', 'raw'])
@pytest.mark.parametrize('negate', [0, 1, True, False])
@pytest.mark.parametrize('kind', ['L', 'RGB', 'RGBA', 'LA', 'P'])
def test_cells_are_those_of_map_server(tmp_path, mode, negate, kind):
    rng = np.random.default_rng(4)
    rgba = rng.integers(0, 256, (12, 17, 4), dtype=np.uint8)
    rgba[:6, :, 3] = 255
    image = Image.fromarray(rgba if kind in ('RGBA', 'LA') else rgba[..., :3]).convert(kind)
    meta = written(tmp_path, np.asarray(image.convert('RGBA')), mode=mode, negate=negate)
    image.save(tmp_path / 'm.png')
    d = HEAD | {'mode': mode, 'negate': negate}
    pixels = np.asarray(image.convert('RGBA'))
    expected = [[nav2_cell(v, kind in ('RGBA', 'LA'), d) for v in row] for row in pixels]
    np.testing.assert_array_equal(load(meta).cells, expected[::-1])


@pytest.mark.parametrize('name', ['m.pgm', 'm.png', 'm.bmp'])
def test_formats_hold_the_same_map(tmp_path, name):
    grid = load(written(tmp_path, name=name))
    np.testing.assert_array_equal(grid.cells, [[0, 0, -1], [100, 0, -1]])
    assert (grid.resolution, grid.origin, grid.yaw) == (0.05, (-1.0, 2.0), 0.0)


def test_grey_levels_of_16_bits_and_plain_text_are_read(tmp_path):
    meta = written(tmp_path, (GREY.astype(np.uint16) * 257))
    np.testing.assert_array_equal(load(meta).cells, [[0, 0, -1], [100, 0, -1]])
    (tmp_path / 'p.pgm').write_text('P2\n# edited\n3 2\n255\n0 254 205\n254 254 150\n')
    meta = written(tmp_path, image=GREY, name='other.png', image_='')
    meta.write_text(meta.read_text().replace('other.png', 'p.pgm'))
    np.testing.assert_array_equal(load(meta).cells, [[0, 0, -1], [100, 0, -1]])


def test_origin_has_a_heading(tmp_path):
    grid = load(written(tmp_path, origin=[-1.0, 2.0, 0.5]))
    np.testing.assert_array_equal(grid.T_map_grid, [-1.0, 2.0, 0.5])
    save(grid, tmp_path / 'again')
    np.testing.assert_array_equal(load(tmp_path / 'again.yaml').T_map_grid, grid.T_map_grid)


def test_image_may_be_in_another_folder(tmp_path):
    (tmp_path / 'images').mkdir()
    meta = written(tmp_path, name='images/m.png')
    assert load(meta).cells.shape == (2, 3)
    meta.write_text(meta.read_text().replace('images/', f'{tmp_path}/images/'))
    assert load(meta).cells.shape == (2, 3)


def test_negate_may_be_missing_and_mode_is_trinary(tmp_path):
    meta = written(tmp_path)
    meta.write_text('\n'.join(v for v in meta.read_text().splitlines() if 'negate' not in v))
    assert (describe(meta).negate, describe(meta).mode) == (False, 'trinary')


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
    # map_server requires these, and slam_toolbox writes them
    needed = {'image', 'resolution', 'origin', 'occupied_thresh', 'free_thresh', 'negate', 'mode'}
    assert needed <= description.keys()
    pixels = np.asarray(Image.open(pgm).convert('RGBA'))
    expected = [[nav2_cell(v, False, description) for v in row] for row in pixels]
    np.testing.assert_array_equal(back.cells, expected[::-1])


@pytest.mark.parametrize(
    'name', ['hall #2', 'plant: north', '[a]', '- x', '@x', "'q", 'a"b\\', 'a\nb', '*x', 'Hälle']
)
def test_map_of_any_name_comes_back(name, tmp_path):
    grid = OccupancyGrid(0.1, (0.0, 0.0), np.zeros((2, 3), dtype=np.int8))
    pgm, meta = save(grid, tmp_path / name)
    assert describe(meta).image == pgm
    np.testing.assert_array_equal(load(meta).cells, grid.cells)


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
    ('changed', 'why'),
    [
        ({'image': 'none.png'}, r'none\.png: cannot be read: no such file'),
        ({'image': '/dev/zero'}, r'/dev/zero: cannot be read: no such file'),
        ({'image': '.'}, 'cannot be read: no such file'),
        ({'image': ''}, r'm\.yaml: image is not the name of a file'),
        ({'image': ['m.png']}, r'm\.yaml: image is not the name of a file'),
        ({'image': 'a\0b'}, 'image is not the name of a file'),
        ({'image': 'm.yaml'}, r'm\.yaml: not an image: PGM, PNG, BMP and JPEG are read'),
        ({'resolution': 0}, 'resolution 0 m is not that of a map'),
        ({'resolution': -0.05}, 'resolution -0.05 m'),
        ({'resolution': 'fine'}, 'resolution is not a finite number'),
        ({'resolution': float('nan')}, 'resolution is not a finite number'),
        ({'resolution': 10**400}, 'resolution is not a finite number'),
        ({'origin': [0, 0]}, r'origin has 2 values, 3 are needed: x, y, yaw'),
        ({'origin': 0.0}, r'm\.yaml: '),
        ({'origin': [0, 0, None]}, 'origin is not a finite number'),
        ({'origin': [1e300, 0, 0]}, 'is not on earth'),
        ({'mode': 'color'}, "mode 'color' is none of trinary, scale, raw"),
        ({'negate': 'perhaps'}, 'negate is not a finite number'),
        ({'occupied_thresh': 65}, r'0 <= free_thresh < occupied_thresh <= 1 is needed'),
        ({'free_thresh': 0.7}, r'free_thresh 0\.7 and occupied_thresh 0\.65'),
    ],
)
def test_bad_description_is_one_clear_error(tmp_path, changed, why):
    meta = written(tmp_path)
    meta.write_text(yaml.safe_dump(HEAD | changed))
    with pytest.raises((FileFormatError, MapError), match=why) as e:
        load(meta)
    assert '\n' not in str(e.value)


@pytest.mark.parametrize(
    ('text', 'why'),
    [
        (b'image: [unclosed', 'not a map description'),
        (b'just words', 'not a map description'),
        (b'', 'not a map description'),
        (b'\xff\xfe\x00', 'not a map description'),
        (b'image: m.png\nresolution: 0.1\n', 'origin is missing'),
        (b'a: ' + b'[' * 5000, 'not a map description'),
        (b'#' * 70_000, 'too large to be the description'),
    ],
)
def test_what_is_no_description_is_refused(tmp_path, text, why):
    meta = written(tmp_path)
    meta.write_bytes(text)
    with pytest.raises(FileFormatError, match=rf'm\.yaml: {why}'):
        load(meta)


@pytest.mark.parametrize('name', ['m.pgm', 'm.png', 'm.bmp', 'm.jpg'])
def test_damaged_image_never_ends_in_a_traceback(tmp_path, name):
    """Cut off at any byte, or with any byte changed: an image, or one error that names it."""
    image = np.random.default_rng(1).integers(0, 256, (16, 16), dtype=np.uint8)
    meta = written(tmp_path, image, name)
    good, rng = (tmp_path / name).read_bytes(), np.random.default_rng(2)
    for k in range(300):
        bad = bytearray(good[: rng.integers(len(good))] if k % 3 == 0 else good)
        for _ in range(k % 3 * 2):
            bad[rng.integers(min(len(bad), 200))] = rng.integers(256)
        (tmp_path / name).write_bytes(bad)
        try:
            size, named = load(meta).cells.size, True
        except FileFormatError as e:
            size, named = 1, str(e).startswith(str(tmp_path / name))
        assert named
        assert size


def test_image_that_would_fill_the_memory_is_refused(tmp_path):
    meta = written(tmp_path, name='m.pgm')
    (tmp_path / 'm.pgm').write_bytes(b'P5\n200000 200000\n255\n')
    with pytest.raises(FileFormatError, match='too large for a map'):
        load(meta)


def test_image_that_declares_more_than_the_memory_is_refused(tmp_path, monkeypatch):
    """As the reader of PNG does for a chunk of 2 GB, where there is no room for it."""
    grid = OccupancyGrid(0.05, (0.0, 0.0), np.zeros((4, 4), np.int8))
    _, meta = save(grid, tmp_path / 'a')

    def read(*_, **__):
        raise MemoryError

    monkeypatch.setattr(Image, 'open', read)
    with pytest.raises(FileFormatError, match='damaged image'):
        load(meta)
