# SPDX-License-Identifier: Apache-2.0
"""A fleet's bags and results in an object store: a server of S3 on loopback."""

from __future__ import annotations

import json

import pytest
from made_bags import simulated_bag

from rlml_lab.main import main
from rlml_lab.support.cluster import open_client

pytest.importorskip('distributed')
fsspec = pytest.importorskip('fsspec')
pytest.importorskip('s3fs', reason='no package s3fs: `make s3` installs it')
pytest.importorskip('moto', reason='no package moto: `make s3` installs it')


def replay(capsys, *words) -> tuple[int, dict]:
    capsys.readouterr()
    code = main(['fleet', 'replay', *map(str, words), '--no-report', '--json'])
    return code, json.loads(capsys.readouterr().out)


def test_bags_and_results_in_s3_give_the_same_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv('AWS_MAX_ATTEMPTS', '2')  # the server that has gone is asked that often
    bags, here = tmp_path / 'bags', tmp_path / 'here'
    simulated_bag(bags / 'r1/room', seed=1)
    (bags / 'r2').mkdir()
    (bags / 'r2/broken.mcap').write_text('nonsense')
    assert replay(capsys, bags, '--out', here, '--jobs', '1')[0] == 1  # one is broken
    from rlml_lab.fleet_studies.stores import s3_server

    # the workers are started where the server is: they read and write as well
    with s3_server(), open_client(None, 1) as client:
        fs = fsspec.filesystem('s3')
        fs.mkdir('fleet')
        fs.put(str(bags), 'fleet/bags', recursive=True)
        place, out = 's3://fleet/bags', 's3://fleet/runs'
        workers = ('--cluster', client.scheduler.address)
        assert replay(capsys, place, '--out', out, *workers)[0] == 1
        assert fs.cat('fleet/runs/fleet.parquet') == (here / 'fleet.parquet').read_bytes()
        assert fs.exists('fleet/runs/r1/room/map.rlml')

        fs.rm('fleet/runs/r1/room/run.json')  # as a kill leaves it
        code, figures = replay(capsys, place, '--out', out, *workers)
        assert (code, figures['found_again']) == (1, 0)
        options = ('--baseline', here, '--same-bytes', *workers)
        code, figures = replay(capsys, place, '--out', out, *options)
        assert (code, figures['found_again'], figures['worse']) == (0, 1, {})
        options = ('--baseline', out, *workers)
        code, figures = replay(capsys, place, '--out', 's3://fleet/again', *options)
        assert (code, figures['found_again'], figures['same_bytes']) == (0, 0, 1)

        for words, why in (
            (['s3://fleet/nothing', '--out', out], 's3://fleet/nothing: no bag there'),
            (['s3://absent/bags', '--out', out], 's3://absent/bags: cannot be read: The'),
            ([place, '--out', 's3://absent/runs'], 'absent/runs/fleet.trial: cannot be written'),
            ([place, '--out', out, '--baseline', 's3://absent'], 'not the results of a whole'),
        ):
            assert main(['fleet', 'replay', *words]) == 1
            assert why in capsys.readouterr().err
    # the server has gone
    assert main(['fleet', 'replay', place, '--out', out]) == 1
    assert f'rlml-lab: {place}: cannot be read: Could not connect' in capsys.readouterr().err
    assert main(['fleet', 'replay', str(bags), '--out', out]) == 1
    assert 'fleet.trial: cannot be written: Could not connect' in capsys.readouterr().err
