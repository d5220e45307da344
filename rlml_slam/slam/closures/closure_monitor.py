# SPDX-License-Identifier: Apache-2.0
"""What becomes of loop closures: watched after each solve, disabled when they turn out wrong.

A closure that fitted where it was made may contradict what is learned later. When the residual of
one is likelier that of a wrong match, anywhere in the window it was searched in, than that of a
right one, all closures are judged anew (graph/selection.py): those that agree with odometry and
each other stay, the others are disabled, and come back if they are judged right later on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import SolverError
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model import factors
from rlml_slam.graph.model.robust_loss import weights
from rlml_slam.graph.robust.closure_selection import select_closures
from rlml_slam.graph.robust.inlier_evidence import evidence, uniform
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.loop_closure import Closure, Fate, State

# judging all anew takes as long as many solves: after one, the graph must have grown this much
GROWTH = 1.5
MAJORITY = 0.9  # share of all closures that must be right where some are called wrong
CHANGED = 0.05  # change of a weight that is noted


class ClosureMonitor:
    """Notes residuals and weights, disables, revokes; closures are those of a ScanGraph."""

    def __init__(self, params: Parameters, live: OnlineSolver) -> None:
        self._p = params
        self._live = live
        self._graph = live.graph
        self._wrong = uniform(params.loop_closure.searched)
        self._judged = 0

    def review(self, closures: ClosureRecords, final: bool = False) -> tuple[Closure, ...]:
        """After a solve: note how each fares; those whose state changed, in a graph solved anew.

        With ``final`` doubts are settled whenever the last time was.
        """
        edges = closures.edges
        if not len(edges):
            return ()
        doubtful = self._note(edges, closures.fates)
        poses = len(self._graph.poses)
        if not doubtful or not (final or poses >= GROWTH * self._judged):
            return ()
        self._judged = poses
        return self._judge(closures.accepted())

    def revoke(self, closures: ClosureRecords, number: int) -> Closure:
        """Take a closure out for good; raises SolverError if there is no such one."""
        found = next((c for c in closures.accepted(number) if c.number == number), None)
        if found is None:
            raise SolverError(f'there is no loop closure {number}')
        if found.fate.state is State.REVOKED:
            raise SolverError(f'loop closure {number} is revoked already')
        found.fate.turn(State.REVOKED, 'revoked by a person')
        self._graph.edges.enabled[found.edge] = False
        return found

    def _note(self, edges: NDArray[np.int64], fates: Sequence[Fate]) -> bool:
        """Residual and weight of each; whether one that is active is likelier wrong."""
        graph = self._graph
        i, j = graph.edges.nodes[edges].T
        e = factors.relative_pose(graph.poses[i], graph.poses[j], graph.edges.measured[edges])[0]
        information = graph.edges.information[edges]
        s, on = factors.chi2(e, information), graph.edges.enabled[edges]
        one = graph.losses.closure
        w = np.where(on, weights(int(one.kind), one.scale, s), 0.0)
        last = np.array([fate.weight for fate in fates])
        switched = (w == 0.0) != (last == 0.0)
        for k in np.flatnonzero(np.isnan(last) | switched | (np.abs(w - last) > CHANGED)).tolist():
            fates[k].note(len(graph.poses) - 1, float(s[k]), float(w[k]))
        for fate, residual in zip(fates, s.tolist(), strict=True):
            fate.residual = residual
        doubt = on & (self._evidence(e, information) < 0.0)
        return bool(doubt.any())

    def _evidence(self, e: Array, information: Array) -> Array:
        cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return evidence(e, cov, 1.0, self._wrong)

    def _judge(self, closures: Sequence[Closure]) -> tuple[Closure, ...]:
        """Judge all anew; those whose state changed."""
        revoked = [c.edge for c in closures if c.fate.state is State.REVOKED]
        before = self._graph.edges.enabled.copy()
        chosen = select_closures(self._graph, self._p.solver, np.array(revoked, np.int64))
        # of what is neither proven nor refuted yet, the verification when it was made is believed
        good = chosen.accepted | (chosen.evidence > 0.0)
        is_revoked = np.isin(chosen.edges, revoked)
        if np.sum(good) < MAJORITY * np.sum(~is_revoked):
            # not so many matches fail that were verified: odometry is off, and all stays as it was
            good = before[chosen.edges]
        good[is_revoked] = False
        self._graph.edges.enabled[chosen.edges] = good
        self._live.solve_all()
        is_good = dict(zip(chosen.edges.tolist(), good.tolist(), strict=True))
        changed = []
        for c in closures:
            right = is_good.get(c.edge, True)  # one that stands for several is no closure any more
            state = State.ACTIVE if right else State.DISABLED
            if c.fate.state not in (state, State.REVOKED):
                why = 'agrees again' if right else 'contradicts the other closures'
                c.fate.turn(state, why)
                changed.append(c)
        self._note(np.array([c.edge for c in closures]), [c.fate for c in closures])
        return tuple(changed)
