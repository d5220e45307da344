# SPDX-License-Identifier: Apache-2.0
"""Graduated non-convexity: the weights of the paper, and what they do to wrong closures."""

from __future__ import annotations

import numpy as np
from made_graphs import WRONG, laps, spoil
from numpy.testing import assert_allclose, assert_array_equal

from rlml_lab.bench import graduated_non_convexity
from rlml_lab.bench.graduated_non_convexity import graduate, truncated_weights
from rlml_slam import params
from rlml_slam.graph.batch.gauss_newton import gauss_newton

EXACT = params.Solver(max_iterations=100, relative_tolerance=1e-12)


def test_weights_of_graduated_non_convexity_are_those_of_the_paper():
    s = np.array([0.0, 1.0, 3.9, 4.1, 100.0])
    assert_array_equal(truncated_weights(s, 2.0, 1e6) > 0.5, s < 4.0)
    mu = 0.7  # in between: the formula of the paper, continuous at both ends
    low, high = mu / (mu + 1.0) * 4.0, (mu + 1.0) / mu * 4.0
    assert_allclose(truncated_weights(np.array([0.0, low, high]), 2.0, mu), [1, 1, 0], atol=1e-12)
    middle = truncated_weights(np.array([4.0]), 2.0, mu)
    assert_allclose(middle, np.sqrt(mu * (mu + 1.0)) - mu)


def test_graduated_non_convexity_disables_a_few_wrong_closures():
    graph = laps()
    wrong = spoil(graph, WRONG[:3])
    graduated = graduate(graph, EXACT)
    refused = graduated.edges[graduated.weights < 0.5]
    assert set(wrong) <= set(refused)
    # the truncation at 99 % costs some of the right ones as well
    assert len(refused) - len(wrong) <= 2
    assert_array_equal(np.flatnonzero(~graph.edges.enabled), refused)


def test_every_round_of_graduated_non_convexity_starts_where_the_first_did(monkeypatch):
    starts = []

    def spy(system, poses, *rest):
        starts.append(poses.copy())
        return gauss_newton(system, poses, *rest)

    monkeypatch.setattr(graduated_non_convexity, 'gauss_newton', spy)
    graph = laps()
    spoil(graph, WRONG)
    graph.poses[1:, 0] += 0.1
    before = graph.poses.copy()
    assert graduate(graph, EXACT).rounds == len(starts) > 1
    for start in starts:
        assert_array_equal(start, before)
