# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench incremental``: one keyframe at a time against GTSAM's iSAM2, interleaved.

A keyframe is a pose with its edges to earlier poses and its sightings. Both solvers get the same
one, each starts the new pose and landmarks from its own estimate, and both are timed by the CPU
time of the process for the update with the estimate of the new pose; what makes the factors is
not counted, nor is it for the rival. chi2 is computed by one evaluator; the batch figure is where
the batch solver goes from the incremental estimate at the end.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.bench.bench_back_end import read_graphs
from rlml_lab.bench.generated_graphs import city, warehouse
from rlml_lab.bench.rivals import Isam, single_thread, timed
from rlml_slam import se2
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.incremental import incremental_solver
from rlml_slam.graph.incremental.incremental_solver import IncrementalSolver
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind


@dataclass(frozen=True)
class Keyframe:
    """Rows of a graph's tables that come with pose ``index``."""

    index: int
    edges: NDArray[np.int64]
    sightings: NDArray[np.int64]


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench incremental``."""
    parser = subparsers.add_parser(
        'incremental',
        help='the incremental solver against iSAM2',
        description="Compares with GTSAM's iSAM2 where installed (pip install '.[bench]').",
    )
    parser.add_argument('graphs', nargs='*', type=Path, help='g2o/TORO files or folders of them')
    parser.add_argument('--generated', action='store_true', help='also generated graphs')
    parser.add_argument('--alone', action='store_true', help='without iSAM2')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    single_thread()
    incremental_solver.warm_up()
    with_rival = not args.alone and importlib.util.find_spec('gtsam') is not None
    results = []
    for name, graph in _graphs(args.graphs, args.generated):
        result = {'graph': name, **compare(graph, with_rival)}
        results.append(result)
        if not args.json:
            _print(result)
    if args.json:
        print(json.dumps({'results': results}))
    return 0


def _graphs(paths: list[Path], generated: bool) -> Iterator[tuple[str, Graph]]:
    yield from read_graphs(paths)
    if generated:
        yield 'city 1000', city(1000)
        yield 'city 5000', city(5000)
        yield 'warehouse 1000', warehouse(1000, 150)
        yield 'warehouse 5000', warehouse(5000, 500)


def keyframes(graph: Graph) -> list[Keyframe]:
    """The graph in the order in which it was driven."""
    last = graph.edges.nodes.max(1)
    return [
        Keyframe(i, np.flatnonzero(last == i), np.flatnonzero(graph.sightings.nodes[:, 0] == i))
        for i in range(len(graph.poses))
    ]


class Ours:
    """The incremental solver of this package, fed keyframe by keyframe."""

    def __init__(self, source: Graph) -> None:
        self.source = source
        self.graph = Graph()
        self.solver = IncrementalSolver(self.graph)
        self.landmark: dict[int, int] = {}
        self.work: list[Any] = []

    def add(self, key: Keyframe) -> None:
        """The keyframe's pose, landmarks and factors."""
        source, graph = self.source, self.graph
        e, s = source.edges, source.sightings
        pose = start_of(source, key, graph.poses)
        graph.add_pose(pose, bool(source.fixed_poses[key.index]))
        if len(key.edges):
            kinds = [EdgeKind.ODOMETRY if i + 1 == j else EdgeKind.CLOSURE
                     for i, j in e.nodes[key.edges]]  # fmt: skip
            graph.add_edges(
                kinds, e.nodes[key.edges], e.measured[key.edges], e.information[key.edges]
            )
        pairs = []
        for row in key.sightings:
            k = int(s.nodes[row, 1])
            if k not in self.landmark:
                point = se2.transform(pose, s.measured[row][None])[0]
                self.landmark[k] = graph.add_landmark(point)
            pairs.append([key.index, self.landmark[k]])
        if pairs:
            rows = key.sightings
            graph.add_sightings(pairs, s.measured[rows], s.information[rows])

    def step(self, key: Keyframe) -> float:
        """CPU time of the update [ms]."""
        self.add(key)
        ms, work = timed(self.solver.update)
        self.work.append(work)
        return ms

    def chi2(self) -> float:
        """At the estimate of the end."""
        return self.graph.chi2()


def start_of(source: Graph, key: Keyframe, poses: Array) -> Array:
    """The new pose from an edge to an earlier one, the preceding one if there is such an edge."""
    if not len(key.edges):
        start: Array = source.poses[key.index]
        return start
    nodes = source.edges.nodes[key.edges]
    row = int(np.argmin(np.abs(np.abs(nodes[:, 0] - nodes[:, 1]) - 1)))
    i, j = nodes[row]
    delta = source.edges.measured[key.edges[row]]
    if j == key.index:
        return se2.compose(poses[i], delta)
    return se2.compose(poses[j], se2.inverse(delta))


def compare(graph: Graph, with_rival: bool) -> dict[str, Any]:
    """Drive both solvers through the graph; the rival as far as it gets."""
    ours, rival = Ours(graph), Isam(graph) if with_rival else None
    times: list[float] = []
    theirs: list[float] = []
    failed = None
    for key in keyframes(graph):
        times.append(ours.step(key))
        if rival is not None:
            try:
                theirs.append(rival.step(key.index, key.edges, key.sightings))
            except RuntimeError:  # what it raises where it finds the equations singular
                rival, failed = None, key.index
    out: dict[str, Any] = {
        'poses': len(graph.poses), 'landmarks': len(graph.landmarks),
        'factors': len(graph.edges) + len(graph.sightings),
        'rlml': {**figures(times), 'chi2': ours.chi2()},
    }  # fmt: skip
    if failed is not None:
        out['isam2_failed_at'] = failed
    if rival is not None:
        rival.estimate()
        out['isam2'] = {**figures(theirs), 'chi2': graph.chi2()}
        out['ratio'] = {
            k: out['rlml'][k] / out['isam2'][k] for k in ('median_ms', 'p99_ms', 'total_ms')
        }
    optimize(ours.graph)
    out['chi2_batch'] = ours.chi2()
    return out


def figures(times: list[float]) -> dict[str, float]:
    """Median, 99th percentile and sum."""
    return {
        'median_ms': float(np.median(times)), 'p99_ms': float(np.percentile(times, 99)),
        'total_ms': float(np.sum(times)),
    }  # fmt: skip


def _print(result: dict[str, Any]) -> None:
    print(
        f'{result["graph"]}: {result["poses"]} poses, {result["landmarks"]} landmarks, '
        f'{result["factors"]} factors; batch chi2 {result["chi2_batch"]:.6g}'
    )
    for name in ('rlml', 'isam2'):
        if name in result:
            row = result[name]
            print(
                f'  {name:6} median {row["median_ms"]:7.3f}  p99 {row["p99_ms"]:7.2f}  '
                f'total {row["total_ms"]:8.0f} ms  chi2 {row["chi2"]:.6g}'
            )
    if 'isam2_failed_at' in result:
        print(f'  isam2  finds the equations singular at pose {result["isam2_failed_at"]}')
    if 'ratio' in result:
        row = result['ratio']
        print(
            f'  ratio  median {row["median_ms"]:7.2f}  p99 {row["p99_ms"]:7.2f}  '
            f'total {row["total_ms"]:8.2f}'
        )
