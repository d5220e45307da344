# SPDX-License-Identifier: Apache-2.0
"""Our files in the programs of others; skipped where they are not installed (extra ``bench``)."""

from __future__ import annotations

import numpy as np
import pytest
from made_graphs import loop_graph

from rlml_slam.datasets.tum import Trajectory, write_tum
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.g2o import write_graph


@pytest.fixture
def graph():
    """Thirty poses in a loop and eight landmarks, solved; the first pose is fixed."""
    made, _, _ = loop_graph(seed=1, start_noise=0.1)
    optimize(made)
    return made


def test_g2o_reads_everything(graph, tmp_path):
    g2o = pytest.importorskip('g2opy')
    graph.add_pose_prior(3, graph.poses[3] + 0.1, np.diag([3.0, 4.0, 5.0]))
    graph.add_landmark_prior(2, graph.landmarks[2] + 0.1, np.diag([6.0, 7.0]))
    write_graph(tmp_path / 'a.g2o', graph)
    optimizer = g2o.SparseOptimizer()
    assert optimizer.load(str(tmp_path / 'a.g2o'))
    assert len(optimizer.vertices()) == len(graph.poses) + len(graph.landmarks)
    assert len(optimizer.edges()) == len(graph.edges) + len(graph.sightings) + 2
    assert [v.id() for v in optimizer.vertices().values() if v.fixed()] == [0]
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    # the same residuals, computed twice in double precision
    assert optimizer.chi2() == pytest.approx(graph.chi2(), rel=1e-9)


def test_gtsam_reads_every_pose_and_every_edge_between_poses(graph, tmp_path):
    gtsam = pytest.importorskip('gtsam')
    write_graph(tmp_path / 'a.g2o', graph)
    factors, values = gtsam.readG2o(str(tmp_path / 'a.g2o'), False)
    assert factors.size() == len(graph.edges)
    assert values.size() == len(graph.poses) + len(graph.landmarks)
    graph.sightings.enabled[:] = False
    # GTSAM's residual is the logarithm, ours the difference: the same to second order
    assert 2.0 * factors.error(values) == pytest.approx(graph.chi2(), rel=1e-2)


def test_evo_measures_the_error_that_was_made(tmp_path):
    file_interface = pytest.importorskip('evo.tools.file_interface')
    from evo.core import metrics, sync

    t = np.linspace(0.0, 6.0, 61)
    poses = np.stack([np.cos(t), np.sin(t), t + 0.5 * np.pi], -1)
    stamps = 1_700_000_000_000_000_000 + (t * 1e9).astype(np.int64)
    write_tum(tmp_path / 'true.tum', Trajectory(stamps, poses))
    write_tum(tmp_path / 'ours.tum', Trajectory(stamps, poses + np.array([0.03, 0.04, 0.0])))
    paths = [file_interface.read_tum_trajectory_file(str(tmp_path / f'{n}.tum'))
             for n in ('true', 'ours')]  # fmt: skip
    pair = sync.associate_trajectories(*paths)
    assert pair[0].num_poses == len(t)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    assert ape.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(0.05, abs=1e-8)
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_rad)
    turn.process_data(pair)
    assert turn.get_statistic(metrics.StatisticsType.max) < 1e-6
