# SPDX-License-Identifier: Apache-2.0
"""Anonymous landmarks seen again after a stretch without any, in which the wheels slipped."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, drive, observations

from rlml_slam import se2
from rlml_slam.ekf.branch import Branch
from rlml_slam.ekf.estimator import Estimator
from rlml_slam.ekf.filter import Filter
from rlml_slam.ekf.matching import Matcher
from rlml_slam.estimation.landmark_models import POINT
from rlml_slam.params import EkfParameters, from_mapping
from rlml_slam.types import ANONYMOUS, Detections, Motion, Observation

LOOP = drive((0.5, 0.0, 4.0), (0.5, 1.2, 5.2), (0.5, 0.0, 6.0), (0.5, 1.2, 5.2), (0.5, 0.0, 3.0))
BLIND = slice(60, 110)
SURPRISE = np.array([0.25, -0.1, 0.4])  # of the wheels while nothing is in view


def blinded(seed):
    """The loop with a stretch without a sighting, in which the wheels slip by what they may."""
    rng = np.random.default_rng(seed)
    out = observations(ROOM, LOOP, scan=False, rng=rng, sigma=0.02)
    for k in range(BLIND.start, BLIND.stop):
        out[k] = replace(out[k], detections=None)
    k = BLIND.stop - 1
    delta = se2.compose(out[k].motion.delta, SURPRISE)
    cov = out[k].motion.cov + np.diag(np.square((0.25, 0.15, 0.35)))
    out[k] = replace(out[k], motion=Motion(delta, cov))
    return out


def run(observed, association):
    """The estimator, its frames and how many branches it had after each."""
    estimator = Estimator(from_mapping({'ekf.association': association}, EkfParameters))
    frames, branches = [], []
    for o in observed:
        frames.append(estimator.process(o))
        branches.append(len(estimator.branches))
    return estimator, frames, np.array(branches)


@pytest.mark.parametrize('seed', range(4))
def test_landmarks_seen_again_after_a_blind_stretch_are_told_in_the_end(seed):
    estimator, _, branches = run(blinded(seed), 'deferred')
    assert (branches[: BLIND.stop] == 1).all()
    assert branches.max() > 1
    found = estimator.reflectors()
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors[None], axis=-1)
    assert sorted(gap.argmin(axis=1)) == list(range(len(ROOM.reflectors)))
    assert gap.min(axis=1).max() < 0.1
    _, poses = estimator.trajectory()
    assert np.abs(poses[-1] - LOOP[-1])[:2].max() < 0.1


def test_reflectors_are_told_so_by_default():
    observed = blinded(0)
    _, delayed_association, _ = run(observed, 'deferred')
    _, frames, _ = run(observed, 'auto')
    assert all(
        (a.T_map_base == b.T_map_base).all()
        for a, b in zip(frames, delayed_association, strict=True)
    )


@pytest.mark.parametrize(
    ('extractor', 'delayed_association'),
    [('reflectors', True), ('spikes', False), ('lines', False)],
)
def test_answers_are_deferred_for_reflectors_alone(extractor, delayed_association):
    params = from_mapping({'ekf.extractor': extractor}, EkfParameters)
    assert Matcher(params).defers is delayed_association


def test_nearest_neighbour_takes_them_for_others():
    worst = 0.0
    for seed in range(4):
        estimator, _, _ = run(blinded(seed), 'nearest')
        worst = max(worst, float(np.hypot(*(estimator.trajectory()[1][-1] - LOOP[-1])[:2])))
    assert worst > 0.1


def test_one_branch_is_enough_where_landmarks_stay_in_view():
    observed = observations(ROOM, LOOP, scan=False, rng=np.random.default_rng(0), sigma=0.02)
    _, frames, branches = run(observed, 'deferred')
    assert (branches == 1).all()
    assert np.abs(frames[-1].T_map_base - LOOP[-1])[:2].max() < 0.1


def test_a_branch_and_its_copy_are_equal_until_they_see_different_things():
    estimator, _, _ = run(blinded(0)[: BLIND.start], 'deferred')
    (branch,) = estimator.branches
    twin = branch.copy()
    assert branch.equals(twin)
    twin.filter.x[0] += 1.0
    assert branch.filter.x[0] == pytest.approx(estimator.filter.pose[0])
    assert not branch.equals(twin)


def test_covariance_tells_that_another_branch_may_be_right():
    estimator, _, _ = run(blinded(0)[: BLIND.start], 'deferred')
    (branch,) = estimator.branches
    twin = branch.copy()
    twin.filter = Filter(
        branch.filter.pose + np.array([2.0, 0.0, 0.0]), branch.filter.pose_cov, 0.1, POINT
    )
    estimator.branches = [branch, twin]
    twin.weight = branch.weight
    # half of the weight stands 2 m away
    assert estimator.pose_cov[0, 0] == pytest.approx(branch.filter.P[0, 0] + 2.0, abs=1e-9)


def test_close_landmarks_that_tell_different_ids_are_never_made_one():
    pair = np.array([[3.0, 0.0], [3.15, 0.1]])
    estimator = Estimator(from_mapping({'ekf.association': 'deferred'}, EkfParameters))
    R = np.diag([0.05, 0.05]) ** 2
    for k in range(40):
        # never both at once
        seen = Detections(
            (k + 1) * 100_000_000, 'base_link', pair[[k % 2]], R[None], np.array([k % 2 + 7]),
            np.full(1, np.nan),
        )  # fmt: skip
        still = Motion(np.zeros(3), np.zeros((3, 3)))
        estimator.process(Observation(seen.stamp, still, detections=seen))
    found = estimator.reflectors()
    assert sorted(found.ids) == [7, 8]
    assert found.points[np.argsort(found.ids)] == pytest.approx(pair, abs=1e-6)


def test_many_ambiguous_landmarks_at_once_have_no_more_branches_than_a_frame_can_pay(monkeypatch):
    """Each that fits two doubled the branches: 16 of them in one scan took all of the memory."""
    grid = np.stack(np.meshgrid(1.0 + np.arange(4.0), np.arange(4.0)), -1).reshape(-1, 2)
    copies, copy = [], Branch.copy

    def count(branch):
        copies.append(1)
        assert len(copies) < 1000
        return copy(branch)

    monkeypatch.setattr(Branch, 'copy', count)
    estimator = Estimator(EkfParameters())
    R = np.broadcast_to(0.02**2 * np.eye(2), (16, 2, 2))
    ids, none = np.full(16, ANONYMOUS), np.full(16, np.nan)
    for k in range(1, 60):
        # between the 30th and the 31st scan, the robot may be anywhere within some metres
        cov = np.diag([1.0, 1.0, 0.01]) if k == 31 else 1e-6 * np.eye(3)
        seen = Detections(100_000_000 * k, 'base_link', grid, R, ids, none)
        estimator.process(Observation(seen.stamp, Motion(np.zeros(3), cov), detections=seen))
    assert copies
    assert np.abs(estimator.filter.pose).max() < 0.1
