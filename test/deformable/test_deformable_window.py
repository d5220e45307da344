# SPDX-License-Identifier: Apache-2.0
import dataclasses
from functools import partial
from itertools import islice

import numpy as np
import pytest
from calls import count_calls
from differences import central_differences

from rlml_lab.carrier.carrier import simulate_carrier, true_features
from rlml_lab.carrier.carrier_parameters import Carrier
from rlml_lab.deformable.scoring import chi2_bounds
from rlml_slam.deformable.window import CarrierVelocity, DeformableWindow
from rlml_slam.deformable.window_equations import carry, motion_covariance, motion_information
from rlml_slam.errors import InputError
from rlml_slam.params import Deformable, Reflector
from rlml_slam.se2 import wrap
from rlml_slam.types import Motion, Status

EXACT = {
    'drift': 1e-9, 'common_drift': 1e-9, 'odometry_sigma': (1e-9, 1e-9, 1e-9), 'sigma': 1e-9
}  # fmt: skip


def steps(count, seed=0, **settings):
    return list(islice(simulate_carrier(Carrier(**settings), seed), count))


def follow(run, reflector=None, **params):
    """Every estimate of a run, and the true id of each feature key."""
    window = DeformableWindow(Deformable(**params), reflector or Reflector())
    estimates, owner = [], {}
    for s in run:
        velocity = CarrierVelocity(s.linear, s.angular)
        estimates.append(window.update(s.stamp, s.motion, s.detections, velocity))
        for key, seen in zip(estimates[-1].keys.tolist(), s.seen.tolist(), strict=True):
            if key >= 0:
                owner[key] = seen
    return estimates, owner, window


def state_error(estimate, step, owner):
    """Error and joint covariance of the pose and of the confirmed features that exist."""
    true = true_features(step)
    known = [k for k, key in enumerate(estimate.features.keys.tolist()) if owner[key] in true]
    rows = [0, 1, 2, *(3 + 2 * k + r for k in known for r in range(2))]
    d = estimate.pose - step.pose
    d[2] = wrap(d[2])
    f = [estimate.features.points[k] - true[owner[int(estimate.features.keys[k])]] for k in known]
    return np.concatenate([d, *f]), estimate.joint_cov[np.ix_(rows, rows)]


@pytest.mark.parametrize('turn', [0.0, 0.3, -2.0])
@pytest.mark.parametrize('leads', [[True, True, False, True], [False] * 4])
def test_jacobian_of_the_carriers_motion_is_the_difference_quotient(turn, leads):
    lives = np.array([True, True, True, False])
    at = np.random.default_rng(0).standard_normal(11)
    delta, carrier = np.array([0.3, 0.1, 0.2]), np.array([0.5, -0.2, turn])
    ahead = np.array([0.4, 0.3, 0.0])

    def move(state):
        after = np.empty(11)
        carry(state, lives, np.array(leads), delta, carrier, ahead, after, np.empty((11, 11)))
        return after

    F = np.empty((11, 11))
    carry(at, lives, np.array(leads), delta, carrier, ahead, np.empty(11), F)
    np.testing.assert_allclose(central_differences(move, at), F, atol=1e-8)


def test_features_keep_their_shape_when_the_carrier_turns():
    at, after = np.random.default_rng(0).standard_normal(9), np.empty(9)
    everyone = np.ones(3, dtype=bool)
    carrier, F = np.array([2.0, 1.0, 0.7]), np.empty((9, 9))
    carry(at, everyone, everyone, np.zeros(3), carrier, np.zeros(3), after, F)
    old, new = at[3:].reshape(-1, 2), after[3:].reshape(-1, 2)
    np.testing.assert_allclose(new.mean(0), old.mean(0) + np.array([2.0, 1.0]), atol=1e-12)
    gaps = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (old, new)]
    np.testing.assert_allclose(gaps[0], gaps[1], atol=1e-12)


def test_information_of_a_step_is_the_inverse_of_its_covariance():
    lives = np.array([True, False, True, True])
    a = np.random.default_rng(0).standard_normal((3, 3))
    cov = a @ a.T + np.eye(3)
    W = np.empty((11, 11))
    motion_information(0.8, np.linalg.inv(cov), lives, 0.3, 0.7, W)
    Q = motion_covariance(0.8, cov, lives, 0.3, 0.7)
    alive = [0, 1, 2, 3, 4, 7, 8, 9, 10]
    inner = np.ix_(alive, alive)
    np.testing.assert_allclose(W[inner] @ Q[inner], np.eye(9), atol=1e-12)
    assert np.all(W[5:7] == 0.0)
    assert np.all(Q[5:7] == 0.0)


@pytest.mark.parametrize('kind', ['train', 'conveyor'])
def test_noiseless_run_has_no_error(kind):
    # a turn is about the features that are tracked, so all must be seen from the first step
    run = steps(150, kind=kind, missed_share=0.0, **EXACT)
    run = [
        dataclasses.replace(
            s,
            detections=dataclasses.replace(s.detections, cov=s.detections.cov * 1e14),
            motion=Motion(s.motion.delta, s.motion.cov * 1e14),
        )
        for s in run
    ]  # the estimator is given the true sizes of 0.1
    estimates, owner, _ = follow(run)
    for estimate, step in zip(estimates, run, strict=True):
        # sigma 1e-9 and marginalisation at 1e-4 convergence leave some 1e-8
        assert np.abs(state_error(estimate, step, owner)[0]).max() < 1e-6


def test_marginalised_window_gives_what_the_whole_history_gives():
    run = steps(80)
    short, owner, _ = follow(run, window=5)
    whole, _, _ = follow(run, window=200)
    for a, b in zip(short, whole, strict=True):
        # equal but for the linearisation: far below the uncertainty
        sigma = np.sqrt(np.diag(b.joint_cov))
        gap = np.concatenate([a.pose - b.pose, (a.features.points - b.features.points).ravel()])
        assert np.abs(gap / sigma).max() < 0.05
        np.testing.assert_allclose(np.sqrt(np.diag(a.joint_cov)), sigma, rtol=0.02)
    assert owner


@pytest.mark.parametrize('kind', ['train', 'conveyor'])
def test_covariances_account_for_the_errors(kind):
    """8 runs of 6 s, scored at their end: independent samples."""
    pose, whole, degrees = [], [], 0
    for seed in range(8):
        run = steps(60, seed, kind=kind)
        estimates, owner, _ = follow(run)
        e, P = state_error(estimates[-1], run[-1], owner)
        pose.append(e[:3] @ np.linalg.solve(P[:3, :3], e[:3]))
        whole.append(e @ np.linalg.solve(P, e))
        degrees += len(e)
    low, high = chi2_bounds(3, 8)
    assert low < np.mean(pose) < high
    low, high = chi2_bounds(degrees, 1)
    assert low < sum(whole) < high


def test_cost_and_memory_stay_constant():
    """Nothing grows over 40 s of a conveyor whose features come and go.

    The time of an update, at most 10 ms, is a claim of ``rlml-lab study deformable --window``.
    """
    run = steps(400, kind='conveyor', ids=False, false_detections=0.05)
    window = DeformableWindow(Deformable(), Reflector())
    sizes, calls = [], []
    for s in run:
        velocity = CarrierVelocity(s.linear, s.angular)
        update = partial(window.update, s.stamp, s.motion, s.detections, velocity)
        calls.append(count_calls(update))
        sizes.append(sum(a.nbytes for a in (*window._w, *window._prior, window._cov)))
    assert sizes[-1] == sizes[200]
    assert np.median(calls[300:]) < 1.1 * np.median(calls[100:200])
    assert max(calls[100:]) < 1000  # some 600


def test_anonymous_features_are_followed_among_ghosts():
    run = steps(200, ids=False, false_detections=0.1)
    estimates, owner, _ = follow(run)
    last, step = estimates[-1], run[-1]
    found = last.features.points[:, None] - step.points[None]
    nearest = np.linalg.norm(found, axis=-1).min(axis=0)
    assert len(last.features.keys) <= 7  # a ghost may have been seen three times
    assert nearest.max() < 4.0 * np.sqrt(np.max(np.linalg.eigvalsh(last.features.cov)))
    e, P = state_error(last, step, owner)
    assert e[:3] @ np.linalg.solve(P[:3, :3], e[:3]) < 16.3  # 99.9 % of chi^2 with 3


def test_many_ghosts_take_a_bounded_room():
    """Five in each scan took room for 130 features, and an update half a second."""
    estimates, _, window = follow(steps(60, ids=False, false_detections=5.0))
    assert len(estimates[-1].features.keys) >= 6
    assert window._w.active.shape[1] <= 48


def test_lone_ghost_is_never_a_feature_and_keys_are_never_reused():
    run = steps(100, false_detections=0.0)
    ghost = run[50].detections
    odd = dataclasses.replace(
        ghost,
        points=np.concatenate([ghost.points, [[-5.0, -5.0]]]),
        cov=np.concatenate([ghost.cov, ghost.cov[:1]]),
        ids=np.append(ghost.ids, -1),
        diameters=np.append(ghost.diameters, np.nan),
    )
    run[50] = dataclasses.replace(run[50], detections=odd, seen=np.append(run[50].seen, -1))
    estimates, _, _ = follow(run)
    assert estimates[50].statuses[-1] == Status.NEW
    strange = estimates[50].keys[-1]
    assert all(strange not in e.features.keys for e in estimates)
    assert strange == 6


def test_feature_out_of_sight_is_kept_a_while_and_then_forgotten():
    run = steps(120, missed_share=0.0)
    blind = []
    for k, s in enumerate(run):
        keep = (s.seen != 2) | (k < 40)
        d = s.detections
        d = dataclasses.replace(
            d, points=d.points[keep], cov=d.cov[keep], ids=d.ids[keep], diameters=d.diameters[keep]
        )
        blind.append(dataclasses.replace(s, detections=d, seen=s.seen[keep]))
    estimates, owner, _ = follow(blind)
    lost = next(k for k, v in owner.items() if v == 2)
    alive = [lost in e.features.keys.tolist() for e in estimates]
    assert alive[39]
    assert alive[80]  # 4 s later
    assert not alive[95]  # 5.5 s later
    spread = [
        np.trace(e.features.cov[e.features.keys.tolist().index(lost)]) for e in estimates[40:85]
    ]
    assert np.all(np.diff(spread) > 0.0)


def test_moving_the_start_moves_everything_and_changes_nothing_else():
    run = steps(60)
    there, _, _ = follow(run)
    window = DeformableWindow(Deformable(), Reflector(), np.array([5.0, -3.0, 0.0]))
    for s, a in zip(run, there, strict=True):
        b = window.update(s.stamp, s.motion, s.detections, CarrierVelocity(s.linear, s.angular))
        np.testing.assert_allclose(b.pose - a.pose, [5.0, -3.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(b.joint_cov, a.joint_cov, atol=1e-7)


def test_replay_is_identical_bit_for_bit():
    run = steps(60, ids=False, false_detections=0.2)
    a, b = follow(run)[0], follow(run)[0]
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x.joint_cov, y.joint_cov)
        np.testing.assert_array_equal(x.pose, y.pose)


def test_runs_without_any_detection_on_odometry_alone():
    run = steps(30)
    empty = dataclasses.replace(
        run[0].detections, points=np.zeros((0, 2)), cov=np.zeros((0, 2, 2)),
        ids=np.zeros(0, np.int64), diameters=np.zeros(0),
    )  # fmt: skip
    run = [dataclasses.replace(s, detections=empty, seen=np.zeros(0, np.int64)) for s in run]
    estimates, _, _ = follow(run)
    assert len(estimates[-1].features.keys) == 0
    assert np.all(np.diff([np.trace(e.cov) for e in estimates]) > 0.0)


def test_bad_input_is_refused_and_changes_nothing():
    run = steps(12)
    reference, _, _ = follow(run)
    window = DeformableWindow(Deformable(), Reflector())
    for s in run:
        velocity = CarrierVelocity(s.linear, s.angular)
        broken = dataclasses.replace(s.detections, points=s.detections.points * np.nan)
        with pytest.raises(InputError, match=r'detections at .* not finite'):
            window.update(s.stamp, s.motion, broken, velocity)
        with pytest.raises(InputError, match='positive definite'):
            window.update(
                s.stamp, Motion(s.motion.delta, np.zeros((3, 3))), s.detections, velocity
            )
        last = window.update(s.stamp, s.motion, s.detections, velocity)
        with pytest.raises(InputError, match='is not after'):
            window.update(s.stamp, s.motion, s.detections, velocity)
    np.testing.assert_array_equal(last.joint_cov, reference[-1].joint_cov)
