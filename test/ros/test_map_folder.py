# SPDX-License-Identifier: Apache-2.0
"""Maps by name in one folder."""

import os

import pytest

from rlml_slam.errors import MapError, NoMapError
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


@pytest.mark.parametrize(('suffix', 'file'), [('.rlml', '.rlml'), ('.yaml', '.csv')])
def test_suffix_says_which_file_is_missing(suffix, file, tmp_path):
    with pytest.raises(NoMapError, match=rf'there is no hall\{file}$'):
        MapFolder(str(tmp_path)).load('hall' + suffix)


def test_only_old_automatic_maps_of_the_name_are_removed(tmp_path):
    folder, now = MapFolder(str(tmp_path)), 2.0 * LOST_AGE
    others = [tmp_path / name for name in ('hall.rlml', 'halls.lost-1.rlml', 'hall.lost-1.csv')]
    young = [folder.free('hall', LOST, 1000 + k) for k in range(20)]
    old = [folder.free('hall', AUTOSAVE, 2000 + k) for k in range(3)]
    for path in (*others, *old, *young):
        path.write_bytes(b'')
        os.utime(path, (now, now) if path in young else (0, 0))
    previous = old[0].with_name(old[0].name + '.previous')
    previous.write_bytes(b'')
    assert folder.make_room('hall', now) == old
    assert {*tmp_path.iterdir()} == {*others, *young}
    assert folder.make_room('hall', now) == []


def test_automatic_maps_displace_none_where_they_fill_their_share(tmp_path, monkeypatch):
    folder = MapFolder(str(tmp_path))
    path = folder.free('hall', LOST, 1)
    with path.open('wb') as file:
        file.truncate(LOST_BYTES + 1)  # sparse
    with pytest.raises(MapError, match=r'hall\.lost-… and \.autosave-… have 1000 MB; remove'):
        folder.make_room('hall', path.stat().st_mtime)
    assert path.exists()


def test_no_automatic_map_is_written_over_another(tmp_path):
    """A simulator begins with the same stamps every time."""
    folder = MapFolder(str(tmp_path))
    names = []
    for _ in range(3):
        folder.free('hall', LOST, 7).write_bytes(b'')
        names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ['hall.lost-7-2.rlml', 'hall.lost-7-3.rlml', 'hall.lost-7.rlml']
