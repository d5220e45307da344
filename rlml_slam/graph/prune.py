# SPDX-License-Identifier: Apache-2.0
"""Edges that go where there are more of them than a graph needs, those first that tell the least.

The leverage of an edge is the share of what is known of where its pose j is from its pose i that
comes from itself, h = tr(Q W) / 3 with its information W and the covariance Q of its residual by
the whole graph (the effective resistance by which Spielman & Srivastava, "Graph sparsification by
effective resistances", 2011, tell which edges matter). Those of all edges sum up to the number of
free poses at most, so of m edges to a pose the least has a leverage below 1 / m: most of what it
tells is known without it. What is left is what was measured: nothing becomes surer than it was.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph.factors import chi2, relative_pose
from rlml_slam.graph.graph import Graph
from rlml_slam.graph.marginals import Marginals
from rlml_slam.graph.prediction import residual_covs
from rlml_slam.graph.robust import loss
from rlml_slam.se2 import Array

# Leverage that an edge which goes may have in any direction, and all that go at a time together.
# The edges of a cut have one or more in sum: so none is cut through.
AT_ONCE = 0.5


def prune(graph: Graph, may: NDArray[np.bool_], most: int) -> NDArray[np.int64]:
    """Disable edges of those that ``may`` (e,) go until there are ``most``; which they were (k,).

    More are left where too many would have to go at a time. The estimate is to be the optimum.
    """
    e = graph.edges
    use = np.flatnonzero(e.enabled)
    if len(use) <= most:
        return use[:0]
    h = leverages(graph)
    total, largest = np.trace(h, axis1=1, axis2=2) / 3.0, np.linalg.eigvals(h).real.max(axis=1)
    order = np.argsort(total, kind='stable')
    order = order[may[use][order] & (largest[order] < AT_ONCE)]
    gone: NDArray[np.int64] = use[order[np.cumsum(total[order]) < AT_ONCE][: len(use) - most]]
    e.enabled[gone] = False
    return gone


def leverages(graph: Graph) -> Array:
    """Q W (k, 3, 3) of all enabled edges, in their order; robust weights count."""
    e = graph.edges
    use = np.flatnonzero(e.enabled)
    i, j = e.nodes[use].T
    information = e.information[use]
    residual = relative_pose(graph.poses[i], graph.poses[j], e.measured[use])[0]
    losses = graph.losses.in_order()
    of = [losses[code] for code in e.kinds[use].tolist()]
    s = chi2(residual, information).tolist()
    w = np.array([loss(int(one.kind), one.scale, v)[1] for one, v in zip(of, s, strict=True)])
    out: Array = residual_covs(graph, Marginals(graph)) @ information * w[:, None, None]
    return out
