# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab bench marginals``: covariances of all poses and landmarks against gtsam.Marginals.

The libraries define a residual differently in second order, so that their information matrices
agree only where residuals are zero: every measurement is replaced by what the solved graph
predicts. What is fixed gets a prior in both. Times are CPU times of the process from a solved
graph to all blocks, interleaved; the blocks are compared in the axes of the map.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_lab.bench.bench_back_end import read_graphs
from rlml_lab.bench.generated_graphs import city, warehouse
from rlml_lab.bench.rivals import gtsam_graph, single_thread, timed
from rlml_slam import se2
from rlml_slam.errors import RlmlError
from rlml_slam.graph.batch.marginals import Marginals, warm_up
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array
from rlml_slam.types import EdgeKind

# information of the prior that stands for a fixed pose: about that of a laser's measurement, so
# that no digits are lost to a much stiffer matrix
TIE = np.diag([1e4, 1e4, 1e5])


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab bench marginals``."""
    parser = subparsers.add_parser(
        'marginals',
        help='covariances against GTSAM',
        description="Compares with gtsam.Marginals (pip install '.[bench]').",
    )
    parser.add_argument('graphs', nargs='*', type=Path, help='g2o/TORO files or folders of them')
    parser.add_argument('--generated', action='store_true', help='also generated graphs')
    parser.add_argument('--runs', type=int, default=5, help='interleaved runs (default 5)')
    parser.add_argument('--json', action='store_true', help='one JSON object on stdout')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    single_thread()
    if args.runs < 1:
        raise RlmlError(f'--runs {args.runs} is not at least 1')
    warm_up()
    results = []
    if not args.json:
        print(
            f'{"graph":30} {"poses":>6} {"marks":>6} {"rlml ms":>8} {"gtsam ms":>9} ratio  differ'
        )
    for name, source in _graphs(args.graphs, args.generated):
        result = {'graph': name, **compare(source, args.runs)}
        results.append(result)
        if not args.json:
            print(_row(result))
    if args.json:
        print(json.dumps({'results': results}))
    return 0


def _row(r: dict[str, Any]) -> str:
    ours = f'{r["graph"]:30} {r["poses"]:6d} {r["landmarks"]:6d} {r["rlml_ms"]:8.2f} '
    if r['gtsam_ms'] is None:
        return ours + '    -         -  gtsam finds the equations singular'
    return ours + f'{r["gtsam_ms"]:9.1f} {r["ratio"]:5.3f} {r["difference"]:.1e}'


def _graphs(paths: list[Path], generated: bool) -> Iterator[tuple[str, Graph]]:
    yield from read_graphs(paths)
    if generated:
        yield 'city 1000', city(1000)
        yield 'warehouse 1000', warehouse(1000, 150)


def compare(source: Graph, runs: int = 1) -> dict[str, Any]:
    """Sizes, times, their ratio, and the largest relative difference of a block.

    The difference of two covariances is in the Frobenius norm, relative to that of the peer's.
    What is the peer's is None where it finds the equations singular.
    """
    graph = without_residuals(source)
    ours, theirs = [], []
    peer = None
    for _ in range(runs):
        ms, blocks = timed(lambda: _ours(graph))
        ours.append(ms)
        with contextlib.suppress(RuntimeError):
            ms, peer = _gtsam(graph)
            theirs.append(ms)
    result = {
        'poses': len(graph.poses), 'landmarks': len(graph.landmarks), 'rlml_ms': median(ours),
        'gtsam_ms': None, 'ratio': None, 'difference': None,
    }  # fmt: skip
    if peer is None:
        return result
    worst = max(
        float((np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(b, axis=(1, 2))).max())
        for a, b in zip(blocks, peer, strict=True)
        if len(b)
    )
    theirs_ms = median(theirs)
    return result | {
        'gtsam_ms': theirs_ms, 'ratio': median(ours) / theirs_ms, 'difference': worst
    }  # fmt: skip


def without_residuals(source: Graph) -> Graph:
    """The solved graph with measurements as it predicts them, and priors on what is fixed.

    Raises RlmlError if a pose has no factors, for which there is nothing to compare.
    """
    optimize(source)
    graph, e, s = Graph(), source.edges, source.sightings
    touched = np.concatenate([e.nodes.ravel(), s.nodes[:, 0]])
    if len(np.setdiff1d(np.arange(len(source.poses)), touched)):
        raise RlmlError('a pose without factors has no covariance to compare')
    graph.add_poses(source.poses)
    graph.add_landmarks(source.landmarks)
    for i in np.flatnonzero(source.fixed_poses):
        graph.add_pose_prior(int(i), source.poses[i], TIE)
    i, j = e.nodes.T
    delta = se2.between(graph.poses[i], graph.poses[j])
    graph.add_edges(EdgeKind.ODOMETRY, e.nodes, delta, e.information)
    if len(s):
        i, k = s.nodes.T
        z = se2.transform(se2.inverse(graph.poses[i]), graph.landmarks[k][:, None])[:, 0]
        graph.add_sightings(s.nodes, z, s.information)
    return graph


def _ours(graph: Graph) -> tuple[Array, Array]:
    """Covariances of all poses and of the landmarks that are seen."""
    marginals = Marginals(graph)
    return marginals.poses(np.arange(len(graph.poses))), marginals.landmarks(_seen(graph))


def _seen(graph: Graph) -> NDArray[np.int64]:
    return np.unique(graph.sightings.nodes[:, 1])


def _gtsam(graph: Graph) -> tuple[float, tuple[Array, Array]]:
    """(CPU time [ms], the same from GTSAM), whose poses have their own axes."""
    import gtsam

    n, p = len(graph.poses), graph.pose_priors
    values, fg = gtsam_graph(graph)
    information = gtsam.noiseModel.Gaussian.Information
    for (i,), z, info in zip(p.nodes, p.measured, p.information, strict=True):
        fg.add(gtsam.PriorFactorPose2(int(i), gtsam.Pose2(*z), information(info)))

    def blocks() -> list[Any]:
        marginals = gtsam.Marginals(fg, values)
        return [marginals.marginalCovariance(k) for k in [*range(n), *(n + _seen(graph))]]

    ms, found = timed(blocks)
    turn = np.zeros((n, 3, 3))
    turn[:, :2, :2] = se2.rotation(graph.poses[:, 2])
    turn[:, 2, 2] = 1.0
    poses = turn @ np.array(found[:n]) @ np.swapaxes(turn, 1, 2)
    return ms, (poses, np.array(found[n:]).reshape(-1, 2, 2))
