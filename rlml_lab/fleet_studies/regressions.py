# SPDX-License-Identifier: Apache-2.0
"""Changes that are planted in some bags, one that changes nothing, and no change at all."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import rlml_lab
import rlml_slam
from rlml_lab.fleet.bags import Bag
from rlml_lab.fleet.comparison import compare
from rlml_lab.fleet.replay_job import Job
from rlml_lab.fleet.results import Results
from rlml_lab.fleet.run import replay_all
from rlml_lab.fleet_studies.fleet_bags import Fleet, make_bag, name_of
from rlml_lab.support.cluster import open_client
from rlml_slam.params import from_mapping

# planted -> the world of its bags, and parameters; a wrong laser_pose is in the bag
PLANTED: Mapping[str, tuple[str, Mapping[str, float]]] = {
    'wrong laser_pose': ('corridor', {}),
    'half the range': ('yard', {'submap.max_laser_range': 15.0, 'reflector.max_range': 12.5}),
    'wrong threshold': ('hall', {'scan_match.min_score': 0.99}),
}
EACH = 5  # bags with one of them
COMPARED = 60  # bags of the run with planted changes


def planted(fleet: Fleet) -> dict[str, Any]:
    """Whether the right bags are flagged, and only these."""
    baseline = Results(str(fleet.out / 'workers_1')).read_all()
    jobs = {j.bag.name: j for j in fleet.jobs(fleet.out / 'planted')}
    names = [name_of(k) for k in range(min(COMPARED, len(jobs)))]
    jobs = {n: jobs[n] for n in names}
    where: dict[str, str] = {}
    for what, (world, values) in PLANTED.items():
        for k in [k for k, n in enumerate(names) if n.startswith(world)][:EACH]:
            where[names[k]] = what
            jobs[names[k]] = _changed(fleet, jobs[names[k]], k, values)
    with open_client(None) as client:
        found = compare(baseline, replay_all(client, list(jobs.values()), lambda n, note: None))
        reruns = _reruns(fleet, client, names[:4])
    flagged = {v.name: v.worse for v in found if v.worse}
    refactored = _refactoring(fleet)
    return {
        'compared': len(found), 'planted': len(where),
        'flagged': {p: sum(where.get(n) == p for n in flagged) for p in PLANTED},
        'missed': sorted(set(where) - set(flagged)),
        'false_alarms': {n: why for n, why in flagged.items() if n not in where},
        'example': {where[n]: why for n, why in flagged.items() if n in where},
        'refactoring': refactored, 'reruns': reruns,
        'holds': set(flagged) == set(where) and not refactored['worse']
        and refactored['other_key'] and not reruns['worse'],
    }  # fmt: skip


def _changed(fleet: Fleet, job: Job, k: int, values: Mapping[str, float]) -> Job:
    """The job with a planted change."""
    if values:
        return replace(job, params=from_mapping(values))
    folder = fleet.out / 'wrong_pose'
    name = make_bag(str(folder), k, fleet.seconds, wrong_pose=True)
    return replace(job, bag=Bag(name, str(folder / name)))


def _reruns(fleet: Fleet, client: Any, names: list[str]) -> dict[str, int]:
    """The same bags again and again, each time computed: how many are flagged."""
    baseline = Results(str(fleet.out / 'workers_1')).read_all()
    worse = compared = 0
    for _ in range(fleet.reruns):
        out = fleet.out / 'reruns'
        jobs = [j for j in fleet.jobs(out) if j.bag.name in names]
        found = compare(baseline, replay_all(client, jobs, lambda n, note: None), same_bytes=True)
        compared += len(found)
        worse += sum(bool(v.worse) for v in found)
        shutil.rmtree(out)
    return {'runs': fleet.reruns, 'compared': compared, 'worse': worse}


def _refactoring(fleet: Fleet, bags: int = 12) -> dict[str, Any]:
    """A copy of the package whose text differs, and whose results must not."""
    tree = fleet.out / 'refactored'
    shutil.rmtree(tree, ignore_errors=True)
    for package in (Path(rlml_slam.__file__).parent, Path(rlml_lab.__file__).parent):
        shutil.copytree(package, tree / package.name)
    with (tree / 'rlml_slam' / 'recordings' / 'bag_replay.py').open('a') as f:
        f.write('\n# a line that changes no result\n')
    subset = fleet.out / 'subset'
    for name in (name_of(k) for k in range(bags)):
        (subset / name).parent.mkdir(parents=True, exist_ok=True)
        if not (subset / name).exists():
            shutil.copytree(fleet.bags / name, subset / name)
    done = subprocess.run(
        [sys.executable, '-m', 'rlml_lab', 'fleet', 'replay', str(subset), '--out',
         str(fleet.out / 'refactored_runs'), '--no-report', '--json', '--same-bytes',
         '--baseline', str(fleet.out / 'workers_1')],
        stdout=subprocess.PIPE, text=True, check=False,
        cwd=tree, env={**os.environ, 'PYTHONPATH': str(tree)},
    )  # fmt: skip
    figures = json.loads(done.stdout)
    keys = {r.name: r.key for r in Results(str(fleet.out / 'workers_1')).read_all()}
    new = Results(str(fleet.out / 'refactored_runs')).read_all()
    return {
        'compared': figures['compared'], 'same_bytes': figures['same_bytes'],
        'worse': len(figures['worse']), 'other_key': all(r.key != keys[r.name] for r in new),
    }  # fmt: skip
