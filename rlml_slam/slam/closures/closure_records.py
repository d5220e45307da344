# SPDX-License-Identifier: Apache-2.0
"""The records of the loop closures that were tried, as the graph lets go of keyframes.

Where they are in the graph changes with each keyframe that goes, a thousand records at a time: it
lies in columns, and a record is written anew when somebody reads it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph.model.factor_table import Column
from rlml_slam.graph.model.graph import Renumbering
from rlml_slam.slam.closures.loop_closure import Closure, Fate

RECORDS = 2000  # of closures; beyond, the oldest rejected ones go

Ints = NDArray[np.int64]
FROM, TO, EDGE, NUMBER = range(4)  # columns: i, j, edge, number


class ClosureRecords(Sequence[Closure]):
    """Closures in the order in which they were tried, by the numbers that the graph has now."""

    def __init__(self, closures: Iterable[Closure] = ()) -> None:
        self._records: list[Closure] = []
        self._at = Column((4,), np.int64)
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
        i, j, edge, _ = self._at.view[k].tolist()
        if (c.i, c.j, c.edge) != (i, j, edge):
            c = self._records[k] = replace(c, i=i, j=j, edge=edge)
        return c

    def extend(self, closures: Iterable[Closure]) -> None:
        """Add what was tried."""
        new = list(closures)
        self._records += new
        rows = [(c.i, c.j, c.edge, c.number) for c in new]
        self._at.append(np.array(rows, dtype=np.int64).reshape(-1, 4))

    def append(self, closure: Closure) -> None:
        """Add one."""
        self.extend([closure])

    @property
    def edges(self) -> Ints:
        """Of those that were accepted."""
        edge = self._at.view[:, EDGE]
        return np.asarray(edge[edge >= 0])

    @property
    def fates(self) -> list[Fate]:
        """What becomes of those that were accepted."""
        accepted = np.flatnonzero(self._at.view[:, EDGE] >= 0).tolist()
        return [self._records[k].fate for k in accepted]

    def accepted(self, since: int = 0) -> list[Closure]:
        """Those that were accepted, from number ``since`` on."""
        at = self._at.view
        wanted = (at[:, EDGE] >= 0) & (at[:, NUMBER] >= since)
        return [self[k] for k in np.flatnonzero(wanted).tolist()]

    def failed(self) -> set[tuple[int, int]]:
        """Keyframes of the rejected ones."""
        at = self._at.view
        return set(map(tuple, at[at[:, EDGE] < 0, :EDGE].tolist()))

    def take_back(self, pairs: set[tuple[int, int]]) -> int:
        """Forget rejected closures between keyframes that are tied after all; how many."""
        rejected = np.flatnonzero(self._at.view[:, EDGE] < 0)
        ends = map(tuple, self._at.view[rejected, :EDGE].tolist())
        gone = [k for k, pair in zip(rejected.tolist(), ends, strict=True) if pair in pairs]
        kept = np.ones(len(self), dtype=np.bool_)
        kept[gone] = False
        self._keep(kept)
        return len(gone)

    def renumber(
        self, new: Renumbering, edges: Mapping[int, int], poses: Mapping[int, int]
    ) -> None:
        """The graph has let go of keyframes.

        ``edges`` and ``poses`` map what went to what stands for it, by the numbers until now, -1
        for nothing. Of several closures that one edge stands for, the newest has the record.
        """
        at = self._at.view
        onto, instead = _onto(len(new.poses), poses), _onto(len(new.edges), edges)
        i, j, edge = onto[at[:, FROM]], onto[at[:, TO]], at[:, EDGE].copy()
        accepted = edge >= 0
        edge[accepted] = instead[edge[accepted]]
        kept = np.where(accepted, (i != j) & (edge >= 0), (i == at[:, FROM]) & (j == at[:, TO]))
        stands = kept & accepted
        at[:, FROM], at[:, TO] = new.poses[i], new.poses[j]
        at[stands, EDGE] = new.edges[edge[stands]]
        newest = np.flatnonzero(stands)[::-1]
        _, first = np.unique(at[newest, EDGE], return_index=True)
        stands[:] = False
        stands[newest[first]] = True
        kept &= stands | ~accepted
        # only of a rejected one is the record all there is: of the others, an edge is in the graph
        rejected = np.flatnonzero(kept & ~accepted)
        kept[rejected[: max(int(kept.sum()) - RECORDS, 0)]] = False
        self._keep(kept)

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        if not kept.all():
            self._records = [self._records[k] for k in np.flatnonzero(kept).tolist()]
            self._at.keep(kept)


def _onto(num: int, of: Mapping[int, int]) -> Ints:
    """What each of ``num`` goes to."""
    out = np.arange(num)
    out[list(of)] = list(of.values())
    return out
