# SPDX-License-Identifier: Apache-2.0
"""Records of loop closures, with pose and edge indices that follow the graph's renumbering.

Each marginalized keyframe renumbers up to a thousand records, so the indices are stored in
columns and a record is updated only when it is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph import Column, Renumbering
from rlml_slam.slam.closures.loop_closure import Closure, ClosureStatus, State

RECORDS = 2000  # kept at most; beyond, the oldest rejected closures are removed

Ints = NDArray[np.int64]
FROM, TO, EDGE, NUMBER = range(4)  # columns: i, j, edge, number


class ClosureRecords(Sequence[Closure]):
    """Closures in order of time, with the graph's current indices."""

    def __init__(self, closures: Iterable[Closure] = ()) -> None:
        self._records: list[Closure] = []
        self._indices = Column((4,), np.int64)
        self.extend(closures)

    def __len__(self) -> int:
        return len(self._records)

    @overload
    def __getitem__(self, k: int) -> Closure: ...
    @overload
    def __getitem__(self, k: slice) -> list[Closure]: ...
    def __getitem__(self, k: int | slice) -> Closure | list[Closure]:
        if isinstance(k, slice):
            return [self[n] for n in range(*k.indices(len(self)))]
        c = self._records[k]
        i, j, edge, _ = self._indices.view[k].tolist()
        if (c.i, c.j, c.edge) != (i, j, edge):
            c = self._records[k] = replace(c, i=i, j=j, edge=edge)
        return c

    def extend(self, closures: Iterable[Closure]) -> None:
        """Append closures."""
        new = list(closures)
        self._records += new
        rows = [(c.i, c.j, c.edge, c.number) for c in new]
        self._indices.append(np.array(rows, dtype=np.int64).reshape(-1, 4))

    def append(self, closure: Closure) -> None:
        """Append one closure."""
        self.extend([closure])

    @property
    def edges(self) -> Ints:
        """Edges of the accepted closures."""
        edge = self._indices.view[:, EDGE]
        return np.asarray(edge[edge >= 0])

    @property
    def statuses(self) -> list[ClosureStatus]:
        """Statuses of the accepted closures."""
        accepted = np.flatnonzero(self._indices.view[:, EDGE] >= 0).tolist()
        return [self._records[k].status for k in accepted]

    def accepted(self, since: int = 0) -> list[Closure]:
        """Accepted closures, from number ``since`` on."""
        at = self._indices.view
        wanted = (at[:, EDGE] >= 0) & (at[:, NUMBER] >= since)
        return [self[k] for k in np.flatnonzero(wanted).tolist()]

    def rejected_pairs(self) -> set[tuple[int, int]]:
        """Keyframe pairs (i, j) of the rejected closures."""
        at = self._indices.view
        return set(map(tuple, at[at[:, EDGE] < 0, :EDGE].tolist()))

    def remove_rejected(self, pairs: set[tuple[int, int]]) -> int:
        """Remove rejected closures between keyframes that a later closure joins; their number."""
        rejected = np.flatnonzero(self._indices.view[:, EDGE] < 0)
        ends = map(tuple, self._indices.view[rejected, :EDGE].tolist())
        removed = [k for k, pair in zip(rejected.tolist(), ends, strict=True) if pair in pairs]
        kept = np.ones(len(self), dtype=np.bool_)
        kept[removed] = False
        self._keep(kept)
        return len(removed)

    def renumber(
        self, new: Renumbering, edges: Mapping[int, int], poses: Mapping[int, int]
    ) -> None:
        """Follow the removal of keyframes from the graph.

        ``edges`` and ``poses`` map removed ones to their replacements (-1 for none), in the
        numbers before the removal. Of several closures with one replacement edge, the newest
        keeps its record.
        """
        at = self._indices.view
        onto = _replacements(len(new.poses), poses)
        instead = _replacements(len(new.edges), edges)
        i, j, edge = onto[at[:, FROM]], onto[at[:, TO]], at[:, EDGE].copy()
        accepted = edge >= 0
        edge[accepted] = instead[edge[accepted]]
        kept = np.where(accepted, (i != j) & (edge >= 0), (i == at[:, FROM]) & (j == at[:, TO]))
        linked = kept & accepted
        at[:, FROM], at[:, TO] = new.poses[i], new.poses[j]
        at[linked, EDGE] = new.edges[edge[linked]]
        newest = np.flatnonzero(linked)[::-1]
        _, first = np.unique(at[newest, EDGE], return_index=True)
        linked[:] = False
        linked[newest[first]] = True
        kept &= linked | ~accepted
        # an accepted closure is kept as long as its edge is in the graph
        rejected = np.flatnonzero(kept & ~accepted)
        kept[rejected[: max(int(kept.sum()) - RECORDS, 0)]] = False
        self._keep(kept)

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        if not kept.all():
            self._records = [self._records[k] for k in np.flatnonzero(kept).tolist()]
            self._indices.keep(kept)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All records as arrays of the map file."""
        return {
            'closure': np.array([(c.i, c.j, c.edge) for c in self], np.int64).reshape(-1, 3),
            'closure_match': np.array(
                [(*c.delta, c.score, c.overlap, c.second) for c in self]
            ).reshape(-1, 6),
            'closure_why': np.array([c.why for c in self], dtype=np.str_),
            'closure_state': np.array(
                [(c.number, c.status.state.value) for c in self], np.int64
            ).reshape(-1, 2),
            'closure_reason': np.array([c.status.reason for c in self], dtype=np.str_),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> ClosureRecords:
        """Records of a map file."""
        rows = zip(
            arrays['closure'].tolist(), arrays['closure_match'], arrays['closure_why'],
            arrays['closure_state'].tolist(), arrays['closure_reason'], strict=True,
        )  # fmt: skip
        return cls(
            Closure(
                i, j, match[:3], float(match[3]), edge, str(why), float(match[4]),
                float(match[5]), number, ClosureStatus(State(state), str(reason)),
            )
            for (i, j, edge), match, why, (number, state), reason in rows
        )  # fmt: skip


def _replacements(num: int, of: Mapping[int, int]) -> Ints:
    """Index (num,) that stands for each one, its own where it stays."""
    out = np.arange(num)
    out[list(of)] = list(of.values())
    return out
