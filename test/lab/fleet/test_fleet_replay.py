# SPDX-License-Identifier: Apache-2.0
"""A fleet's replays: as `rlml replay` writes them, found again, and in any store."""

from __future__ import annotations

import json
import os
import signal

import pytest
from made_bags import simulated_bag

from rlml_lab.fleet import replay_job
from rlml_lab.fleet.bags import Bag, find_bags
from rlml_lab.fleet.replay_job import SAME, Job, code_digest, replay_bag
from rlml_lab.fleet.results import Results
from rlml_lab.fleet.run import replay_all, write_tables
from rlml_lab.main import main as lab
from rlml_lab.support.cluster import open_client
from rlml_slam.cli.main import main
from rlml_slam.errors import ClusterError
from rlml_slam.params import Parameters

pytest.importorskip('distributed')
fsspec = pytest.importorskip('fsspec')


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    simulated_bag(folder / 'r1/room', seed=1)
    simulated_bag(folder / 'r2/room', seed=2)
    (folder / 'r2/broken.mcap').write_text('nonsense')
    return folder


@pytest.fixture(scope='module')
def workers():
    """Options for a worker that has been started already."""
    with open_client(None, 1) as client:
        yield '--cluster', client.scheduler.address


def fleet(*words) -> int:
    return lab(['fleet', *map(str, words)])


def jobs_of(place, out, **options) -> list[Job]:
    return [
        Job(bag, Parameters(), str(out), code_digest(), report=False, **options)
        for bag in find_bags([str(place)])
    ]


def test_fleet_replays_as_replay_does_and_finds_it_again(bags, workers, tmp_path, capsys):
    first, second = tmp_path / 'first', tmp_path / 'second'
    assert fleet('replay', bags, '--out', first, '--jobs', 1, '--mcap') == 1  # one is broken
    assert 'r2/broken.mcap: not a readable bag' in capsys.readouterr().out
    assert main(['replay', str(bags / 'r1/room'), '--out', str(tmp_path / 'one')]) == 0
    for name in SAME:
        one = tmp_path / 'one' / name
        assert not one.exists() or one.read_bytes() == (first / 'r1/room' / name).read_bytes()
    assert {'report.html', 'run.mcap'} <= {p.name for p in (first / 'r1/room').iterdir()}
    assert 'href="r1/room/report.html"' in (first / 'fleet.html').read_text()
    capsys.readouterr()

    table = (first / 'fleet.parquet').read_bytes()
    # as a kill leaves it: files without a record
    (first / 'r2/room/run.json').unlink()
    (first / 'r2/room/trajectory.tum').write_text('half')
    assert fleet('replay', bags, '--out', first, *workers, '--mcap', '--json') == 1
    figures = json.loads(capsys.readouterr().out)
    assert figures['found_again'] == 1
    assert (first / 'fleet.parquet').read_bytes() == table

    code = fleet('replay', bags, '--out', second, '--jobs', 2, '--no-report', '--baseline', first,
                 '--same-bytes', '--json')  # fmt: skip
    figures = json.loads(capsys.readouterr().out)
    assert code == 0
    assert (figures['compared'], figures['same_bytes'], figures['worse']) == (3, 2, {})
    assert (second / 'fleet.parquet').read_bytes() == table


def test_worse_parameters_are_flagged(bags, workers, tmp_path, capsys):
    good, bad = tmp_path / 'good', tmp_path / 'bad'
    (tmp_path / 'bad.yaml').write_text(
        '/**: {ros__parameters: {submap.max_laser_range: 0.5, reflector.max_range: 0.5}}'
    )
    place = bags / 'r*/room'
    assert fleet('replay', place, '--out', good, *workers, '--no-report') == 0
    code = fleet('replay', place, '--out', bad, *workers, '--no-report', '--baseline', good,
                 '--config', tmp_path / 'bad.yaml')  # fmt: skip
    assert code == 1
    assert '2 got worse' in capsys.readouterr().out


def test_memory_store_gives_the_same_table(bags, tmp_path):
    from distributed import Client

    fs = fsspec.filesystem('memory')
    fs.put(str(bags), '/bags', recursive=True)
    with Client(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address='127.0.0.1:0'
    ) as c:
        tables = []
        for place, out in ((bags, tmp_path / 'out'), ('memory://bags', 'memory://out')):
            results = Results(str(out))
            write_tables(results, replay_all(c, jobs_of(place, out), lambda n, note: None))
            tables.append((fsspec.open(f'{out}/fleet.parquet').open()).read())
    assert tables[0] == tables[1]
    assert fs.exists('/out/r1/room/map.rlml')
    for place in ('/bags', '/out'):
        fs.rm(place, recursive=True)


def test_killed_worker_costs_nothing(bags, tmp_path):
    """Each worker kills itself at its first bag."""
    with open_client(None, 1) as client:
        marks = [str(tmp_path / str(k)) for k in range(3)]
        jobs = jobs_of(bags, tmp_path / 'out')
        futures = [client.submit(_killed_once, j, m, pure=False)
                   for j, m in zip(jobs, marks, strict=True)]  # fmt: skip
        records = client.gather(futures)
    assert [r.row['status'] for r in records] == ['ok', 'failed', 'ok']


def _killed_once(job, mark):
    if not os.path.exists(mark):
        open(mark, 'w').close()
        os.kill(os.getpid(), signal.SIGKILL)
    return replay_bag(job)


def test_bag_that_kills_every_worker_costs_its_own_row(bags, tmp_path, monkeypatch):
    from rlml_lab.fleet import run

    monkeypatch.setattr(run, 'replay_bag', _deadly)
    with open_client(None, 1) as client:
        records = replay_all(client, jobs_of(bags, tmp_path / 'out'), lambda n, note: None)
    assert records[0].row['status'] == 'failed'
    assert 'workers ended at it' in records[0].row['problem']
    assert records[2].row['status'] == 'ok'


def _deadly(job):
    if job.bag.name == 'r1/room':
        os.kill(os.getpid(), signal.SIGKILL)
    return replay_bag(job)


def test_worker_with_other_code_is_refused():
    job = Job(Bag('a', '/nowhere'), Parameters(), '/nowhere', 'other code')
    with pytest.raises(ClusterError, match='other code'):
        replay_bag(job)


def test_bug_in_one_bag_is_its_row(bags, tmp_path, monkeypatch):
    def broken(*args, **options):
        raise ZeroDivisionError('planted')

    monkeypatch.setattr(replay_job, 'replay', broken)
    record = replay_bag(jobs_of(bags, tmp_path / 'out')[0])
    assert record.row['status'] == 'failed'
    assert 'bug: ZeroDivisionError: planted' in record.row['problem']
