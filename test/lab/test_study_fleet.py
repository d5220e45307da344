# SPDX-License-Identifier: Apache-2.0
"""The study of a fleet: its bags, and processes started by hand."""

from __future__ import annotations

import pytest

from rlml_lab.fleet.replay_job import replay_bag
from rlml_lab.fleet.results import Results
from rlml_lab.fleet.run import write_tables
from rlml_lab.fleet_studies import by_processes
from rlml_lab.fleet_studies.fleet_bags import FAULTS, WORLDS, WRONG_POSE, Fleet, make_bag, name_of
from rlml_lab.main import main
from rlml_lab.support.parallel_jobs import each
from rlml_slam.ros.bags.bag import BagReader

pytest.importorskip('distributed')


def test_all_worlds_and_faults_come_before_a_second_seed():
    names = [name_of(k) for k in range(200)]
    assert len(set(names)) == 200
    first = {n.rpartition('_')[0] for n in names[: len(WORLDS) * len(FAULTS)]}
    assert first == {f'{w}/{f}' for w in WORLDS for f in FAULTS}


def test_wrong_pose_is_in_the_transform_alone(tmp_path):
    read = {}
    for wrong in (False, True):
        name = make_bag(str(tmp_path / str(wrong)), 1, 2.0, wrong)
        with BagReader(tmp_path / str(wrong) / name) as bag:
            read[wrong] = [(topic, raw) for _, topic, raw in bag.serialized()]
        with BagReader(tmp_path / str(wrong) / name) as bag:
            ((_, _, message),) = bag.messages(['/tf_static'])
            shift = message.transforms[0].transform.translation
            assert (shift.x, shift.y) == (WRONG_POSE[:2] if wrong else (0.2, 0.0))
    different = {a[0] for a, b in zip(read[False], read[True], strict=True) if a != b}
    assert different == {'/tf_static'}


def test_cluster_started_by_hand_serves_command_and_study(tmp_path):
    fleet = Fleet(tmp_path / 'bags', tmp_path, 2.0, 1)
    for k in range(2):
        make_bag(str(fleet.bags), k, fleet.seconds)
    with by_processes.cluster() as address:
        figures = by_processes.finished(
            by_processes.replay(fleet, 'by_hand', '--cluster', address)
        )
        named = {k: name for (k,), name in each(name_of, [(k,) for k in range(5)], address)}
    assert figures['status'] == {'ok': 2, 'partial': 0, 'failed': 0}
    here = fleet.jobs(fleet.out / 'here')  # without a cluster
    write_tables(Results(str(fleet.out / 'here')), [replay_bag(job) for job in here])
    assert fleet.table('by_hand') == fleet.table('here')
    assert named == {k: name_of(k) for k in range(5)}


def test_wrong_numbers_are_refused(capsys):
    for words in (['--bags', '3'], ['--seconds', '0'], ['--reruns', '0']):
        assert main(['study', 'fleet', *words]) == 1
    assert 'study fleet: --bags from 20' in capsys.readouterr().err
