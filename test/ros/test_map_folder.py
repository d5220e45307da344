# SPDX-License-Identifier: Apache-2.0
"""Maps by name in one folder."""

import os
import re

import numpy as np
import pytest

from rlml_slam.errors import FileFormatError, MapError, NoMapError
from rlml_slam.maps import nav2_map
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap, newer_image, no_reflectors
from rlml_slam.ros.back_end.map_folder import AUTOSAVE, LOST, LOST_AGE, LOST_BYTES, MapFolder


@pytest.mark.parametrize('name', ['', '..', '../hall', '/etc/hall', 'a/../../hall'])
def test_names_stay_inside_of_the_folder(name, tmp_path):
    with pytest.raises(MapError, match='is not inside of map_directory'):
        MapFolder(str(tmp_path)).path(name)


@pytest.mark.parametrize('name', ['hall', 'file://hall', 'halls/north'])
def test_map_that_is_not_there_is_named_by_the_file_that_it_would_be(name, tmp_path):
    file = name.rpartition('/')[2]
    with pytest.raises(NoMapError, match=rf'there is no {file}\.rlml and no {file}\.csv'):
        MapFolder(str(tmp_path)).load(name)


@pytest.mark.parametrize(
    ('suffix', 'file'),
    [('.rlml', '.rlml'), ('.csv', '.csv'), ('.yaml', '.yaml'), ('.png', '.yaml')],
)
def test_suffix_says_which_file_is_missing(suffix, file, tmp_path):
    with pytest.raises(NoMapError, match=rf'there is no hall\{file}$'):
        MapFolder(str(tmp_path)).load('hall' + suffix)


GRID = OccupancyGrid(0.05, (1.0, 2.0), np.full((3, 3), 100, dtype=np.int8), 0.3)


@pytest.mark.parametrize('name', ['hall', 'hall.yaml', 'hall.pgm'])
def test_map_of_nav2_is_a_map_without_reflectors(name, tmp_path):
    nav2_map.save(GRID, tmp_path / 'hall')
    saved = MapFolder(str(tmp_path)).load(name)
    assert len(saved.reflectors) == 0
    np.testing.assert_array_equal(saved.grid.T_map_grid, [1.0, 2.0, 0.3])


@pytest.mark.parametrize('name', ['hall', 'hall.yaml', 'hall.csv'])
def test_reflectors_beside_the_grid_belong_to_the_map(name, tmp_path):
    folder = MapFolder(str(tmp_path))
    folder.save('hall', SavedMap(no_reflectors(), GRID))
    assert folder.load(name).grid is not None
    (tmp_path / 'hall.csv').write_text('x,y\n1,2\n')
    with pytest.raises(FileFormatError, match='not the columns of a reflector map'):
        folder.load(name)


def test_image_of_an_older_map_is_set_aside_where_the_new_one_has_none(tmp_path):
    folder = MapFolder(str(tmp_path))
    folder.save('hall', SavedMap(no_reflectors(), GRID))
    image = (tmp_path / 'hall.pgm').read_bytes()
    folder.save('hall', SavedMap(no_reflectors()))
    assert folder.load('hall').grid is None
    assert (tmp_path / 'hall.pgm.previous').read_bytes() == image
    assert (tmp_path / 'hall.yaml.previous').exists()


def test_image_that_was_edited_after_the_whole_map_is_pointed_out(tmp_path):
    whole = tmp_path / 'hall.rlml'
    whole.write_bytes(b'')
    assert newer_image(whole) == ''  # there is none
    nav2_map.save(GRID, tmp_path / 'hall')
    os.utime(whole)
    assert newer_image(whole) == ''
    later = whole.stat().st_mtime_ns + 1_000_000
    os.utime(tmp_path / 'hall.pgm', ns=(later, later))
    assert re.search(r'hall\.pgm is newer than hall\.rlml.*name hall\.yaml', newer_image(whole))


def test_only_old_automatic_maps_of_the_name_are_removed(tmp_path):
    folder, now = MapFolder(str(tmp_path)), 2.0 * LOST_AGE
    others = [tmp_path / name for name in ('hall.rlml', 'halls.lost-1.rlml', 'hall.lost-1.csv')]
    young = [folder.free('hall', LOST, 1000 + k) for k in range(20)]
    old = [folder.free('hall', AUTOSAVE, 2000 + k) for k in range(3)]
    for path in (*others, *old, *young):
        path.write_bytes(b'')
        os.utime(path, (now, now) if path in young else (0, 0))
    os.utime(others[0], (1, 1))  # newer than the autosaves
    previous = old[0].with_name(old[0].name + '.previous')
    previous.write_bytes(b'')
    assert folder.make_room('hall', now) == old
    assert {*tmp_path.iterdir()} == {*others, *young}
    assert folder.make_room('hall', now) == []


def aged(path, stamp):
    path.write_bytes(b'')
    os.utime(path, (stamp, stamp))
    return path


@pytest.mark.parametrize('whole', [None, 1, 3])
def test_map_that_the_next_start_would_continue_is_never_removed(whole, tmp_path):
    folder, now = MapFolder(str(tmp_path)), 2.0 * LOST_AGE
    first, second = (aged(folder.free('hall', AUTOSAVE, k), k) for k in (1, 2))
    lost = aged(folder.free('hall', LOST, 3), 3)
    if whole is not None:
        aged(folder.whole('hall'), whole)
    kept = {second} if whole != 3 else set()
    assert {*folder.make_room('hall', now)} == {first, second, lost} - kept
    assert {*folder.automatic('hall')} == kept
    assert folder.newest('hall') in tmp_path.iterdir()


def test_journals_and_what_was_loaded_are_never_removed(tmp_path):
    folder, now = MapFolder(str(tmp_path)), 2.0 * LOST_AGE
    names = ('hall.rlml', 'hall.journal-1-1', 'hall.journal-2-1.damaged', 'hall.autosave-7.rlml')
    files = {aged(tmp_path / name, 1) for name in names}
    aged(folder.whole('hall'), 2)
    folder.loaded.add(tmp_path / names[-1])
    assert folder.make_room('hall', now) == []
    assert {*tmp_path.iterdir()} == files


def test_automatic_maps_of_a_name_with_a_suffix_are_found(tmp_path):
    folder = MapFolder(str(tmp_path))
    for name in ('hall.rlml', 'deep/hall.yaml'):
        path = folder.free(name, AUTOSAVE, 7)
        path.parent.mkdir(exist_ok=True)
        path.touch()
        assert path.name == 'hall.autosave-7.rlml'
        assert folder.automatic(name) == [path]
        assert folder.newest(name) == path


def test_automatic_maps_displace_none_where_they_fill_their_share(tmp_path, monkeypatch):
    folder = MapFolder(str(tmp_path))
    path = folder.free('hall', LOST, 1)
    with path.open('wb') as file:
        file.truncate(LOST_BYTES + 1)  # sparse
    with pytest.raises(MapError, match=r'hall: \.lost-, .*… have 1000 MB; remove'):
        folder.make_room('hall', path.stat().st_mtime)
    assert path.exists()


@pytest.mark.parametrize('name', ['a\0b', 'x' * 5000, 'ü' * 150])
def test_names_that_no_file_can_have_are_refused(name, tmp_path):
    with pytest.raises(MapError, match='is no name of a file'):
        MapFolder(str(tmp_path)).load(name)


@pytest.mark.parametrize('suffix', ['.rlml', '.csv'])
def test_link_out_of_the_folder_is_not_followed(suffix, tmp_path):
    outside, maps = tmp_path / f'secret{suffix}', tmp_path / 'maps'
    outside.write_text('secret')
    maps.mkdir()
    (maps / f'hall{suffix}').symlink_to(outside)
    with pytest.raises(MapError, match='is no file inside of map_directory'):
        MapFolder(str(maps)).load('hall')
    (maps / 'halls').symlink_to(tmp_path)
    with pytest.raises(MapError, match='is not inside of map_directory'):
        MapFolder(str(maps)).load('halls/secret')
    with pytest.raises(MapError, match='inside of map_directory'):
        MapFolder(str(maps)).survey(f'hall{suffix}')


def test_pipe_in_the_place_of_a_map_does_not_block(tmp_path):
    os.mkfifo(tmp_path / 'hall.csv')
    with pytest.raises(MapError, match='is no file inside of map_directory'):
        MapFolder(str(tmp_path)).load('hall')


def test_no_automatic_map_is_written_over_another(tmp_path):
    """A simulator begins with the same stamps every time."""
    folder = MapFolder(str(tmp_path))
    names = []
    for _ in range(3):
        folder.free('hall', LOST, 7).write_bytes(b'')
        names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ['hall.lost-7-2.rlml', 'hall.lost-7-3.rlml', 'hall.lost-7.rlml']
