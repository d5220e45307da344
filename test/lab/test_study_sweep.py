# SPDX-License-Identifier: Apache-2.0
"""The study of what a parameter changes over many bags."""

from __future__ import annotations

import json

import pytest
from made_bags import simulated_bag

from rlml_lab.main import main

pytest.importorskip('distributed')


def sweep(*words) -> int:
    return main(['study', 'sweep', *map(str, words)])


def test_sweep_prints_paired_effects(tmp_path, capsys):
    bags, out = tmp_path / 'bags', tmp_path / 'sweep'
    for seed in (1, 2):
        simulated_bag(bags / f'r{seed}/room', seed=seed)
    code = sweep(bags / 'r*/room', '--out', out, '--json', '--set', 'reflector.gate=0.99,0.999')
    assert code == 0
    found = json.loads(capsys.readouterr().out)
    assert {e['variant'] for e in found['effects']} == {'reflector.gate=0.99',
                                                        'reflector.gate=0.999'}  # fmt: skip
    assert all(e['bags'] == 2 for e in found['effects'])
    assert (out / 'effects.csv').exists()
    assert sweep(bags, '--out', out, '--set', 'reflector.gate') == 1
    assert 'is not NAME=VALUE' in capsys.readouterr().err
