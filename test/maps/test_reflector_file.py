# SPDX-License-Identifier: Apache-2.0
import pytest

from rlml_slam.errors import FileFormatError
from rlml_slam.maps.reflector_file import COLUMNS, load


@pytest.mark.parametrize('blank', ['', '\n', '\n\n'])
def test_error_names_the_line_of_the_file(tmp_path, blank):
    path = tmp_path / 'reflectors.csv'
    good, bad = ('1,-1,0,0,1e-4,0,1e-4,5,0.08', '2,-1,1,0,-1e-4,0,1e-4,5,0.08')
    path.write_text(f'{",".join(COLUMNS)}\n{good}\n{blank}{bad}\n', encoding='utf-8')
    line = 3 + blank.count('\n')
    with pytest.raises(FileFormatError, match=f'line {line}: covariance has a negative variance'):
        load(path)
