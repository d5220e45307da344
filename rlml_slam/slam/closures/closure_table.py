# SPDX-License-Identifier: Apache-2.0
"""Loop closures of a map as a table of comma-separated values, one row per closure."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable

from rlml_slam.slam.closures.loop_closure import Closure, State

COLUMNS = (
    'number', 'keyframe_i', 'keyframe_j', 'state', 'residual', 'weight', 'score', 'overlap',
    'second', 'reason', 'history',
)  # fmt: skip


def closure_table(closures: Iterable[Closure]) -> str:
    """Table of the accepted closures; ``history`` is keyframe:weight of each change of weight.

    ``residual`` is the squared Mahalanobis norm, chi-square distributed with 3 degrees of freedom
    for correct closures; ``score``, ``overlap`` and ``second`` are those of the scan match.
    """
    out = io.StringIO()
    table = csv.writer(out, lineterminator='\n')
    table.writerow(COLUMNS)
    for c in closures:
        if c.accepted:
            status = c.status
            history = ' '.join(f'{n.keyframe}:{n.weight:.2f}' for n in status.history)
            table.writerow((
                c.number, c.i, c.j, status.state.name.lower(), _number(status.residual),
                _number(weight(c)), f'{c.score:.3f}', _number(c.overlap), _number(c.second),
                status.reason or c.why, history,
            ))  # fmt: skip
    return out.getvalue()


def weight(closure: Closure) -> float:
    """Robust weight in the graph; 0 for a disabled or revoked closure."""
    return closure.status.weight if closure.status.state is State.ACTIVE else 0.0


def state_counts(closures: Iterable[Closure]) -> dict[str, int]:
    """Numbers of disabled and revoked closures, by their names in diagnostics."""
    states = Counter(c.status.state for c in closures)
    return {f'closures {s.name.lower()}': states[s] for s in (State.DISABLED, State.REVOKED)}


def describe(closure: Closure) -> str:
    """State of a closure in one line of text."""
    status = closure.status
    reason = f': {status.reason}' if status.reason else ''
    return (
        f'loop closure {closure.number} (keyframes {closure.i} and {closure.j}) is '
        f'{status.state.name.lower()}{reason}'
    )


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else ''
