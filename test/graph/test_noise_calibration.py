# SPDX-License-Identifier: Apache-2.0
"""Noise calibration: scales of errors; an edge left out is predicted by the rest."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from test_closure_selection import laps, optimum

from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.model.factors import FactorKind, relative_pose
from rlml_slam.graph.robust.inlier_evidence import near_by, uniform
from rlml_slam.graph.robust.noise_calibration import FREEDOMS, Calibration, calibrate
from rlml_slam.graph.robust.relative_covariance import (
    difference_covs,
    left_out,
    most_difference_covs,
)

S = np.diag([0.1, 0.1, 0.05]) ** 2
A2, B2 = 0.01, 0.5  # translation is stated ten times too uncertain
WRONG = float(uniform(1e4))


def errors(rng, right=300, wrong=300, nu=None):
    """Right ones, Gaussian or of Student's t, then wrong ones; stated covariances."""
    true = S * np.diag([A2, A2, B2])
    law = stats.multivariate_normal(cov=true) if nu is None else None
    drawn = stats.multivariate_t(shape=true, df=nu) if law is None else law
    spread = rng.uniform([-50, -50, -np.pi], [50, 50, np.pi], (wrong, 3))
    e = np.concatenate([drawn.rvs(right, random_state=rng), spread])
    return e, np.broadcast_to(S, (len(e), 3, 3))


@pytest.mark.parametrize('nu', [None, 3.0])
def test_factors_and_tails_are_found_among_wrong_errors(nu):
    e, covs = errors(np.random.default_rng(0), nu=nu)
    found = calibrate(e, covs, 0.05, WRONG)
    best = int(np.argmax(found.chances))
    # 600 and 300 squares: relative errors of sqrt(2 / 300) at most, more for the heavy tails
    assert_allclose(found.scales[best], [A2, B2], rtol=0.35)
    assert np.exp(found.chances).sum() == pytest.approx(1.0)
    assert FREEDOMS[best] >= 10.0 if nu is None else FREEDOMS[best] == nu


def test_without_errors_what_was_believed_holds():
    found = calibrate(np.zeros((0, 3)), np.zeros((0, 3, 3)), 0.3, WRONG)
    # -log v - 0.3 / v has its top at 0.3; the fit stops where nothing is gained
    assert_allclose(found.scales, 0.3, rtol=1e-3)
    assert_allclose(np.exp(found.chances), 1.0 / len(FREEDOMS))


def test_evidence_is_the_ratio_of_averaged_student_densities_and_a_uniform_one():
    rng = np.random.default_rng(1)
    A = rng.standard_normal((3, 3))
    full, e = A @ A.T + np.eye(3), rng.standard_normal(3)
    scales = np.array([(0.2 + k, 0.7) for k in range(len(FREEDOMS))])
    chances = np.log(np.arange(1.0, 6.0) / 15.0)
    # p = lever theta + rest
    lever = full[:2, 2] / full[2, 2]
    rest = full[:2, :2] - full[2, 2] * np.outer(lever, lever)
    L = np.block([[np.eye(2), lever[:, None]], [np.zeros((1, 2)), np.eye(1)]])
    each = []
    for c, (a2, b2), nu in zip(chances, scales, FREEDOMS, strict=True):
        split = np.block([[a2 * rest, np.zeros((2, 1))], [np.zeros((1, 2)), b2 * full[2:, 2:]]])
        each.append(np.exp(c) * stats.multivariate_t(shape=L @ split @ L.T, df=nu).pdf(e))
    expected = np.log(sum(each)) - WRONG
    got = Calibration(scales, chances).evidence(e[None], full[None], WRONG)
    assert got[0] == pytest.approx(expected, abs=1e-9)


def test_an_edge_left_out_is_predicted_as_by_the_graph_without_it():
    graph = laps()
    optimum(graph)
    closures = np.flatnonzero(graph.edges.kinds == FactorKind.CLOSURE)
    edges = closures[[2, 11, 30]]
    e, covs = left_out(graph, Marginals(graph), edges)
    for k, edge in enumerate(edges):
        graph.edges.enabled[:] = True
        graph.edges.enabled[edge] = False
        optimum(graph)
        i, j = graph.edges.nodes[[edge]].T
        marginals = Marginals(graph)
        R = np.linalg.inv(graph.edges.information[edge])
        S_k = difference_covs(marginals, graph.poses, i, j)[0]
        error = relative_pose(graph.poses[i], graph.poses[j], graph.edges.measured[[edge]])[0][0]
        # as far as the graph is linear between the two optima: errors of 0.01 rad in the leverage
        assert_allclose(e[k], error, atol=1e-3)
        assert_allclose(covs[k], S_k + R, atol=0.02 * np.max(S_k + R))
        rough = most_difference_covs(marginals, graph.poses, i, j)[0]
        assert np.linalg.eigvalsh(rough - S_k).min() > -1e-12


def test_wrong_closures_are_likelier_near_by_where_poses_crowd():
    rng = np.random.default_rng(2)
    spread = np.c_[rng.uniform(0, 100, (2000, 2)), np.zeros(2000)]
    z, cov = np.tile([5.0, 0.0, 0.0], (4, 1)), np.zeros((4, 3, 3))
    # evenly spread: as of the whole map, but for those within 5 m of its edge (10 %)
    assert near_by(spread, z, cov) == pytest.approx(uniform(1e4), abs=0.15)
    lane = spread * [1.0, 0.01, 1.0]  # a lane of 1 m: within 5 m are 2 * 5 of 100 m of the poses
    expected = np.log(0.1 * (1.0 - 0.025) / (np.pi * 25.0 * 2.0 * np.pi))
    assert near_by(lane, z, cov) == pytest.approx(expected, abs=0.05)
    assert near_by(spread, z[:0], cov[:0]) == pytest.approx(uniform(1e4), abs=0.01)
