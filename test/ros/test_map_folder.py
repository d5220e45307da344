# SPDX-License-Identifier: Apache-2.0
"""Maps by name in one folder."""

import pytest

from rlml_slam.errors import MapError, NoMapError
from rlml_slam.ros.map_folder import MapFolder


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
