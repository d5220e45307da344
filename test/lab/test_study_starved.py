# SPDX-License-Identifier: Apache-2.0
import pytest

from rlml_lab.contact.study_starved import drive
from rlml_slam.cli.main import main


@pytest.fixture
def bag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # maps are saved there
    folder = tmp_path / 'bag'
    assert main(['simulate', 'hall', str(folder), '--duration', '10', '--json']) == 0
    return folder


def test_node_that_sleeps_beside_nonsense_keeps_its_way(bag):
    share, errors, ok = drive(bag, 100.0, 0.5, 0)
    assert 0.1 < share < 0.9
    assert errors.max() < 0.1
    assert ok.any()
