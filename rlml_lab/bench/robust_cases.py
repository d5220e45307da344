# SPDX-License-Identifier: Apache-2.0
"""The cases of ``rlml-lab bench robust``: drawn, solved, judged, and kept so that a run can go on.

A case is one draw of wrong closures with the results of all solvers on it. It is written to the
disk whenever one of them is done, and taken from there where it was measured before on the same
graph: those of this package with the same sources of the solver.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Collection, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rlml_slam.graph
from rlml_lab.bench.wrong_closures import add_clustered, add_random, copied
from rlml_slam import params, se2
from rlml_slam.errors import RlmlError
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.factors import FactorKind
from rlml_slam.graph.model.graph import Graph
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.se2 import Array

NOTHING = 1e-12  # chi2 of edges without errors
EXACT = params.Solver(max_iterations=200, relative_tolerance=1e-10)


class Outcome(NamedTuple):
    """CPU time [ms], and which closures are in the graph afterwards (k,), None of a kernel.

    ``stopped`` says why there is no result: the graph is as it was then.
    """

    cpu_ms: float
    accepted: Any = None
    stopped: str | None = None


Method = Callable[[Graph], Outcome]
# of one solver on one case: ate_m, chi2_ratio, cpu_ms, missed and accepted_wrong of those that
# select; or cpu_ms and stopped
Judged = dict[str, Any]


class Wrong(NamedTuple):
    """So many random closures, or a share of the right ones in groups that agree."""

    number: int
    share: float = 0.0

    def __str__(self) -> str:
        """As on the command line."""
        return f'{100.0 * self.share:g}%' if self.share else f'{self.number}'


def parse_wrong(word: str) -> Wrong:
    """A word like 100 or 20%; raises RlmlError."""
    number = word.removesuffix('%')
    if not number.isdecimal():
        raise RlmlError(f'--wrong {word}: neither a number nor a percentage')
    return Wrong(0, float(number) / 100.0) if word.endswith('%') else Wrong(int(number))


class Cases:
    """A graph with its optimum ``best``, and its cases, kept in ``folder`` if there is one."""

    def __init__(
        self, name: str, graph: Graph, folder: Path | None, own: Collection[str] = ()
    ) -> None:
        """``own`` are the methods of this package."""
        self._name, self._graph, self._folder, self._own = name, graph, folder, own
        self.right = int(np.sum(graph.edges.kinds == FactorKind.CLOSURE))
        self.best = copied(graph)
        initialize(self.best, 'chordal')
        optimize(self.best, EXACT)
        self._least = max(self.best.chi2(), NOTHING)
        e = graph.edges
        parts = (e.nodes, e.measured, e.information)
        self._digest = zlib.crc32(b''.join(np.ascontiguousarray(p).tobytes() for p in parts))
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def draw(self, wrong: Wrong, seed: int) -> Graph:
        """The graph with wrong closures, from odometry."""
        rng = np.random.default_rng(seed)
        out = copied(self._graph)
        if wrong.share:
            add_clustered(out, self.best.poses, round(wrong.share * self.right), rng)
        elif wrong.number:
            add_random(out, wrong.number, rng)
        initialize(out, 'odometry')
        return out

    def solve(self, wrong: Wrong, seed: int, methods: dict[str, Method]) -> dict[str, Judged]:
        """The results of the methods on one draw; those that are known are not run again."""
        path = self._path(wrong, seed)
        known = self._read(path)
        missing = [name for name in methods if name not in known]
        spoilt = self.draw(wrong, seed) if missing else None
        for name in missing:
            assert spoilt is not None
            known[name] = self._judge(spoilt, methods[name])
            if path is not None:
                kept = {'graph': self._digest, 'solver': _solver_digest(), 'results': known}
                write_atomically(path, (json.dumps(kept, indent=1) + '\n').encode())
        return {name: known[name] for name in methods}

    def _path(self, wrong: Wrong, seed: int) -> Path | None:
        word = str(wrong).replace('%', ' percent')
        return None if self._folder is None else self._folder / f'{self._name} {word} {seed}.json'

    def _read(self, path: Path | None) -> dict[str, Judged]:
        if path is None or not path.exists():
            return {}
        try:
            kept = json.loads(path.read_text(encoding='utf-8'))
            results: dict[str, Judged] = kept['results'] if kept['graph'] == self._digest else {}
            same = kept.get('solver') == _solver_digest()
            return {
                name: one
                for name, one in results.items()
                if (same or name not in self._own) and one.keys() & {'stopped', 'chi2_ratio'}
            }
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
            raise RlmlError(f'{path}: not a case of this benchmark: {e}') from e

    def _judge(self, spoilt: Graph, method: Method) -> Judged:
        """One solver on a copy of a graph."""
        own, best = copied(spoilt), self.best.poses
        outcome = method(own)
        if outcome.stopped is not None:
            return {'cpu_ms': outcome.cpu_ms, 'stopped': outcome.stopped}
        right = copied(self.best)
        right.poses[:] = own.poses
        out = {
            'ate_m': ate(own.poses, best), 'chi2_ratio': right.chi2() / self._least,
            'cpu_ms': outcome.cpu_ms,
        }  # fmt: skip
        if outcome.accepted is not None:
            out['missed'] = float(np.sum(~outcome.accepted[: self.right]))
            out['accepted_wrong'] = float(np.sum(outcome.accepted[self.right :]))
        return out


@cache
def _solver_digest() -> int:
    """Of the sources of the solver: what they gave before they were changed is no result."""
    sources = sorted(Path(rlml_slam.graph.__file__).parent.glob('*.py'))
    return zlib.crc32(b''.join(source.read_bytes() for source in sources))


def ate(poses: Array, best: Array) -> float:
    """RMS distance [m] of poses (n, 3) from others after alignment."""
    T = se2.align(poses[:, :2], best[:, :2])
    error = se2.transform(T, poses[:, :2]) - best[:, :2]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def summary(each: Sequence[Judged]) -> dict[str, Any]:
    """Means and the like over the runs that came to an end, and why the others did not."""
    done = [one for one in each if 'stopped' not in one]
    out: dict[str, Any] = {
        'runs': len(each), 'stopped': [one['stopped'] for one in each if 'stopped' in one],
        'cpu_ms': float(np.mean([one['cpu_ms'] for one in each])),
    }  # fmt: skip
    if done:
        errors = [one['ate_m'] for one in done]
        out |= {'ate_median_m': float(np.median(errors)), 'ate_max_m': max(errors)}
        out['chi2_ratio_max'] = max(one['chi2_ratio'] for one in done)
        for name in done[0].keys() & {'missed', 'accepted_wrong'}:
            out[name] = float(np.mean([one[name] for one in done]))
    return out
