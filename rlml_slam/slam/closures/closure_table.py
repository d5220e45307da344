# SPDX-License-Identifier: Apache-2.0
"""The loop closures of a map as a table of comma-separated values, a row each."""

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
    """Those that were accepted; ``history`` is keyframe:weight of each change of the weight.

    ``residual`` is the squared Mahalanobis norm, chi-square with 3 degrees of freedom if all is
    well; ``score``, ``overlap`` and ``second`` are those of the match that it was accepted for.
    """
    out = io.StringIO()
    table = csv.writer(out, lineterminator='\n')
    table.writerow(COLUMNS)
    for c in closures:
        if c.accepted:
            fate = c.fate
            history = ' '.join(f'{n.keyframe}:{n.weight:.2f}' for n in fate.notes)
            table.writerow((
                c.number, c.i, c.j, fate.state.name.lower(), _number(fate.residual),
                _number(weight(c)), f'{c.score:.3f}', _number(c.overlap), _number(c.second),
                fate.reason or c.why, history,
            ))  # fmt: skip
    return out.getvalue()


def weight(closure: Closure) -> float:
    """What it counts now: 0 of one that is out of the map."""
    return closure.fate.weight if closure.fate.state is State.ACTIVE else 0.0


def fates(closures: Iterable[Closure]) -> dict[str, int]:
    """How many are out of the map, by what they are called in diagnostics."""
    states = Counter(c.fate.state for c in closures)
    return {f'closures {s.name.lower()}': states[s] for s in (State.DISABLED, State.REVOKED)}


def told(closure: Closure) -> str:
    """Its state in one line for a person."""
    fate = closure.fate
    reason = f': {fate.reason}' if fate.reason else ''
    return (
        f'loop closure {closure.number} (keyframes {closure.i} and {closure.j}) is '
        f'{fate.state.name.lower()}{reason}'
    )


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else ''
