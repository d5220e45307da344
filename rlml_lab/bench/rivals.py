# SPDX-License-Identifier: Apache-2.0
"""The other solvers that ``rlml-lab bench back-end`` compares with: g2o, GTSAM, Ceres.

Each runs on its own copy of a graph; only the call that optimises is timed, by the CPU time of
the process. Estimates are written back, so that one evaluator judges them all.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array


@dataclass(frozen=True)
class Run:
    """One optimisation: CPU time of the call and steps taken."""

    cpu_ms: float
    iterations: int


Solver = Callable[[Graph, int], Run]

# wrappers of g2o own what they wrap: they must outlive the optimiser, which frees it as well
_KEEP: list[Any] = []


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """(CPU time of the process in ms, result)."""
    start = time.process_time()
    result = call()
    return (time.process_time() - start) * 1e3, result


def installed() -> dict[str, dict[str, Solver]]:
    """Solvers by library; the second argument of a solver is its number of iterations at most."""
    out: dict[str, dict[str, Solver]] = {'rlml': {'rlml': run_rlml}}
    if importlib.util.find_spec('g2o'):
        out['g2o'] = {
            'g2o GN': lambda graph, n: run_g2o(graph, n, 'GaussNewton'),
            'g2o LM': lambda graph, n: run_g2o(graph, n, 'Levenberg'),
            'g2o DL': lambda graph, n: run_g2o(graph, n, 'Dogleg'),
        }
    if importlib.util.find_spec('gtsam'):
        out['gtsam'] = {
            'gtsam GN': lambda graph, n: run_gtsam(graph, n, 'GaussNewton'),
            'gtsam LM': lambda graph, n: run_gtsam(graph, n, 'LevenbergMarquardt'),
        }
    if importlib.util.find_spec('pyceres'):
        out['ceres'] = {'ceres LM': run_ceres}
    return out


def run_rlml(graph: Graph, iterations: int) -> Run:
    """This package with its default parameters (``iterations`` is not a limit here)."""
    ms, solution = timed(lambda: optimize(graph))
    return Run(ms, solution.iterations)


def run_g2o(graph: Graph, iterations: int, algorithm: str) -> Run:
    """``iterations`` steps of g2o, which has no stopping rule of its own."""
    import g2o

    block = 'X' if len(graph.sightings) else 'SE2'
    linear = getattr(g2o, f'LinearSolverEigen{block}')()
    optimizer = g2o.SparseOptimizer()
    method = getattr(g2o, f'OptimizationAlgorithm{algorithm}')
    optimizer.set_algorithm(method(getattr(g2o, f'BlockSolver{block}')(linear)))
    vertices = []
    for i, pose in enumerate(graph.poses):
        v = g2o.VertexSE2()
        v.set_id(i)
        v.set_estimate(g2o.SE2(*pose))
        v.set_fixed(bool(graph.fixed_poses[i]))
        vertices.append(v)
    n = len(vertices)
    for k, point in enumerate(graph.landmarks):
        v = g2o.VertexPointXY()
        v.set_id(n + k)
        v.set_estimate(point)
        v.set_fixed(bool(graph.fixed_landmarks[k]))
        vertices.append(v)
    for v in vertices:
        optimizer.add_vertex(v)
    edges = []
    for table, make, shift in (
        (graph.edges, g2o.EdgeSE2, 0),
        (graph.sightings, g2o.EdgeSE2PointXY, n),
    ):
        for (i, j), z, info in zip(table.nodes, table.measured, table.information, strict=True):
            e = make()
            e.set_vertex(0, vertices[i])
            e.set_vertex(1, vertices[shift + j])
            e.set_measurement(g2o.SE2(*z) if shift == 0 and len(z) == 3 else z)
            e.set_information(info)
            optimizer.add_edge(e)
            edges.append(e)
    _KEEP.append((optimizer, vertices, edges))

    def go() -> int:
        optimizer.initialize_optimization()
        return int(optimizer.optimize(iterations))

    ms, steps = timed(go)
    for i in range(n):
        T = vertices[i].estimate()
        graph.poses[i] = [*T.translation(), T.rotation().angle()]
    for k in range(len(graph.landmarks)):
        graph.landmarks[k] = np.ravel(vertices[n + k].estimate())
    return Run(ms, steps)


def single_thread() -> None:
    """Let the libraries that are loaded from now on use one thread; all are measured by CPU."""
    for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(name, '1')


def gtsam_graph(graph: Graph) -> tuple[Any, Any]:
    """(values, factors) of a graph's edges and sightings; landmark k has the key poses + k."""
    import gtsam

    n = len(graph.poses)
    values, fg = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for i, pose in enumerate(graph.poses):
        values.insert(i, gtsam.Pose2(*pose))
    for k, point in enumerate(graph.landmarks):
        values.insert(n + k, point)
    e, s = graph.edges, graph.sightings
    for (i, j), z, info in zip(e.nodes, e.measured, e.information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(info)
        fg.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*z), noise))
    for (i, k), z, info in zip(s.nodes, s.measured, s.information, strict=True):
        fg.add(bearing_range(int(i), int(n + k), z, info))
    return values, fg


def run_gtsam(graph: Graph, iterations: int, algorithm: str) -> Run:
    """GTSAM with its default parameters; its edges have the group logarithm as residual.

    A sighting becomes a range and bearing factor with the covariance carried over.
    """
    import gtsam

    values, fg = gtsam_graph(graph)
    n = len(graph.poses)
    for fixed in np.flatnonzero(graph.fixed_poses):
        exact = gtsam.noiseModel.Constrained.All(3)
        fg.add(gtsam.PriorFactorPose2(int(fixed), gtsam.Pose2(*graph.poses[fixed]), exact))
    options = getattr(gtsam, f'{algorithm}Params')()
    options.setMaxIterations(iterations)
    optimizer = getattr(gtsam, f'{algorithm}Optimizer')(fg, values, options)
    ms, result = timed(optimizer.optimize)
    for pose in range(n):
        T = result.atPose2(pose)
        graph.poses[pose] = [T.x(), T.y(), T.theta()]
    for k in range(len(graph.landmarks)):
        graph.landmarks[k] = np.ravel(result.atPoint2(n + k))
    return Run(ms, int(optimizer.iterations()))


class Isam:
    """GTSAM's iSAM2 with its default thresholds, relinearising at every step."""

    def __init__(self, source: Graph) -> None:
        import gtsam

        self.gtsam, self.source = gtsam, source
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        self.solver = gtsam.ISAM2(parameters)
        self.seen: set[int] = set()

    def step(self, index: int, edges: NDArray[np.int64], sightings: NDArray[np.int64]) -> float:
        """CPU time of the update with a pose, its edges and its sightings [ms]."""
        gtsam, source = self.gtsam, self.source
        values, fg = gtsam.Values(), gtsam.NonlinearFactorGraph()
        pose = self._start(index, edges)
        values.insert(index, pose)
        if source.fixed_poses[index]:
            fg.add(gtsam.PriorFactorPose2(index, pose, gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
        e, s = source.edges, source.sightings
        for row in edges:
            i, j = (int(k) for k in e.nodes[row])
            noise = gtsam.noiseModel.Gaussian.Information(e.information[row])
            fg.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*e.measured[row]), noise))
        for row in sightings:
            k, z = len(source.poses) + int(s.nodes[row, 1]), s.measured[row]
            if k not in self.seen:
                self.seen.add(k)
                values.insert(k, pose.transformFrom(z))
            fg.add(bearing_range(index, k, z, s.information[row]))

        def update() -> None:
            self.solver.update(fg, values)
            self.solver.calculateEstimatePose2(index)

        return timed(update)[0]

    def _start(self, index: int, edges: NDArray[np.int64]) -> Any:
        """The new pose from an edge to an earlier one, the preceding one if there is such."""
        gtsam, e = self.gtsam, self.source.edges
        if not len(edges):
            return gtsam.Pose2(*self.source.poses[index])
        nodes = e.nodes[edges]
        row = int(np.argmin(np.abs(np.abs(nodes[:, 0] - nodes[:, 1]) - 1)))
        i, j = (int(k) for k in nodes[row])
        delta = gtsam.Pose2(*e.measured[edges[row]])
        if j == index:
            return self.solver.calculateEstimatePose2(i).compose(delta)
        return self.solver.calculateEstimatePose2(j).compose(delta.inverse())

    def estimate(self) -> None:
        """Write the estimate into the graph."""
        values, n = self.solver.calculateEstimate(), len(self.source.poses)
        for i in range(n):
            T = values.atPose2(i)
            self.source.poses[i] = [T.x(), T.y(), T.theta()]
        for k in self.seen:
            self.source.landmarks[k - n] = np.ravel(values.atPoint2(k))


def bearing_range(i: int, k: int, z: Array, information: Array) -> Any:
    """A sighting (2,) as GTSAM's bearing and range factor, with the covariance carried over."""
    import gtsam

    r = float(np.hypot(*z))
    J = np.array([[-z[1] / r**2, z[0] / r**2], z / r])  # of (bearing, range) in (x, y)
    noise = gtsam.noiseModel.Gaussian.Covariance(J @ np.linalg.inv(information) @ J.T)
    bearing = gtsam.Rot2(float(np.arctan2(z[1], z[0])))
    return gtsam.BearingRangeFactor2D(i, k, bearing, r, noise)


def run_ceres(graph: Graph, iterations: int) -> Run:
    """Ceres with its default parameters, less the time of the residuals and Jacobians.

    pyceres has no planar factors, so they are Python here; leaving their time out makes the
    figure a lower bound.
    """
    import pyceres

    class Factor(pyceres.CostFunction):
        def __init__(self, function: Any, z: Any, root: Any, sizes: list[int]) -> None:
            pyceres.CostFunction.__init__(self)
            self.set_num_residuals(len(root))
            self.set_parameter_block_sizes(sizes)
            self.function, self.z, self.root = function, z, root

        def Evaluate(self, x: Any, residuals: Any, jacobians: Any) -> bool:
            e, J_0, J_1 = self.function(x[0], x[1], self.z)
            residuals[:] = self.root @ e
            if jacobians is not None:
                for J, out in zip((J_0, J_1), jacobians, strict=True):
                    if out is not None:
                        out[:] = (self.root @ J).ravel()
            return True

    problem = pyceres.Problem()
    poses = [p.copy() for p in graph.poses]
    points = [p.copy() for p in graph.landmarks]
    keep = []
    for table, function, ends, sizes in (
        (graph.edges, factors.relative_pose, poses, [3, 3]),
        (graph.sightings, factors.pose_landmark, points, [3, 2]),
    ):
        roots = np.linalg.cholesky(table.information).swapaxes(1, 2)
        for (i, j), z, root in zip(table.nodes, table.measured, roots, strict=True):
            factor = Factor(function, z, root, sizes)
            keep.append(factor)
            problem.add_residual_block(factor, pyceres.TrivialLoss(), [poses[i], ends[j]])
    for i in np.flatnonzero(graph.fixed_poses):
        problem.set_parameter_block_constant(poses[i])
    options = pyceres.SolverOptions()
    options.max_num_iterations = iterations
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.num_threads = 1
    options.minimizer_progress_to_stdout = False
    summary = pyceres.SolverSummary()
    pyceres.solve(options, problem, summary)
    graph.poses[:] = poses
    graph.landmarks[:] = np.reshape(points, (-1, 2))
    outside = (
        summary.residual_evaluation_time_in_seconds + summary.jacobian_evaluation_time_in_seconds
    )
    steps = summary.num_successful_steps + summary.num_unsuccessful_steps
    return Run((summary.total_time_in_seconds - outside) * 1e3, int(steps))
