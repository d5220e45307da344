# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np

from rlml_lab.main import main
from rlml_lab.studies import study_store as study
from rlml_slam.maps import map_container


def test_nothing_is_lost_to_kills_and_damages(capsys):
    assert main(['study', 'store', '--kills', '8', '--damages', '60', '--json']) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures['damages'] == {'refused': 60}
    assert figures['kills'] == {'whole': 8, 'previous whole': 8}


def test_what_is_wrong_is_found(tmp_path, monkeypatch):
    """Files that mix versions, or lack the one before, are found."""
    path = map_container.write(tmp_path / 'a.rlml', study.version(3))
    assert study._classify(path, 3) == study.WHOLE
    assert study._classify(path, 9) == study.OLDER
    assert study._classify(path, 2) == study.WRONG
    mixed = study.version(3)
    mixed.arrays['pose'][7] = 2.0
    assert study._classify(map_container.write(tmp_path / 'b.rlml', mixed), 3) == study.WRONG
    path.write_bytes(path.read_bytes()[:-1])
    assert study._refusal(path) == study.LOST
    monkeypatch.setattr(map_container, '_is_whole', lambda path: False)
    assert study.damage(tmp_path / 'c.rlml', 4, np.random.default_rng(0)) == {study.LOST: 4}


def test_report_counts(capsys):
    text = study.text({'kills': {'whole': 3, 'previous whole': 3}, 'damages': {}})
    assert text == '3 kills: 3 previous whole, 3 whole\n0 damages: none'
