# SPDX-License-Identifier: Apache-2.0
import json

import pytest

from rlml_lab.contact import study_broken_bags as study
from rlml_lab.main import main

ARGUMENTS = ['study', 'broken-bags', '--bags', '2', '--json']


def test_recovery_reads_what_the_library_refuses(capsys):
    assert main(ARGUMENTS) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 6
    for form in ('MCAP', 'ROS 1'):
        row = rows[f'{form}, cut off']
        assert row['library'] == 0.0
        assert row['read'] > 10.0
    assert all(row['read'] >= row['library'] for row in rows.values())
    assert rows['MCAP, changed']['read'] > 99.0


def test_wrong_and_lost_messages_are_found(monkeypatch, capsys):
    monkeypatch.setattr(study, 'by_package', lambda file: iter([(1, '/scan', b'invented')]))
    assert main(ARGUMENTS) == 1
    rows = json.loads(capsys.readouterr().out)
    assert rows['MCAP, cut off'] == {'library': 0.0, 'read': 0.0, 'least': 0.0, 'wrong': 2}
    assert rows['MCAP, changed']['library'] > rows['MCAP, changed']['read'] == 0.0


def test_table_has_a_line_for_each_row(capsys):
    row = {'library': 12.34, 'read': 56.78, 'least': 1.0, 'wrong': 0}
    lines = study.table({'MCAP, cut off': row, 'ROS 1, changed': row}).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[1].split() == ['MCAP,', 'cut', 'off', '12.3', '56.8', '1.0', '0']


def test_no_bags_are_refused(capsys):
    assert main(['study', 'broken-bags', '--bags', '0']) == 1
    assert '--bags must be at least 1' in capsys.readouterr().err


@pytest.mark.parametrize('form', study.WRITERS)
def test_sound_bags_are_read_whole(form, tmp_path):
    with study.BagReader(study.SAMPLE) as bag:
        recorded = [(time, topic, bytes(raw)) for time, topic, raw in bag.serialized()][:500]
        kinds = {t.name: t.msgtype for t in bag.topics.values()}
    file = study.WRITERS[form](tmp_path / 'bag' / 'b', recorded, kinds)
    assert set(study.by_library(file)) == set(study.by_package(file)) == set(recorded)
