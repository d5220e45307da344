# SPDX-License-Identifier: Apache-2.0
"""Monitoring of loop closures after each solve: wrong ones are disabled, correct ones restored.

A closure whose residual is more likely under the density of wrong matches than under that of
correct ones triggers a selection among all closures (graph/robust/closure_selection.py): those
consistent with odometry and with each other stay enabled, and those that fit the robust estimate;
the others are disabled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import SolverError
from rlml_slam.graph import (
    Graph,
    chi2,
    evidence,
    loss_weights,
    relative_pose,
    select_closures,
    uniform,
)
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.loop_closure import Closure, ClosureStatus, State

# a selection takes as long as many solves: before the next one, the poses or the closures of the
# graph grow by this factor
GROWTH = 1.5
MAJORITY = 0.9  # share of all closures that must be correct for a selection to be applied
WEIGHT_STEP = 0.05  # smallest change of a weight that is recorded


class ClosureMonitor:
    """Residuals, weights and states of the accepted closures of a graph."""

    def __init__(self, params: Parameters, graph: Graph) -> None:
        self._p = params
        self._graph = graph
        self._wrong = uniform(params.loop_closure.searched)
        self._size_at_selection = np.zeros(2)

    def needs_selection(self, closures: ClosureRecords, final: bool = False) -> bool:
        """Record residuals and weights; whether an active closure is more likely wrong.

        A selection that was made recently is not repeated, unless ``final``.
        """
        edges = closures.edges
        if not len(edges):
            return False
        is_wrong = self._record(edges, closures.statuses)
        size = np.array([len(self._graph.poses), len(edges)])
        if not is_wrong or not (final or (size >= GROWTH * self._size_at_selection).any()):
            return False
        self._size_at_selection = size
        return True

    def select(self, closures: ClosureRecords) -> dict[int, bool]:
        """Enable the consistent closures, disable the others; whether each edge is enabled.

        The estimate is moved: the graph has to be solved after it.
        """
        accepted = closures.accepted()
        revoked = [c.edge for c in accepted if c.status.state is State.REVOKED]
        before = self._graph.edges.enabled.copy()
        fitting = self._fitting(closures.edges)
        chosen = select_closures(self._graph, self._p.solver, np.array(revoked, np.int64))
        # a closure that is neither confirmed nor refuted stays: it was verified when it was made
        good = chosen.accepted | (chosen.evidence > 0.0)
        is_revoked = np.isin(chosen.edges, revoked)
        if np.sum(good) < MAJORITY * np.sum(~is_revoked):
            # so many verified matches are not wrong: the odometry is, and nothing is changed
            good = before[chosen.edges]
        # one that fits the robust estimate as well: a selection trusts odometry, which may slip
        good |= np.isin(chosen.edges, fitting)
        good[is_revoked] = False
        self._graph.edges.enabled[chosen.edges] = good
        return dict(zip(chosen.edges.tolist(), good.tolist(), strict=True))

    def update_states(
        self, closures: ClosureRecords, enabled: Mapping[int, bool]
    ) -> tuple[Closure, ...]:
        """Set the states after a selection and the solve that follows; the changed closures."""
        accepted, changed = closures.accepted(), []
        for c in accepted:
            # an edge that replaces several is no longer of kind closure, and stays
            is_enabled = enabled.get(c.edge, True)
            state = State.ACTIVE if is_enabled else State.DISABLED
            if c.status.state not in (state, State.REVOKED):
                why = 'consistent again' if is_enabled else 'inconsistent with the other closures'
                c.status.set_state(state, why)
                changed.append(c)
        self._record(np.array([c.edge for c in accepted]), [c.status for c in accepted])
        return tuple(changed)

    def revoke(self, closures: ClosureRecords, number: int) -> Closure:
        """Disable a closure for good; raises SolverError if there is none of this number."""
        found = next((c for c in closures.accepted(number) if c.number == number), None)
        if found is None:
            raise SolverError(f'there is no loop closure {number}')
        if found.status.state is State.REVOKED:
            raise SolverError(f'loop closure {number} is already revoked')
        found.status.set_state(State.REVOKED, 'revoked by the user')
        self._graph.edges.enabled[found.edge] = False
        return found

    def _record(self, edges: NDArray[np.int64], statuses: Sequence[ClosureStatus]) -> bool:
        """Record residuals and weights; whether any enabled one is more likely wrong."""
        graph = self._graph
        e, information = self._errors(edges)
        s, on = chi2(e, information), graph.edges.enabled[edges]
        loss = graph.losses.closure
        w = np.where(on, loss_weights(int(loss.kind), loss.scale, s), 0.0)
        last = np.array([status.weight for status in statuses])
        changed = np.isnan(last) | ((w == 0.0) != (last == 0.0)) | (np.abs(w - last) > WEIGHT_STEP)
        for k in np.flatnonzero(changed).tolist():
            statuses[k].record(len(graph.poses) - 1, float(s[k]), float(w[k]))
        for status, residual in zip(statuses, s.tolist(), strict=True):
            status.residual = residual
        return bool((on & (self._evidence(e, information) < 0.0)).any())

    def _errors(self, edges: NDArray[np.int64]) -> tuple[Array, Array]:
        """Residuals (k, 3) of the estimate as it is, and their information (k, 3, 3)."""
        poses, e = self._graph.poses, self._graph.edges
        i, j = e.nodes[edges].T
        return relative_pose(poses[i], poses[j], e.measured[edges])[0], e.information[edges]

    def _fitting(self, edges: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those that are rather right by their residuals."""
        return edges[self._evidence(*self._errors(edges)) >= 0.0]

    def _evidence(self, e: Array, information: Array) -> Array:
        """Log likelihood ratio (k,) of correct to wrong."""
        cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return evidence(e, cov, 1.0, self._wrong)
