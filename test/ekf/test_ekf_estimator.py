# SPDX-License-Identifier: Apache-2.0
"""The whole estimator on a drive among landmarks: exact without noise, consistent with it."""

import numpy as np
import pytest
from scipy.stats import chi2

from rlml_slam import se2
from rlml_slam.ekf.estimator import Estimator
from rlml_slam.params import EkfParameters, Node, from_mapping
from rlml_slam.types import (
    ANONYMOUS,
    Detections,
    Level,
    Motion,
    Observation,
    Reflectors,
    Status,
)

LANDMARKS = np.array(
    [[3.0, 2.0], [6.0, -2.0], [9.0, 3.0], [6.0, 7.0], [1.0, 7.0], [-2.0, 4.0], [4.0, 4.5]]
)
STEP = np.array([0.15, 0.0, 0.05])  # a circle of radius 3 m
STEPS = 126  # once around
Q = np.diag([0.004, 0.002, 0.004]) ** 2
SIGMA = (0.03, 0.01)


def params(**ekf):
    return from_mapping({f'ekf.{k}': v for k, v in ekf.items()}, EkfParameters)


def detections(stamp, pose, ids, rng=None):
    p = se2.transform(se2.inverse(pose), LANDMARKS)
    r, b = np.hypot(*p.T), np.arctan2(p[:, 1], p[:, 0])
    near = np.flatnonzero(r < 8.0)
    r, b = r[near], b[near]
    if rng is not None:
        r = r + SIGMA[0] * rng.standard_normal(len(r))
        b = b + SIGMA[1] * rng.standard_normal(len(b))
    R = se2.rotation(b)
    D = np.zeros((len(r), 2, 2))
    D[:, 0, 0], D[:, 1, 1] = SIGMA[0] ** 2, (r * SIGMA[1]) ** 2
    reported_ids = near if ids else np.full(len(near), ANONYMOUS)
    return Detections(
        stamp,
        'base_link',
        r[:, None] * R[:, :, 0],
        R @ D @ R.transpose(0, 2, 1),
        reported_ids.astype(np.int64),
        np.full(len(r), np.nan),
    )


def drive(p, rng=None, ids=False, steps=STEPS, q=Q, wheels=(0.0, 0.0)):
    """Frames and true poses of a drive; the wheels' and the sensor's noise only with ``rng``.

    ``wheels``: by what share the robot is faster, and turns more, than they measure.
    """
    estimator, pose, frames, truth = Estimator(p), np.zeros(3), [], []
    for k in range(steps):
        moved = STEP if k else np.zeros(3)
        if rng is not None and k:
            moved = moved * [1.0 + wheels[0], 1.0, 1.0 + wheels[1]]
            moved = moved + np.sqrt(np.diag(q)) * rng.standard_normal(3)
        pose = se2.compose(pose, moved)
        turn = STEP * [0.0, 0.0, 1.0]
        motion = Motion(STEP, q, turn_gain=turn) if k else Motion(np.zeros(3), np.zeros((3, 3)))
        stamp = (k + 1) * 100_000_000
        seen = detections(stamp, pose, ids, rng)
        frames.append(estimator.process(Observation(stamp, motion, detections=seen)))
        truth.append(pose)
    return estimator, frames, np.array(truth)


@pytest.mark.parametrize('association', ['nearest', 'joint', 'deferred'])
@pytest.mark.parametrize('update', ['plain', 'compressed'])
def test_without_noise_there_is_no_error(association, update):
    estimator, frames, truth = drive(
        params(association=association, update=update, local_radius=0.5, local_margin=0.2)
    )
    poses = np.array([f.T_map_base for f in frames])
    assert np.abs(poses - truth)[:, :2].max() < 1e-9
    assert np.abs(se2.wrap(poses[:, 2] - truth[:, 2])).max() < 1e-9
    found = estimator.reflectors().points
    gap = np.linalg.norm(found[:, None] - LANDMARKS[None], axis=-1)
    assert len(found) == len(LANDMARKS)
    assert gap.min(axis=1).max() < 1e-9


def test_pose_is_consistent_around_the_first_loop_with_known_associations():
    runs = 8
    nees = []
    for seed in range(runs):
        p = from_mapping({'motion.scale_error_sigma': (0.0, 0.0)}, EkfParameters)
        _, frames, truth = drive(p, np.random.default_rng(seed), ids=True)
        e = np.array([f.T_map_base for f in frames]) - truth
        e[:, 2] = se2.wrap(e[:, 2])
        # the first pose is the map's: it has neither error nor covariance
        nees.append(
            [
                float(x @ np.linalg.solve(f.cov_map, x))
                for x, f in zip(e[1:], frames[1:], strict=True)
            ]
        )
    # the poses of a run are correlated, so the bound is that of one pose per quarter of a loop
    dof = 3 * runs * 4
    low, high = chi2.ppf([0.025, 0.975], dof) / (runs * 4)
    assert low < np.mean(nees) < high


def test_pose_is_consistent_where_wheels_err_for_long():
    """As for wheels that do not; a filter that does not know of it believes far too much."""
    runs, sigma, nees = 12, (0.1, 0.2), {}
    for known in (True, False):
        p = from_mapping(
            {'motion.scale_error_sigma': sigma if known else (0.0, 0.0)}, EkfParameters
        )
        out = []
        for seed in range(runs):
            rng = np.random.default_rng(seed)
            wheels = sigma * rng.standard_normal(2)
            _, frames, truth = drive(p, rng, ids=True, wheels=wheels)
            e = np.array([f.T_map_base for f in frames]) - truth
            e[:, 2] = se2.wrap(e[:, 2])
            P = np.array([f.cov_map for f in frames])
            out.append((e[1:] * np.linalg.solve(P[1:], e[1:, :, None])[..., 0]).sum(axis=1))
        nees[known] = np.mean(out)
    dof = 3 * runs * 4
    low, high = chi2.ppf([0.025, 0.975], dof) / (runs * 4)
    assert low < nees[True] < high
    assert nees[False] > 2.0 * high


def test_anonymous_detections_find_every_landmark_and_no_other():
    estimator, frames, truth = drive(params(), np.random.default_rng(3))
    found = estimator.reflectors()
    gap = np.linalg.norm(found.points[:, None] - LANDMARKS[None], axis=-1)
    assert sorted(gap.argmin(axis=1)) == list(range(len(LANDMARKS)))
    # three sigmas of the odometry's drift until a landmark is first seen, and more
    assert gap.min(axis=1).max() < 0.3
    assert np.hypot(*(frames[-1].T_map_base - truth[-1])[:2]) < 0.3
    assert sum((f.statuses == Status.USED).sum() for f in frames) > 400


def test_landmark_enters_the_state_with_its_nth_sighting():
    _, frames, _ = drive(params(min_sightings=4), steps=5)
    assert [int((f.landmarks >= 0).sum()) for f in frames][:3] == [0, 0, 0]
    assert (frames[3].landmarks >= 0).all()
    assert (frames[3].statuses == Status.NEW).all()
    assert (frames[4].statuses == Status.USED).all()


def test_ghost_never_enters_the_state():
    estimator = Estimator(params(candidate_timeout=0.5))
    for k in range(40):
        stamp = (k + 1) * 100_000_000
        seen = detections(stamp, np.zeros(3), False)
        if k % 7 == 0:
            ghost = np.array([[-3.0, -3.0 + 0.001 * k]])
            seen = Detections(
                stamp, 'base_link', np.concatenate([seen.points, ghost]),
                np.concatenate([seen.cov, seen.cov[:1]]), np.append(seen.ids, ANONYMOUS),
                np.append(seen.diameters, np.nan),
            )  # fmt: skip
        still = Motion(np.zeros(3), np.zeros((3, 3)))
        estimator.process(Observation(stamp, still, detections=seen))
    assert np.hypot(*(estimator.reflectors().points - [-3.0, -3.0]).T).min() > 2.0


def test_a_long_way_while_mapping_is_uncertain_but_not_lost():
    """The position is uncertain in the frame of the start, but not in the map around the robot."""
    estimator, step = Estimator(EkfParameters()), np.array([0.5, 0.0, 0.0])
    posts = np.array([[1.5 * k, 3.0 * (-1) ** k] for k in range(200)])
    for k in range(1, 501):
        p = posts - [0.5 * k, 0.0]
        near = np.flatnonzero(np.hypot(*p.T) < 6.0)
        m = len(near)
        seen = Detections(
            k * 100_000_000, 'base_link', p[near], np.tile(4e-3 * np.eye(2), (m, 1, 1)), near,
            np.full(m, np.nan),
        )  # fmt: skip
        motion = Motion(step, np.diag([0.02, 0.02, 0.01]) ** 2)
        frame = estimator.process(Observation(seen.stamp, motion, detections=seen))
    assert estimator.pose_cov[1, 1] > 2.0**2
    assert frame.health.level == Level.DEGRADED
    blind = Motion(step, np.diag([0.3, 0.3, 0.01]) ** 2)
    for k in range(501, 581):
        frame = estimator.process(Observation(k * 100_000_000, blind))
    assert frame.health.level == Level.LOST


# --- a given map ---------------------------------------------------------------------------------


def given(start, p=None):
    """An estimator in a map of the landmarks, at a start pose that is only assumed."""
    n = len(LANDMARKS)
    estimator = Estimator(p or EkfParameters(node=Node(mode='localization')))
    estimator.reset(np.array(start), np.zeros((3, 3)))
    landmarks = Reflectors(
        np.arange(n), LANDMARKS, np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, -1),
        np.full(n, 9), np.full(n, np.nan),
    )  # fmt: skip
    estimator.use_map(landmarks)
    return estimator


def look(estimator, k, pose, seen=True):
    """A frame of a robot that stands still."""
    stamp = k * 100_000_000
    found = detections(stamp, pose, False) if seen else None
    motion = Motion(np.zeros(3), 1e-8 * np.eye(3))
    return estimator.process(Observation(stamp, motion, detections=found))


def test_assumed_start_in_a_map_is_as_good_as_a_persons_guess():
    estimator, pose = given([0.0, 0.0, 0.0]), np.array([0.3, 0.2, 0.1])
    for k in range(1, 20):
        frame = look(estimator, k, pose)
    assert np.abs(se2.between(pose, frame.T_map_base)).max() < 0.02
    assert (frame.health.level, frame.unconfirmed) == (Level.OK, False)
    assert len(estimator.reflectors()) == len(LANDMARKS)


def test_start_that_nothing_confirms_is_degraded_and_then_lost():
    estimator = given([0.0, 0.0, 0.0])
    levels = []
    for k in range(1, 80):
        frame = look(estimator, k, np.zeros(3), seen=False)
        levels.append(frame.health.level)
        assert (
            frame.health.reasons[0]
            == 'start pose not confirmed: nothing has matched the saved map yet'
        )
        assert frame.unconfirmed
    assert levels == [Level.DEGRADED] * 51 + [Level.LOST] * 28


def test_without_the_map_to_localize_in_nothing_is_sure():
    estimator = Estimator(EkfParameters(node=Node(mode='localization')))
    assert look(estimator, 1, np.zeros(3)).health.reasons == (
        'no map has been loaded for localization',
    )
