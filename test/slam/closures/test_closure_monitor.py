# SPDX-License-Identifier: Apache-2.0
"""A wrong closure is disabled, reported, and may come back; a revoked one may not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.cli import closures as command
from rlml_slam.cli.main import main
from rlml_slam.errors import InputError, MapError, SolverError
from rlml_slam.graph import loss_weights
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factors import Losses
from rlml_slam.graph.model.graph import Graph, Renumbering
from rlml_slam.graph.model.robust_loss import Loss, LossKind
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import _losses as back_end_losses
from rlml_slam.slam.closures import closure_records
from rlml_slam.slam.closures.closure_monitor import ClosureMonitor
from rlml_slam.slam.closures.closure_records import ClosureRecords
from rlml_slam.slam.closures.closure_table import closure_table, describe, weight
from rlml_slam.slam.closures.loop_closer import LoopCloser
from rlml_slam.slam.closures.loop_closure import HISTORY_LENGTH, Closure, State
from rlml_slam.types import EdgeKind

SIGMA = np.array([0.02, 0.02, 0.005])
PER_LAP = 40


class Drive:
    """Laps of a circle of 5 m, grown lap by lap, whose closures are recorded."""

    def __init__(self):
        self.graph = Graph(Losses(closure=Loss(LossKind.HUBER, 2.0)))
        self.closures = ClosureRecords()
        self.rng = np.random.default_rng(0)
        self.solver = OnlineSolver(self.graph)
        self.monitor = ClosureMonitor(Parameters(), self.graph)

    def true(self, k):
        phi = 2.0 * np.pi * np.asarray(k) / PER_LAP
        return np.stack([5 * np.cos(phi), 5 * np.sin(phi), se2.wrap(phi + np.pi / 2)], -1)

    def drive(self, count):
        for k in range(len(self.graph.poses), len(self.graph.poses) + count):
            self.graph.add_pose(self.true(k), fixed=k == 0)
            if k:
                self.edge(EdgeKind.ODOMETRY, k - 1, k)
            if k >= PER_LAP and k % 4 == 0:
                self.close(k - PER_LAP, k)

    def edge(self, kind, i, j, delta=None):
        if delta is None:
            noise = SIGMA * self.rng.standard_normal(3)
            delta = se2.compose(se2.between(self.true(i), self.true(j)), noise)
        return self.graph.add_edge(kind, i, j, delta, np.diag(SIGMA**-2))

    def close(self, i, j, delta=None):
        edge = self.edge(EdgeKind.CLOSURE, i, j, delta)
        number = len(self.closures)
        self.closures.append(Closure(i, j, np.zeros(3), 0.7, edge, 'fits', 0.8, 0.6, number))
        return self.closures[-1]

    def solve(self, final=False):
        optimize(self.graph)
        if not self.monitor.needs_selection(self.closures, final):
            return ()
        enabled = self.monitor.select(self.closures)
        self.solver.solve_all()
        return self.monitor.update_states(self.closures, enabled)


@pytest.fixture
def drive():
    out = Drive()
    out.drive(3 * PER_LAP)
    return out


def test_record_of_a_closure_stays_as_long_as_its_edge(monkeypatch):
    """Without it, nobody would know that the closure was revoked, and it would come back."""
    monkeypatch.setattr(closure_records, 'RECORDS', 4)
    closer = LoopCloser(Parameters(), OnlineSolver(Graph()))
    edges = [0, -1, -1, 1, -1, 2, -1, 3]
    closer.records = ClosureRecords(
        Closure(k, k + 9, np.zeros(3), 0.7, e, '') for k, e in enumerate(edges)
    )
    same = [np.arange(n) for n in (20, 0, 4, 0, 0, 0)]
    closer.renumber(Renumbering(*same), {}, {}, [])
    assert [c.i for c in closer.records] == [0, 3, 5, 7]
    monkeypatch.setattr(closure_records, 'RECORDS', 3)
    closer.renumber(Renumbering(*same), {}, {}, [])
    assert len(closer.records) == 4
    monkeypatch.setattr(closure_records, 'RECORDS', 6)
    closer.records = ClosureRecords(
        Closure(k, k + 9, np.zeros(3), 0.7, e, '') for k, e in enumerate(edges)
    )
    closer.renumber(Renumbering(*same), {}, {}, [])
    assert [c.i for c in closer.records] == [0, 3, 4, 5, 6, 7]  # the oldest went


def test_right_closures_are_noted_once_and_stay(drive):
    assert drive.solve() == drive.solve() == ()
    for c in drive.closures:
        assert c.status.state is State.ACTIVE
        assert len(c.status.history) == 1  # a weight that does not change is not noted again
        assert c.status.history[0].keyframe == 3 * PER_LAP - 1
        assert 0.0 <= c.status.residual < 30.0
        assert 0.0 < c.status.weight <= 1.0
    s = drive.graph.residuals().edges[[c.edge for c in drive.closures]]
    assert_allclose([c.status.residual for c in drive.closures], s)


def test_wrong_closure_is_disabled_told_and_not_smeared_over_the_map(drive):
    drive.solve()
    before = drive.graph.poses.copy()
    wrong = drive.close(10, 70, np.zeros(3))
    assert drive.solve() == (wrong,)
    assert wrong.status.state is State.DISABLED
    assert weight(wrong) == 0.0 == wrong.status.history[-1].weight
    assert not drive.graph.edges.enabled[wrong.edge]
    assert all(c.status.state is State.ACTIVE for c in drive.closures if c is not wrong)
    assert_allclose(drive.graph.poses, before, atol=1e-3)
    assert 'loop closure' in describe(wrong)
    assert 'disabled: inconsistent' in describe(wrong)


def test_doubts_are_put_off_until_the_graph_has_grown_or_ends(drive):
    drive.close(10, 70, np.zeros(3))
    assert len(drive.solve()) == 1
    later = drive.close(15, 75, np.zeros(3))
    assert drive.solve() == ()
    assert later.status.state is State.ACTIVE
    drive.drive(3 * PER_LAP // 2)
    assert drive.solve() == (later,)
    last = drive.close(5, 100, np.zeros(3))
    assert drive.solve() == ()
    assert drive.solve(final=True) == (last,)


def test_doubts_are_heard_as_soon_as_there_are_more_closures(drive):
    drive.close(10, 70, np.zeros(3))
    assert len(drive.solve()) == 1
    later = drive.close(15, 75, np.zeros(3))
    for k in range(len(drive.closures) // 2):  # no pose is new
        drive.close(20 + k, 60 + k)
    assert drive.solve() == (later,)


def test_no_pull_of_odometry_fades_with_its_error():
    """Else one wrong closure takes its keyframe anywhere, and then fits."""
    losses = back_end_losses(Parameters())

    def pull(loss, sigmas):
        return float(loss_weights(int(loss.kind), loss.scale, np.array([sigmas**2]))[0]) * sigmas

    assert pull(losses.odometry, 1e3) >= pull(losses.odometry, 10.0) > 0.0
    # a wrong closure has to tear two edges, into a keyframe and out of it
    assert 2.0 * pull(losses.odometry, 1e3) > pull(losses.closure, 1e3)


@pytest.mark.parametrize('slip', [(1.5, 0.0, 0.0), (0.0, 0.0, 0.4)])
def test_closures_after_wheels_have_slipped_stay(slip):
    """Odometry contradicts them, and a selection trusts it; but they fit the robust estimate."""
    drive = Drive()
    drive.graph.losses = back_end_losses(Parameters())
    drive.drive(4 * PER_LAP - 10)
    k = drive.graph.add_pose(drive.true(4 * PER_LAP - 10))
    step = se2.between(drive.true(k - 1), drive.true(k))
    drive.edge(EdgeKind.ODOMETRY, k - 1, k, se2.compose(step, np.array(slip)))
    drive.drive(9)
    wrong = drive.close(10, 70, np.zeros(3))
    assert drive.solve() == (wrong,)


def test_a_disabled_closure_comes_back_when_it_is_judged_right(drive):
    right = drive.closures[3]
    drive.graph.edges.enabled[right.edge] = False
    right.status.set_state(State.DISABLED, 'as if it had been wrong')
    wrong = drive.close(10, 70, np.zeros(3))
    assert set(map(id, drive.solve())) == {id(right), id(wrong)}
    assert right.status.state is State.ACTIVE
    assert drive.graph.edges.enabled[right.edge]
    assert right.status.reason == 'consistent again'


def test_a_revoked_closure_stays_out(drive):
    drive.solve()
    revoked = drive.monitor.revoke(drive.closures, 2)
    drive.close(10, 70, np.zeros(3))
    drive.solve(final=True)
    assert revoked.status.state is State.REVOKED
    assert not drive.graph.edges.enabled[revoked.edge]
    with pytest.raises(SolverError, match='loop closure 2 is already revoked'):
        drive.monitor.revoke(drive.closures, 2)
    with pytest.raises(SolverError, match='there is no loop closure 999'):
        drive.monitor.revoke(drive.closures, 999)


def test_notes_are_bounded_and_survive_new_numbers(drive):
    closure = drive.closures[0]
    moved = replace(closure, i=1, j=2, edge=3)
    for k in range(2 * HISTORY_LENGTH):
        closure.status.record(k, 1.0, 0.5)
    assert len(moved.status.history) == HISTORY_LENGTH
    assert moved.status.history[-1].keyframe == 2 * HISTORY_LENGTH - 1


def test_table_is_read_by_the_command(drive, tmp_path, capsys):
    drive.close(10, 70, np.zeros(3))
    drive.closures.append(Closure(1, 2, np.zeros(3), 0.1, -1, 'too weak'))
    drive.solve()
    (tmp_path / 'closures.csv').write_text(closure_table(drive.closures))
    rows = command.read(tmp_path)
    assert [int(r['number']) for r in rows] == list(range(len(drive.closures) - 1))
    assert main(['closures', str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f'{len(rows)} loop closures: {len(rows) - 1} active, 1 disabled, 0 revoked'
    assert 'inconsistent with the other closures' in '\n'.join(lines)
    assert main(['closures', str(tmp_path), '--all']) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(rows) + 2


def test_what_is_no_table_of_closures_is_refused(tmp_path):
    with pytest.raises(MapError, match=r'closures.csv: cannot be read'):
        command.read(tmp_path)
    (tmp_path / 'closures.csv').write_text('a,b\n1,2\n')
    with pytest.raises(InputError, match='not a table of loop closures'):
        command.read(tmp_path)
    assert main(['closures', str(tmp_path), '--revoke', '1']) == 1
