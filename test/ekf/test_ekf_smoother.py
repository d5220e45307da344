# SPDX-License-Identifier: Apache-2.0
"""The smoothed path against one dense solve of everything, and against central differences."""

import numpy as np
import pytest
from differences import central_differences
from made_worlds import ROOM, drive, observations
from scipy.stats import chi2

from rlml_slam import se2
from rlml_slam.ekf.filter import ROBOT, SPEED, TURN, Filter
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.estimation.landmark_models import POINT, Model
from rlml_slam.estimation.smoother import Sight, Start, Step, _Problem, smooth
from rlml_slam.params import EkfParameters, from_mapping
from rlml_slam.types import Motion

R = np.array([[0.02, 0.005], [0.005, 0.03]]) ** 2 + 1e-4 * np.eye(2)
Q = np.diag([0.05, 0.02, 0.01]) ** 2
KEPT = 0.9


def linear_model():
    """Landmarks measured as where they are from the robot, in the axes of the map."""

    def observe(pose, landmarks):
        shape = (len(landmarks), 2)
        H_r = np.zeros((*shape, 3))
        H_r[:, :, :2] = -np.eye(2)
        return landmarks - pose[..., :2], H_r, np.broadcast_to(np.eye(2), (*shape, 2))

    def place(pose, z):
        J = np.zeros((len(z), 2, 3))
        J[:, :, :2] = np.eye(2)
        return pose[..., :2] + z, J, np.broadcast_to(np.eye(2), (len(z), 2, 2))

    return Model(observe, place, lambda z, h: z - h)


def filtered(steps, start, model, invariant=False):
    """The filter's poses over the steps, and the filter at their end."""
    f = Filter(start.x[:3], start.P[:3, :3], np.sqrt(start.P[3, 3]), model, invariant,
               np.sqrt(np.diag(start.P)[SPEED:ROBOT]))  # fmt: skip
    slots, poses = {}, []
    for step in steps:
        f.predict(step.motion, step.walk, step.kept)
        for s in step.sights:
            if s.key in slots:
                f.update(slots[s.key], s.z, s.R)
            else:
                slots[s.key] = f.augment(s.z, s.R)
        poses.append(f.pose)
    return np.array(poses), f, slots


def linear_case(rng, n=12):
    """Steps without turns and without wheel errors, and dense mean and covariance of all."""
    start = Start(np.zeros(ROBOT), np.diag([0.1, 0.2, 0.0, 0.0, 0.0, 0.0]) ** 2)
    steps, true = [], 0.1 * rng.standard_normal(2)
    landmarks = {key: rng.uniform(-3.0, 3.0, 2) for key in (5, 9, 11)}
    for k in range(n):
        delta = np.array([*rng.normal(0.3, 0.1, 2), 0.0])
        true = true + delta[:2] + rng.normal(0.0, (0.05, 0.02))
        sights = tuple(
            Sight(key, at - true + rng.multivariate_normal(np.zeros(2), R), R)
            for key, at in landmarks.items()
            if rng.random() < 0.6 or not k
        )
        motion = Motion(delta, np.diag([0.05, 0.02, 0.0]) ** 2)
        steps.append(Step(motion, 0.0, 1.0, sights))
    return start, steps


def dense(start, steps, keys):
    """Places (n, 2) and landmarks (m, 2), of which nothing is known before, in covariance form.

    Generalised least squares for the landmarks, and the places' conditional mean given them.
    """
    n = len(steps)
    mean, variances = [], []
    P, at = start.P[:2, :2], start.x[:2]
    for step in steps:
        at, P = at + step.motion.delta[:2], P + step.motion.cov[:2, :2]
        mean.append(at)
        variances.append(P)
    mean = np.concatenate(mean)
    cov = np.block([[variances[min(i, j)] for j in range(n)] for i in range(n)])
    sights = [(i, s) for i, step in enumerate(steps) for s in step.sights]
    H, G = np.zeros((2 * len(sights), 2 * n)), np.zeros((2 * len(sights), 2 * len(keys)))
    noise = np.zeros((2 * len(sights), 2 * len(sights)))
    for k, (i, s) in enumerate(sights):
        rows, a = slice(2 * k, 2 * k + 2), 2 * keys.index(s.key)
        H[rows, 2 * i : 2 * i + 2], G[rows, a : a + 2] = -np.eye(2), np.eye(2)
        noise[rows, rows] = s.R
    S = H @ cov @ H.T + noise
    nu = np.concatenate([s.z for _, s in sights]) - H @ mean
    points = np.linalg.solve(G.T @ np.linalg.solve(S, G), G.T @ np.linalg.solve(S, nu))
    places = mean + cov @ H.T @ np.linalg.solve(S, nu - G @ points)
    return places.reshape(-1, 2), points.reshape(-1, 2)


@pytest.mark.parametrize('seed', range(3))
def test_linear_case_is_the_dense_solution_of_everything(seed):
    start, steps = linear_case(np.random.default_rng(seed))
    model = linear_model()
    poses, f, slots = filtered(steps, start, model)
    found = smooth(start, steps, model, poses)
    places, points = dense(start, steps, [5, 9, 11])
    # the floor of the smoother's sigmas is not quite nothing
    assert np.abs(found.states[:, :2] - places).max() < 1e-8
    assert np.abs(found.points - points).max() < 1e-8
    assert np.abs(found.states[:, :2] - poses[:, :2]).max() > 1e-2
    # the filter's last is the smoother's last
    assert np.abs(found.states[-1, :2] - f.pose[:2]).max() < 1e-8
    at = [slots[k] for k in found.keys]
    assert np.abs(found.points - f.points[at]).max() < 1e-8
    # and so are the covariances: of a linear case the filter's are those of everything
    assert np.abs(found.covs - f.point_covs()[at]).max() < 1e-8


def curved_case(rng, n=40):
    """Steps of a drive with gyro and wheels that err, all noise of its size."""
    start = Start(np.array([0.3, -0.2, 0.4, 0.0, 0.0, 0.0]),
                  np.diag([0.01, 0.01, 0.01, 0.02, 0.1, 0.1]) ** 2)  # fmt: skip
    true = start.x + np.sqrt(np.diag(start.P)) * rng.standard_normal(ROBOT)
    landmarks = rng.uniform(-4.0, 4.0, (6, 2))
    steps, truth = [], []
    for k in range(n):
        delta = np.array([0.2, 0.0, 0.12])
        gain = np.array([0.0, 0.0, -0.1]) if k % 2 else np.zeros(3)
        turn = np.zeros(3) if k % 2 else np.array([0.0, 0.0, delta[2]])
        moved = delta + gain * true[3] + turn * true[TURN]
        moved[:2] *= 1.0 + true[SPEED]
        moved = moved + np.sqrt(np.diag(Q)) * rng.standard_normal(3)
        bias = true[3] + 0.4 * true[TURN] + 0.01 * rng.standard_normal()
        motion = Motion(delta, Q, True, gain, bias, 1e-4 if k % 3 else np.inf, turn, 0.4)
        true[:3] = se2.compose(true[:3], moved)
        true[3] += 1e-3 * rng.standard_normal()
        true[SPEED:ROBOT] *= KEPT
        new = np.sqrt((1.0 - KEPT**2) * np.diag(start.P)[SPEED:ROBOT])
        true[SPEED:ROBOT] += new * rng.standard_normal(2)
        h = POINT.observe(true[:3], landmarks)[0]
        near = np.flatnonzero(h[:, 0] < 2.0)
        noise = rng.multivariate_normal(np.zeros(2), R, len(near))
        sights = tuple(Sight(int(i), z, R) for i, z in zip(near, h[near] + noise, strict=True))
        steps.append(Step(motion, 1e-6, KEPT, sights))
        truth.append(true.copy())
    return start, steps, np.array(truth)


def test_jacobians_are_those_of_the_errors():
    rng = np.random.default_rng(1)
    start, steps, truth = curved_case(rng, 5)
    problem = _Problem(start, steps, POINT)
    x = np.concatenate([start.x[None], truth]) + 0.05 * rng.standard_normal((6, ROBOT))
    points = rng.uniform(-4.0, 4.0, (len(problem.keys), 2))
    y = np.concatenate([x.ravel(), points.ravel()])

    def errors(y):
        return problem.rows(y[: x.size].reshape(x.shape), y[x.size :].reshape(-1, 2)).errors()

    J = problem.rows(x, points).jacobian(len(y)).toarray()
    # whitened: a row counts in its own sigmas
    numeric = central_differences(errors, y)
    assert (np.abs(J - numeric) / np.abs(numeric).max(axis=1, keepdims=True)).max() < 1e-6


def test_smoothed_path_is_the_most_probable_one():
    start, steps, truth = curved_case(np.random.default_rng(2))
    poses, _, _ = filtered(steps, start, POINT, invariant=True)
    found = smooth(start, steps, POINT, poses)
    x = np.concatenate([found.start[None], found.states])
    rows = _Problem(start, steps, POINT).rows(x, found.points)
    J = rows.jacobian(x.size + found.points.size)
    # the gradient of the cost is zero, up to the last step and rounding
    assert np.abs(J.T @ rows.errors()).max() < 1e-5 * abs(J).max() ** 2
    true = np.concatenate([start.x[None], truth])
    at_truth = _Problem(start, steps, POINT).rows(true, found.points).errors()
    assert np.linalg.norm(rows.errors()) < np.linalg.norm(at_truth)


def test_covariances_are_those_of_the_joint_information():
    start, steps, _ = curved_case(np.random.default_rng(4))
    poses, _, _ = filtered(steps, start, POINT, invariant=True)
    found = smooth(start, steps, POINT, poses)
    x = np.concatenate([found.start[None], found.states])
    rows = _Problem(start, steps, POINT).rows(x, found.points)
    J = rows.jacobian(x.size + found.points.size).toarray()
    # the Schur complement, whose inverse needs no inverse of all
    left, right = J[:, : x.size], J[:, x.size :]
    Q, _ = np.linalg.qr(left)
    rest = right - Q @ (Q.T @ right)
    cov = np.linalg.inv(rest.T @ rest)
    for k, found_cov in enumerate(found.covs):
        block = cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        assert np.abs(found_cov - block).max() < 1e-6 * np.abs(block).max()


def test_smoothed_landmarks_are_as_sure_as_they_say():
    """Of landmarks seen from one drive the errors are correlated: a run counts as one."""
    runs, nees, before = 40, [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        start, steps, _ = curved_case(rng, 60)
        # the landmarks are the first that are drawn after the start's errors
        again = np.random.default_rng(seed)
        again.standard_normal(ROBOT)
        landmarks = again.uniform(-4.0, 4.0, (6, 2))
        poses, f, slots = filtered(steps, start, POINT, invariant=True)
        found = smooth(start, steps, POINT, poses)
        e = found.points - landmarks[found.keys]
        nees.append(
            np.mean([d @ np.linalg.solve(P, d) for d, P in zip(e, found.covs, strict=True)])
        )
        live = f.point_covs()[[slots[k] for k in found.keys]]
        before.append(np.trace(found.covs, axis1=1, axis2=2) / np.trace(live, axis1=1, axis2=2))
    low, high = chi2.ppf([0.001, 0.999], 2 * runs) / runs
    assert low < np.mean(nees) < high
    # the filter has used all of it too, where its linearisations were good
    assert 0.5 < np.median(np.concatenate(before)) < 1.1


def test_smoothing_takes_out_error_of_wheels_that_err():
    before, after = [], []
    for seed in range(8):
        start, steps, truth = curved_case(np.random.default_rng(seed), 80)
        poses, _, _ = filtered(steps, start, POINT, invariant=True)
        found = smooth(start, steps, POINT, poses)
        for path, out in ((poses, before), (found.states[:, :3], after)):
            out.append(np.hypot(*(path - truth[:, :3])[:, :2].T).mean())
    assert np.mean(after) < 0.9 * np.mean(before)


# --- the whole system --------------------------------------------------------------------------

LOOP = drive((0.5, 0.0, 4.0), (0.5, 1.2, 5.2), (0.5, 0.0, 6.0), (0.5, 1.2, 5.2), (0.5, 0.0, 3.0))


def run(smoothed):
    slam = EkfSlam(from_mapping({'ekf.smooth': smoothed}, EkfParameters))
    observed = observations(ROOM, LOOP, scan=False, rng=np.random.default_rng(3), sigma=0.02)
    frames = slam.process(observed)
    slam.finish()
    return slam, np.array([f.T_map_base for f in frames])


def test_frames_are_live_and_the_trajectory_is_smoothed():
    slam, live = run(True)
    plain, same = run(False)
    assert np.array_equal(live, same)
    assert np.array_equal(plain.trajectory()[1], live)
    error = [np.hypot(*(p - LOOP)[:, :2].T).mean() for p in (slam.trajectory()[1], live)]
    assert error[0] < error[1]
    smoothed, filtered_ = slam.reflectors(), plain.reflectors()
    assert len(smoothed) == len(filtered_)
    assert not np.array_equal(smoothed.cov, filtered_.cov)
    assert (np.linalg.eigvalsh(smoothed.cov) > 0.0).all()
    # the last pose knows no more than the filter: the same, but for where it was linearised
    last = slam.trajectory()[1][-1] - live[-1]
    assert np.abs(last).max() < 0.02
