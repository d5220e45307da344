# SPDX-License-Identifier: Apache-2.0
"""Maps by name in one folder."""

import os

import pytest

from rlml_slam.errors import MapError, NoMapError
from rlml_slam.ros.back_end.map_folder import LOST_KEPT, MapFolder


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


def test_of_the_maps_that_nothing_leads_back_to_the_newest_are_kept(tmp_path):
    folder = MapFolder(str(tmp_path))
    others = [tmp_path / name for name in ('hall.rlml', 'halls.lost-1.rlml', 'hall.lost-1.csv')]
    made = [folder.lost('hall', 1000 - k) for k in range(LOST_KEPT + 3)]
    for k, path in enumerate([*others, *made]):
        path.write_bytes(b'')
        os.utime(path, (k, k))
    made[0].with_name(made[0].name + '.previous').write_bytes(b'')
    # by when they were written: the clock of the stamps may have jumped
    assert folder.forget_lost('hall') == made[:3]
    assert {*tmp_path.iterdir()} == {*others, *made[3:]}
    assert folder.forget_lost('hall') == []
