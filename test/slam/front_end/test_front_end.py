# SPDX-License-Identifier: Apache-2.0
from dataclasses import fields, replace

import numpy as np
import pytest
from made_worlds import (
    CORRIDOR,
    FIRST,
    OTHER_ROOM,
    ROOM,
    STEP,
    detections_of,
    drive,
    errors,
    motion_cov,
    observations,
    points_of,
    scan_at,
)
from scipy.optimize import least_squares
from scipy.stats import chi2

from rlml_slam import se2
from rlml_slam.params import Node, Parameters
from rlml_slam.simulation.world_file import load_world
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import Belief, Level, Motion, Observation, Reflectors, Status

CURVE = drive((0.5, 0.0, 2.0), (0.5, 0.6, 3.0), (0.4, -0.7, 2.0))


def run(observed, params=None, front_end=None):
    """All frames, and the front end afterwards."""
    front_end = front_end or FrontEnd(params or Parameters())
    return [front_end.process(o) for o in observed], front_end


def poses_of(frames):
    return np.array([f.T_local_base for f in frames])


def surveyed(points, ids=None, sigma=1e-9):
    n = len(points)
    return Reflectors(
        np.arange(n), np.asarray(points, dtype=np.float64),
        np.tile(sigma**2 * np.eye(2), (n, 1, 1)),
        np.full(n, -1) if ids is None else np.asarray(ids),
        np.zeros(n, dtype=np.int64), np.full(n, np.nan),
    )  # fmt: skip


# --- by equation -------------------------------------------------------------------------------


def test_estimate_and_covariance_are_those_of_equations_3_and_11():
    # with reflectors known exactly nothing but the notes' own three terms is left (no scan here)
    rng = np.random.default_rng(0)
    params = Parameters(node=Node(mode='localization'))
    front_end = FrontEnd(params)
    front_end.use_map(surveyed(ROOM.reflectors))
    front_end.reset(np.array([0.3, -0.2, 3.1]), np.diag([0.02, 0.03, 0.02]) ** 2)
    front_end.use_map(surveyed(ROOM.reflectors))
    delta = np.array([0.2, 0.02, 0.15])
    cov = motion_cov(delta)
    prior = se2.compose(front_end.state.pose, delta)
    J_a, J_b = se2.compose_jacobians(front_end.state.pose, delta)
    cov_o = J_a @ front_end.state.pose_cov @ J_a.T + J_b @ cov @ J_b.T
    truth = se2.compose(prior, [0.015, -0.01, 0.01])
    z = se2.transform(se2.inverse(truth), ROOM.reflectors)
    z = z + 0.02 * rng.standard_normal(z.shape)
    W = np.linalg.cholesky(np.linalg.inv(cov_o)).T

    def residuals(x):
        e_o = x - prior
        e_o[2] = se2.wrap(e_o[2])
        e_R = z - se2.transform(se2.inverse(x), ROOM.reflectors)
        return np.concatenate([W @ e_o, e_R.ravel() / 0.02])

    best = least_squares(residuals, prior, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    frame = front_end.process(
        Observation(FIRST, Motion(delta, cov), detections=detections_of(z, FIRST))
    )
    assert (frame.statuses == Status.USED).all()
    # the iteration ends at steps below 1e-5 and the reflectors have sigma 1e-9
    np.testing.assert_allclose(frame.T_local_base[:2], best.x[:2], atol=2e-6)
    assert abs(se2.wrap(frame.T_local_base[2] - best.x[2])) < 1e-6
    np.testing.assert_allclose(frame.cov_local, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-3)


def test_map_pose_is_the_local_pose_moved_by_the_newest_correction():
    front_end = FrontEnd(Parameters())
    T = np.array([1.0, -2.0, 0.7])
    front_end.correct(T)
    for o in observations(ROOM, CURVE[:5], scan=False):
        frame = front_end.process(o)
    R = np.eye(3)
    R[:2, :2] = se2.rotation(0.7)
    np.testing.assert_allclose(frame.T_map_base, se2.compose(T, frame.T_local_base))
    np.testing.assert_allclose(frame.cov_map, R @ frame.cov_local @ R.T)


# --- noiseless ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('scan', 'reflectors', 'odometry', 'tolerance'),
    [
        # where all is exact only rounding is left; 4 mm is a tenth of a cell of the submap
        (False, False, True, 1e-9),
        (False, True, True, 1e-7),
        (True, False, True, 0.004),
        (True, True, True, 0.004),
        # only the sensor itself measures the first motions, and its prior is wide
        (False, True, False, 0.02),
        (True, False, False, 0.02),
        (True, True, False, 0.02),
    ],
)
def test_noiseless_run_of_any_inputs_has_no_error(scan, reflectors, odometry, tolerance):
    observed = observations(ROOM, CURVE, scan=scan, reflectors=reflectors, odometry=odometry)
    frames, _ = run(observed)
    distance, turn = errors(poses_of(frames), CURVE)
    assert distance.max() < tolerance
    assert turn.max() < tolerance
    assert all(f.scan_used for f in frames[1:]) == scan
    for f in frames:
        np.testing.assert_allclose(f.cov_local, f.cov_local.T, atol=1e-15)
        assert np.linalg.eigvalsh(f.cov_local).min() > -1e-12


@pytest.mark.parametrize(('scan', 'reflectors'), [(True, False), (False, True), (True, True)])
def test_scan_and_reflectors_correct_noisy_odometry(scan, reflectors):
    rng = np.random.default_rng(4)
    observed = observations(ROOM, CURVE, scan=scan, reflectors=reflectors, rng=rng)
    dead, _ = run([replace(o, points=None, origin=None, detections=None) for o in observed])
    frames, _ = run(observed)
    assert errors(poses_of(dead), CURVE)[0][-1] > 0.06
    # four sigmas of what the front end itself says
    distance, _ = errors(poses_of(frames), CURVE)
    sigma = np.sqrt([np.trace(f.cov_local[:2, :2]) for f in frames])
    assert (distance <= 4.0 * sigma + 1e-9).all()
    assert distance[-1] < 0.04


# --- invariances -------------------------------------------------------------------------------


def test_two_runs_are_bit_identical():
    observed = observations(ROOM, CURVE[:30], rng=np.random.default_rng(1))
    (a, f), (b, g) = run(observed), run(observed)
    for x, y in zip(a, b, strict=True):
        assert x.T_local_base.tobytes() == y.T_local_base.tobytes()
        assert x.cov_local.tobytes() == y.cov_local.tobytes()
        assert x.landmarks.tobytes() == y.landmarks.tobytes()
    assert f.state.P.tobytes() == g.state.P.tobytes()


def test_permuting_detections_changes_nothing():
    rng = np.random.default_rng(2)
    observed = observations(ROOM, CURVE, scan=False, rng=rng)
    shuffled = []
    for o in observed:
        d, k = o.detections, rng.permutation(len(o.detections))
        d = replace(d, points=d.points[k], cov=d.cov[k], ids=d.ids[k], diameters=d.diameters[k])
        shuffled.append(replace(o, detections=d))
    (a, f), (b, g) = run(observed), run(shuffled)
    # the same sums in another order
    np.testing.assert_allclose(poses_of(a), poses_of(b), atol=1e-9)
    p, q = f.reflectors().points, g.reflectors().points
    np.testing.assert_allclose(p[np.lexsort(p.T)], q[np.lexsort(q.T)], atol=1e-9)


# the grid lies otherwise on the walls: within a tenth of a cell, as without noise
@pytest.mark.parametrize(('scan', 'tolerance'), [(False, 1e-9), (True, 0.01)])
def test_moving_the_start_pose_moves_the_result(scan, tolerance):
    start = (3.0, -7.0, 2.5)
    observed = observations(ROOM, CURVE, scan=scan, rng=np.random.default_rng(3))
    a, f = run(observed)
    b, g = run(observed, Parameters(node=Node(map_start_pose=start)))
    distance, turn = errors(poses_of(b), se2.compose(np.array(start), poses_of(a)))
    assert distance.max() < tolerance
    assert turn.max() < tolerance
    moved = se2.transform(np.array(start), f.reflectors().points)
    np.testing.assert_allclose(g.reflectors().points, moved, atol=2.0 * tolerance)
    R = np.eye(3)
    R[:2, :2] = se2.rotation(start[2])
    if not scan:
        np.testing.assert_allclose(
            b[-1].cov_local, R @ a[-1].cov_local @ R.T, atol=1e-9 * np.trace(a[-1].cov_local)
        )


# --- reflectors --------------------------------------------------------------------------------


def test_ghost_reflector_is_never_mapped():
    rng = np.random.default_rng(5)
    observed = []
    for o in observations(ROOM, CURVE, scan=False, rng=rng):
        ghost = rng.uniform(-8.0, 8.0, (1, 2))
        observed.append(
            replace(o, detections=detections_of(np.vstack([o.detections.points, ghost]), o.stamp))
        )
    frames, front_end = run(observed)
    found = front_end.reflectors().points
    gap = np.linalg.norm(found[:, None] - ROOM.reflectors[None], axis=-1)
    assert len(found) == len(ROOM.reflectors)
    assert gap.min(axis=1).max() < 0.08
    assert errors(poses_of(frames), CURVE)[0][-1] < 0.05


def test_statuses_say_what_became_of_each_detection():
    front_end = FrontEnd(Parameters())
    first, second = observations(ROOM, CURVE[:2], scan=False)
    new = front_end.process(first)
    assert (new.statuses == Status.NEW).all()
    np.testing.assert_array_equal(new.landmarks, np.arange(len(ROOM.reflectors)))
    used = front_end.process(second)
    assert (used.statuses == Status.USED).all()
    np.testing.assert_array_equal(used.landmarks, new.landmarks)


def test_known_id_that_does_not_fit_is_gated_and_keeps_its_key():
    params = Parameters()
    observed = observations(ROOM, CURVE[:12], scan=False, ids=True)
    d = observed[-1].detections
    points = d.points.copy()
    points[2] += [1.0, 0.5]
    observed[-1] = replace(observed[-1], detections=replace(d, points=points))
    frames, _ = run(observed, params)
    assert frames[-1].statuses[2] == Status.GATED
    assert (np.delete(frames[-1].statuses, 2) == Status.USED).all()
    # the back end weighs it: it gets the key of its id
    np.testing.assert_array_equal(frames[-1].landmarks, frames[-2].landmarks)
    distance, _ = errors(poses_of(frames), CURVE[:12])
    assert distance[-1] < 1e-7


def test_localization_keeps_to_the_given_map():
    front_end = FrontEnd(Parameters(node=Node(mode='localization')))
    front_end.use_map(surveyed(ROOM.reflectors[:3], sigma=0.01))
    frames, _ = run(observations(ROOM, CURVE, scan=False), front_end=front_end)
    assert len(front_end.reflectors()) == 3
    assert (frames[-1].statuses == Status.USED).sum() == 3
    assert (frames[-1].landmarks >= 0).sum() == 3
    assert errors(poses_of(frames), CURVE)[0].max() < 1e-6


@pytest.mark.parametrize('reflectors', [3, 0])
def test_start_pose_in_a_map_that_nothing_confirms_is_lost(reflectors):
    front_end = FrontEnd(Parameters(node=Node(mode='localization')))
    front_end.use_map(surveyed(ROOM.reflectors[:reflectors] + 40.0, sigma=0.01))
    frames, _ = run(observations(ROOM, CURVE), front_end=front_end)
    waits = [(f.stamp - frames[0].stamp) * 1e-9 > 5.0 for f in frames]
    assert sum(waits) > 5
    assert sum(not w for w in waits) > 5
    for f, waited in zip(frames, waits, strict=True):
        assert f.health.level == (Level.LOST if waited else Level.DEGRADED)
        assert 'saved map' in f.health.reasons[0]


def test_assumed_start_pose_in_a_map_is_corrected_and_confirmed():
    front_end = FrontEnd(Parameters(node=Node(mode='localization')))
    front_end.reset(np.array([0.4, -0.3, 0.1]), np.zeros((3, 3)))
    front_end.use_map(surveyed(ROOM.reflectors[:3], sigma=0.01))
    frames, _ = run(observations(ROOM, CURVE, scan=False), front_end=front_end)
    assert frames[-1].health.level is Level.OK
    assert errors(poses_of(frames[-5:]), CURVE[-5:])[0].max() < 0.05


# --- scan --------------------------------------------------------------------------------------


def test_scan_that_does_not_fit_is_left_out():
    # free space has to be known as free for that: a young submap believes in any scan by 0.4
    path = drive((0.6, 0.0, 2.0), (0.6, 0.5, 2.0), (0.6, 0.9, 4.5))
    observed = observations(ROOM, path, reflectors=False)
    k = 80
    wrong = points_of(scan_at(OTHER_ROOM, np.array([0.4, 0.1, 1.0]), observed[k].stamp))
    misled = [*observed[:k], replace(observed[k], points=wrong), *observed[k + 1 :]]
    missing = [*observed[:k], replace(observed[k], points=None, origin=None), *observed[k + 1 :]]
    (a, f), (b, g) = run(misled), run(missing)
    assert not a[k].scan_used
    assert a[k + 1].scan_used
    # left out altogether: the same as if it had never come
    np.testing.assert_array_equal(poses_of(a), poses_of(b))
    np.testing.assert_array_equal(f.submaps.target.values, g.submaps.target.values)


def test_scan_with_too_few_points_is_not_used():
    observed = observations(ROOM, CURVE[:10], reflectors=False)
    few = observed[5].points[:10]
    frames, _ = run([*observed[:5], replace(observed[5], points=few), *observed[6:]])
    assert not frames[5].scan_used
    assert frames[6].scan_used


# --- health ------------------------------------------------------------------------------------


def test_bare_corridor_is_degraded_with_the_reason_and_uncertain_along_it():
    path = drive((1.0, 0.0, 6.0))
    frames, _ = run(observations(CORRIDOR, path, rng=np.random.default_rng(6), reflectors=False))
    last = frames[-1]
    assert last.scan_used
    assert last.health.level is Level.DEGRADED
    assert any('position along' in r for r in last.health.reasons)
    angle = float(last.health.reasons[0].split('along ')[1].split()[0])
    assert min(angle, 180.0 - angle) < 3.0
    # along it as by odometry alone, across it and in heading held by the walls
    var_x = np.array([f.cov_local[0, 0] for f in frames])
    assert (np.diff(var_x) > -1e-12).all()
    odometry_alone = 60 * motion_cov(np.array([0.1, 0.0, 0.0]))[0, 0]
    # and the share by which the wheels may err in speed, over all of the 6 m
    odometry_alone += (6.0 * Parameters().motion.scale_error_sigma[0]) ** 2
    assert 0.8 * odometry_alone < var_x[-1] < 1.3 * odometry_alone
    assert last.cov_local[1, 1] < 0.05 * var_x[-1] or last.cov_local[1, 1] < 0.03**2


def test_reflectors_in_the_corridor_make_it_healthy():
    path = drive((1.0, 0.0, 4.0))
    world = replace(CORRIDOR, reflectors=np.array([[-3.0, 1.1], [6.0, -1.1], [9.0, 1.1]]))
    frames, _ = run(observations(world, path, rng=np.random.default_rng(7)))
    assert all(f.health.level is Level.OK for f in frames)
    assert frames[-1].cov_local[0, 0] < 0.05**2


MARKED_CORRIDOR = replace(
    CORRIDOR, reflectors=np.array([[-3.0, 1.1], [2.5, -1.1], [6.0, 1.1], [9.0, -1.1], [14.0, 1.1]])
)


def slipped(world, share):
    """Errors (n,) and health of a drive of 8 m; wheels travel ``share`` of its motion for 2 s."""
    path = drive((1.0, 0.0, 8.0))
    observed = observations(world, path, rng=np.random.default_rng(7))
    odometry = np.zeros(3)
    for k, o in enumerate(observed):
        delta = o.motion.delta * (share if 30 < k <= 50 else 1.0)
        odometry = se2.compose(odometry, delta)
        motion = replace(o.motion, delta=delta, cov=motion_cov(delta) if k else o.motion.cov)
        observed[k] = replace(o, motion=motion, odom_pose=odometry)
    frames, front_end = run(observed)
    return np.abs(poses_of(frames) - path)[:, 0], [f.health.level for f in frames], front_end


@pytest.mark.parametrize('share', [0.0, 0.2, 1.5, 3.0])
def test_wheels_that_slip_where_reflectors_alone_say_how_far(share):
    """They are locked, or spin."""
    error, levels, front_end = slipped(MARKED_CORRIDOR, share)
    assert all(level is Level.OK for level in levels)
    assert error.max() < 0.15
    assert error[60:].max() < 0.08
    assert len(front_end.reflectors().keys) == len(MARKED_CORRIDOR.reflectors)


@pytest.mark.parametrize('spacing', [0.6, 1.0, 1.5])
@pytest.mark.parametrize('share', [0.2, 3.0])
def test_wheels_that_slip_along_a_row_of_reflectors(spacing, share):
    x = np.arange(-3.0, 14.0, spacing)
    row = replace(CORRIDOR, reflectors=np.stack([x, np.full(len(x), 1.1)], -1))
    error, levels, front_end = slipped(row, share)
    assert max(levels) < Level.LOST
    assert error.max() < 0.15
    assert error[60:].max() < 0.05
    assert len(front_end.reflectors().keys) == len(x)


def test_reflectors_that_come_into_view_are_no_slip():
    front_end = FrontEnd(Parameters())
    front_end.process(Observation(FIRST - STEP, Motion(np.zeros(3), np.zeros((3, 3)))))
    slip = front_end._reflectors._slip
    for o in observations(MARKED_CORRIDOR, drive((1.0, 0.0, 8.0)), rng=np.random.default_rng(7)):
        front_end.process(o)
        assert not slip.cov.any()


def test_room_is_healthy_and_lost_inputs_are_named():
    frames, front_end = run(observations(ROOM, CURVE[:20]))
    assert all(f.health.level is Level.OK and not f.health.reasons for f in frames)
    # from here on nothing but odometry, of which even that is missing
    stamp = frames[-1].stamp
    blind = Motion(np.zeros(3), 0.01 * np.eye(3), known=False)
    for k in range(1, 30):
        frame = front_end.process(Observation(stamp + k * STEP, blind))
    assert 'no odometry' in frame.health.reasons
    assert 'position is from odometry alone' in frame.health.reasons
    assert frame.health.level >= Level.DEGRADED


def test_strange_place_is_lost():
    frames, front_end = run(observations(ROOM, CURVE[:20]))
    stamp = frames[-1].stamp
    rng = np.random.default_rng(8)
    levels = []
    for k in range(1, 9):
        points = rng.uniform(-6.0, 6.0, (180, 2))
        o = Observation(stamp + k * 2 * STEP, Motion(np.zeros(3), 1e-6 * np.eye(3)), points,
                        np.zeros(2))  # fmt: skip
        levels.append(front_end.process(o).health.level)
    assert levels[0] is Level.OK
    assert Level.LOST in levels


# --- the back end's belief ---------------------------------------------------------------------


def belief_of(front_end, shift=(0.0, 0.0)):
    tracks, state = front_end.tracks, front_end.state
    return Belief(
        state.pose, tracks.keys.copy(), state.landmarks() + shift,
        state.pose_and_landmarks_cov().copy(), {},
    )  # fmt: skip


def test_adopting_its_own_belief_changes_no_pose_and_no_reflector():
    observed = observations(ROOM, CURVE, scan=False, rng=np.random.default_rng(9))
    _, front_end = run(observed[:40])
    belief = belief_of(front_end)
    assert not front_end.contradicts(belief)
    before = front_end.state.x.copy(), front_end.state.pose_and_landmarks_cov()
    front_end.adopt(belief)
    np.testing.assert_allclose(front_end.state.x, before[0], atol=1e-12)
    np.testing.assert_allclose(front_end.state.pose_and_landmarks_cov(), before[1], atol=1e-15)


def test_belief_that_differs_beyond_the_gate_contradicts_and_is_adopted():
    observed = observations(ROOM, CURVE, scan=False, rng=np.random.default_rng(10))
    _, front_end = run(observed[:40])
    shift = np.array([0.5, 0.0])
    belief = belief_of(front_end, shift)
    assert front_end.contradicts(belief)
    unknown = belief.cov.copy()
    unknown[2, 2] += 1.8**2  # of a robot that was carried, no filter can be linearized
    assert not front_end.contradicts(replace(belief, cov=unknown))
    points = front_end.state.landmarks().copy()
    front_end.adopt(belief)
    assert not front_end.contradicts(belief)
    np.testing.assert_allclose(front_end.state.landmarks(), points + shift, atol=1e-12)


def test_merged_keys_go_on_under_one_name():
    observed = observations(ROOM, CURVE, scan=False)
    _, front_end = run(observed[:20])
    b = belief_of(front_end)
    keep = np.r_[0:3, 5 : len(b.cov)]
    merged = Belief(b.T_map_base, b.keys[1:], b.points[1:], b.cov[np.ix_(keep, keep)], {0: 3})
    # a name alone is no reason to give up what this end knows of the places
    assert not front_end.contradicts(merged)
    front_end.adopt(merged)
    assert 0 not in front_end.tracks.keys
    assert front_end.state.num_landmarks == len(front_end.tracks) == len(ROOM.reflectors) - 1


# --- consistency -------------------------------------------------------------------------------


def yard_drive(seed):
    """NEES (n,) of a noisy drive in the yard of the simulator, the noise being the model's."""
    yard = load_world('yard')
    rng = np.random.default_rng([seed, 77])
    start = [12.0, 9.0, rng.uniform(-np.pi, np.pi)]
    # the map frame is the start
    points = se2.transform(se2.inverse(start), yard.reflectors.points)
    world = replace(ROOM, walls=np.zeros((0, 4)), reflectors=points)
    path = drive((1.0, 0.25, 6.0), (1.0, -0.4, 6.0))
    frames, _ = run(observations(world, path, scan=False, rng=rng, sigma=0.03))
    e = poses_of(frames) - path
    e[:, 2] = se2.wrap(e[:, 2])
    cov = np.array([f.cov_local for f in frames])
    return np.einsum('ni,ni->n', e[1:], np.linalg.solve(cov[1:], e[1:, :, None])[..., 0])


def test_pose_covariance_is_consistent_in_the_yard():
    seeds = 20
    nees = np.array([yard_drive(seed) for seed in range(seeds)])
    # Neighbouring frames share most of their error, so the frames of one drive count as one
    # sample: their mean spreads no more than a single frame's chi-square of 3 degrees of freedom.
    low, high = chi2.interval(0.99, 3 * seeds) / np.array(seeds)
    assert low < nees.mean() < high
    # and so at the end of the drive, where errors had the time to add up
    assert low < nees[:, -1].mean() < high
    # two frames far apart share little, so that single frames beyond the gate stay few
    assert (nees > chi2.ppf(0.999, 3)).mean() < 0.02


def test_stamps_and_observations_are_copied_from_the_input():
    observed = observations(ROOM, CURVE[:3])
    frames, _ = run(observed)
    assert [f.stamp for f in frames] == [FIRST + k * STEP for k in range(3)]
    # all but the motion, which is as the front end has come to know the wheels
    for f, o in zip(frames, observed, strict=True):
        for name in (field.name for field in fields(o) if field.name != 'motion'):
            assert getattr(f.observation, name) is getattr(o, name), name
        cov = f.observation.motion.cov
        np.testing.assert_allclose(cov, o.motion.cov, rtol=0.02)  # of two steps little is learned
        assert (np.diag(cov) <= np.diag(o.motion.cov)).all()


def test_scans_that_come_in_bursts_tell_no_velocity():
    front_end = FrontEnd(Parameters())
    poses = drive((0.4, 0.2, 6.0))
    got = []
    for o in observations(
        ROOM, poses, reflectors=False, odometry=False, rng=np.random.default_rng(5)
    ):
        again = replace(o, stamp=o.stamp + 1_000_000, motion=Motion(np.zeros(3), np.eye(3), False))
        for one in (o, again):
            frame = front_end.process(one)
        got.append(frame.T_local_base)
    distance, _ = errors(np.array(got), poses)
    # a scan that is found 1 mm off in 1 ms would make it 1 m/s
    assert distance.max() < 0.03


def test_a_moving_robot_is_as_uncertain_as_its_stamps_are():
    speed, late = 0.5, 0.02
    observed = observations(ROOM, drive((speed, 0.0, 2.0)))
    sure, _ = run(observed)
    unsure, _ = run([replace(o, stamp_sigma=late) for o in observed])
    added = np.array([f.cov_map for f in unsure]) - np.array([f.cov_map for f in sure])
    along = unsure[-1].T_map_base[2]
    lag = late * speed * np.array([np.cos(along), np.sin(along)])
    np.testing.assert_allclose(added[-1][:2, :2], np.outer(lag, lag), atol=0.1 * lag @ lag)
    np.testing.assert_allclose(unsure[-1].T_map_base, sure[-1].T_map_base, atol=1e-12)


# --- what can wait -----------------------------------------------------------------------------


def test_when_a_scan_is_carved_changes_no_bit():
    one, other = FrontEnd(Parameters()), FrontEnd(Parameters())
    for o in observations(ROOM, CURVE):
        a, b = one.process(o), other.process(o)
        other.settle()
        assert a.T_local_base.tobytes() == b.T_local_base.tobytes()
        assert a.cov_local.tobytes() == b.cov_local.tobytes()
    assert one.submaps.target.values.tobytes() == other.submaps.target.values.tobytes()
    assert one.submaps.target.insertions > 10


def test_grids_are_left_alone_until_the_frame_is_out_and_seen_with_the_scan():
    front_end = FrontEnd(Parameters())
    seen = observations(ROOM, CURVE)
    front_end.process(next(iter(seen)))
    submap = front_end.submaps._maps[0]
    assert submap.insertions == 0
    front_end.settle()
    assert submap.insertions == 1
    front_end.settle()
    assert submap.insertions == 1
