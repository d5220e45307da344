# SPDX-License-Identifier: Apache-2.0
"""One bag on a worker: fetched, found again or replayed, and its results put away."""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from platform import python_version
from typing import Any

from fsspec.core import url_to_fs

import rlml_slam
from rlml_lab.fleet.bags import Bag, local_copy
from rlml_lab.fleet.results import Record, Results
from rlml_lab.fleet.store_errors import naming
from rlml_slam.errors import BagError, ClusterError, RlmlError
from rlml_slam.evaluation.relations import read_relations, relation_errors
from rlml_slam.evaluation.run_record import Run
from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_replay import replay
from rlml_slam.recordings.origin import digest_of
from rlml_slam.report.outputs import write_outputs

PAGE, MCAP = 'report.html', 'run.mcap'
LIBRARIES = ('numba', 'numpy', 'rosbags', 'scipy')  # whose versions may change a result
# of write_outputs: what depends on the key alone
SAME = (
    'trajectory.tum', 'front_end.tum', 'health.csv', 'map.rlml', 'map.pgm', 'map.yaml',
    'reflectors.csv', 'reflector_states.csv', 'closures.csv',
)  # fmt: skip
TRUTH_FIGURES = (
    'ate_rmse_m', 'live_ate_rmse_m', 'live_ate_max_m', 'live_heading_rmse_deg', 'nees_mean',
    'reflector_rmse_m', 'reflectors_found', 'reflectors_true', 'reflectors_spurious',
)  # fmt: skip
RELATION_FIGURES = ('trans_mean_m', 'rot_mean_deg')

_ONE_AT_A_TIME = threading.Lock()  # where a worker was started with several threads


@dataclass(frozen=True)
class Job:
    """A replay to be done: ``out`` is the URL of all results, ``code`` what ``code_digest`` says.

    ``report`` also writes report.html, ``mcap`` also run.mcap.
    """

    bag: Bag
    params: Parameters
    out: str
    code: str
    system: str = 'rlml'
    report: bool = True
    mcap: bool = False

    def key(self, bag_digest: str) -> str:
        """SHA-256 of everything that decides the estimates."""
        parts = [bag_digest, asdict(self.params), self.code, self.system]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    @property
    def extras(self) -> set[str]:
        """Files that are asked for beyond the estimates."""
        return {f for f, wanted in ((PAGE, self.report), (MCAP, self.mcap)) if wanted}


@cache
def code_digest() -> str:
    """SHA-256 of the package, of this folder, and of the versions of Python and libraries."""
    seen = hashlib.sha256(python_version().encode())
    for name in LIBRARIES:
        seen.update(f'{name} {version(name)}\0'.encode())
    for root in (Path(rlml_slam.__file__).parent, Path(__file__).parent):
        for file in sorted(root.rglob('*.py')):
            name = file.relative_to(root.parent).as_posix()
            seen.update(f'{name}\0'.encode() + file.read_bytes())
    return seen.hexdigest()


def replay_bag(job: Job) -> Record:
    """Replay a bag unless its results are there already.

    What is wrong with the bag is in the row. Raises ClusterError where the worker has other code.
    """
    if code_digest() != job.code:
        raise ClusterError('a worker has other code or libraries than the client')
    try:
        with _ONE_AT_A_TIME, tempfile.TemporaryDirectory(prefix='rlml-fleet-') as scratch:
            return _replay_bag(job, Path(scratch))
    except (RlmlError, OSError) as e:
        # by its name, not by where it or its copy was
        copy = rf'\S*rlml-fleet-[^/\s]*/{re.escape(job.bag.url.rpartition("/")[2])}'
        why = re.sub(f'{re.escape(job.bag.url)}|{copy}', lambda _: job.bag.name, str(e))
        return failed(job, why)
    except Exception as e:  # a bug in one bag costs that bag alone
        where = traceback.extract_tb(e.__traceback__)[-1]
        return failed(job, f'bug: {type(e).__name__}: {e} ({where.filename}:{where.lineno})')


def failed(job: Job, why: str) -> Record:
    """The record of a bag that gave no result. It is not kept: the next run tries again."""
    return Record('', {'name': job.bag.name, 'status': 'failed', 'problem': why})


def _replay_bag(job: Job, scratch: Path) -> Record:
    began = time.perf_counter()
    with naming(job.bag.url, 'cannot be fetched', BagError):
        path = local_copy(job.bag.url, scratch)
        relations = _relations(job.bag, scratch)
    digest = digest_of(path)
    key = job.key(digest + (digest_of(relations) if relations else ''))
    results = Results(job.out)
    known = results.find(job.bag.name, key)
    if known is not None and job.extras <= set(known.files):
        return replace(known, times=known.times | {'reused': True})
    fetched, cpu = time.perf_counter(), time.process_time()
    folder = scratch / 'results'
    folder.mkdir()
    mcap = folder / MCAP if job.mcap else None
    run = replay(path, job.params, system=job.system, mcap=mcap)
    replayed = time.perf_counter()
    run.problem = run.problem.replace(str(path), job.bag.name)  # not where the copy was
    run.origin = replace(run.origin, source=f'{job.bag.name}, SHA-256 {digest}')
    figures = write_outputs(run, folder, job.report)
    row = _row(job.bag.name, digest, figures) | _relation_figures(run, relations)
    row['results'] = _digest_of_results(folder)
    written = time.perf_counter()
    times = {
        'wall_s': figures['wall_s'], 'front_end_ms': figures['front_end_ms']['median'],
        'front_end_p99_ms': figures['front_end_ms']['p99'], 'memory_mb': figures['peak_rss_mb'],
        'cpu_s': time.process_time() - cpu,
        'fetch_s': fetched - began, 'replay_s': replayed - fetched, 'write_s': written - replayed,
    }  # fmt: skip
    files = tuple(sorted(f.name for f in folder.iterdir()))
    record = Record(key, row, times | {'reused': False}, files)
    results.keep(folder, record)
    record.times['keep_s'] = time.perf_counter() - written
    return record


def _relations(bag: Bag, scratch: Path) -> Path | None:
    """The file of relations that lies beside a bag, if one does."""
    fs, path = url_to_fs(bag.relations_url)
    return local_copy(bag.relations_url, scratch) if fs.isfile(path) else None


def _row(name: str, digest: str, f: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of metrics.json that do not depend on the machine's speed, one level deep."""
    share = f['health']
    row = {
        'name': name, 'status': 'partial' if f['problem'] else 'ok', 'problem': f['problem'],
        'bag': digest, 'duration_s': f['duration_s'], 'frames': f['scans'],
        'lost_s': round(share['LOST'] * f['duration_s'], 3),
        'degraded_s': round(share['DEGRADED'] * f['duration_s'], 3),
        'keyframes': f['keyframes'], 'closures': f['closures']['accepted'],
        'closures_rejected': f['closures']['rejected'], 'reflectors': f['reflectors'],
        'invalid': sum(fate.get('invalid', 0) for fate in f['inputs'].values()),
    }  # fmt: skip
    return row | {k: f[k] for k in TRUTH_FIGURES if f.get(k) is not None}


def _relation_figures(run: Run, path: Path | None) -> dict[str, float]:
    if path is None:
        return {}
    summary = relation_errors(run.trajectory, read_relations(path)).summary()
    return {f'relations_{k}': round(summary[k], 6) for k in RELATION_FIGURES}


def _digest_of_results(folder: Path) -> str:
    """SHA-256 of the files that two replays write with the same bytes."""
    files = {n: digest_of(folder / n) for n in SAME if (folder / n).exists()}
    return hashlib.sha256(json.dumps(files).encode()).hexdigest()
