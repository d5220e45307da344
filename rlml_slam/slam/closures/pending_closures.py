# SPDX-License-Identifier: Apache-2.0
"""Which pending closures are right, judged by all closures together, once all of them are known.

After a long loop the covariance of the graph is often many times too small, and then the check of
each closure as it comes (closure_consistency.py) asks for more viewpoints than a drive has. The
selection among all closures finds how far errors really are from their covariances
(graph/robust/closure_selection.py), and takes groups that agree as one. It is made on a copy of
the graph: closures that were accepted before are not touched, and pending ones that it refutes
leave no trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import numpy as np

from rlml_slam.graph import Graph, Selection, select_closures
from rlml_slam.params import Parameters
from rlml_slam.slam.closures.closure_consistency import Ints
from rlml_slam.slam.closures.closure_matching import Match
from rlml_slam.slam.closures.closure_monitor import MAJORITY
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.loop_closure import State
from rlml_slam.types import EdgeKind

MIN_VIEWS = 2  # keyframes that one closure needs, as a pending one is not enough alone


def confirmed(
    graph: Graph, records: ClosureRecords, pending: Sequence[Match], p: Parameters
) -> list[bool]:
    """Of each pending match, whether it is right; none if they are of one keyframe."""
    if len({c.key.index for c in pending}) < MIN_VIEWS:
        return [False] * len(pending)
    revoked = [c.edge for c in records.accepted() if c.status.state is State.REVOKED]
    active = np.flatnonzero(graph.edges.enabled)

    def select(trial: Graph) -> tuple[Selection, Ints]:
        # covariances of this graph are right for what is short: errors of a long way are not less
        found = select_closures(trial, p.solver, np.array(revoked, np.int64), least_scale=1.0)
        return found, np.intersect1d(found.edges[~found.accepted], active)

    trial = deepcopy(graph)
    edges = [trial.add_edge(EdgeKind.CLOSURE, *c.edge(p.loop_closure)) for c in pending]
    chosen, refuted = select(trial)
    num_active = np.isin(chosen.edges, active).sum()
    if num_active - len(refuted) < MAJORITY * num_active:
        return [False] * len(pending)
    if len(refuted) and not np.isin(refuted, select(deepcopy(graph))[1]).all():
        return [False] * len(pending)  # it takes them instead of one that is accepted
    # what alone connects two parts was not tested
    right = np.isin(edges, chosen.edges[chosen.accepted & np.isfinite(chosen.evidence)])
    views = {c.key.index for c, is_right in zip(pending, right, strict=True) if is_right}
    return [bool(r) for r in right & (len(views) >= MIN_VIEWS)]
