# SPDX-License-Identifier: Apache-2.0
"""Records of closures go on speaking of what the graph has, whatever it lets go of."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from rlml_slam.graph.model.factor_table import renumbered
from rlml_slam.graph.model.graph import Renumbering
from rlml_slam.slam.closures import closure_records
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.loop_closure import Closure, State

POSES, EDGES = 40, 60


def tried(rng: np.random.Generator, num: int) -> list[Closure]:
    """Closures of a graph, a third of them rejected; each accepted one has an edge of its own."""
    out, edges = [], iter(rng.permutation(EDGES).tolist())
    for n in range(num):
        i, j = np.sort(rng.choice(POSES, 2, replace=False)).tolist()
        is_in = rng.random() < 0.67
        edge = next(edges) if is_in else -1
        out.append(Closure(i, j, np.zeros(3), 0.5, edge, 'why', number=n if is_in else -1))
    return out


def by_hand(closures, new, edges, poses, most):
    """The records after a renumbering, one by one."""
    kept = []
    for c in closures:
        if not c.accepted and (c.i in poses or c.j in poses):
            continue
        i, j = poses.get(c.i, c.i), poses.get(c.j, c.j)
        edge = edges.get(c.edge, c.edge)
        if c.accepted and (i == j or edge < 0):
            continue
        edge = int(new.edges[edge]) if c.accepted else -1
        kept.append(replace(c, i=int(new.poses[i]), j=int(new.poses[j]), edge=edge))
    newest = {c.edge: k for k, c in enumerate(kept) if c.accepted}
    kept = [c for k, c in enumerate(kept) if not c.accepted or newest[c.edge] == k]
    rejected = [k for k, c in enumerate(kept) if not c.accepted]
    removed = set(rejected[: max(len(kept) - most, 0)])
    return [c for k, c in enumerate(kept) if k not in removed]


def same(a: Closure, b: Closure) -> bool:
    return (a.i, a.j, a.edge, a.number) == (b.i, b.j, b.edge, b.number) and a.status is b.status


@pytest.mark.parametrize('most', [2000, 30])
@pytest.mark.parametrize('seed', range(20))
def test_records_follow_the_graph(seed, most, monkeypatch):
    monkeypatch.setattr(closure_records, 'RECORDS', most)
    rng = np.random.default_rng(seed)
    expected = tried(rng, 55)
    records = ClosureRecords(expected)
    num_poses, num_edges = POSES, EDGES
    for _ in range(4):
        removed = rng.choice(num_poses, 4, replace=False).tolist()
        stay = np.setdiff1d(np.arange(num_poses), removed)
        poses = {k: int(rng.choice(stay)) for k in removed}
        lost = rng.choice(num_edges, 8, replace=False).tolist()
        left = np.setdiff1d(np.arange(num_edges), lost)
        edges = {k: int(rng.choice(left)) if rng.random() < 0.6 else -1 for k in lost}
        none = np.zeros(0, dtype=np.int64)
        new = Renumbering(
            renumbered(np.isin(np.arange(num_poses), stay)), none,
            renumbered(np.isin(np.arange(num_edges), left)), none, none, none,
        )  # fmt: skip
        expected = by_hand(expected, new, edges, poses, most)
        records.renumber(new, edges, poses)
        num_poses, num_edges = len(stay), len(left)
        assert records.edges.tolist() == [c.edge for c in expected if c.accepted]
        assert records.rejected_pairs() == {(c.i, c.j) for c in expected if not c.accepted}
        for status, c in zip(records.statuses, [c for c in expected if c.accepted], strict=True):
            assert status is c.status
        late = [c for c in expected if c.accepted and c.number >= 20]
        assert all(map(same, records.accepted(20), late))
        assert len(records.accepted(20)) == len(late)
    assert len(expected) > 3
    assert len(records) == len(expected)
    assert all(map(same, records, expected))
    assert all(map(same, records[1:3], expected[1:3]))


def test_a_pair_that_is_tied_after_all_has_not_failed():
    records = ClosureRecords(tried(np.random.default_rng(1), 40))
    before, pair = list(records), next(c for c in records if not c.accepted)
    num_removed = sum(not c.accepted and (c.i, c.j) == (pair.i, pair.j) for c in before)
    assert records.remove_rejected({(pair.i, pair.j)}) == num_removed
    assert (pair.i, pair.j) not in records.rejected_pairs()
    assert len(records) == len(before) - num_removed
    assert records.remove_rejected(set()) == 0


def test_a_copy_has_the_same_records():
    records = ClosureRecords(tried(np.random.default_rng(2), 20))
    records[3].status.set_state(State.DISABLED, 'for a test')
    other = pickle.loads(pickle.dumps(records))
    other.append(tried(np.random.default_rng(3), 1)[0])
    assert len(other) == 21
    assert len(records) == 20
    assert [(c.i, c.j, c.edge) for c in other][:20] == [(c.i, c.j, c.edge) for c in records]
    assert other[3].status.state is State.DISABLED
