# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from differences import central_differences
from made_states import made

from rlml_lab.support.drives import feed, simulate
from rlml_slam import se2
from rlml_slam.params import Node, Parameters, SimulatorParameters, from_mapping
from rlml_slam.slam.front_end.constant_velocity import coast, way_cov
from rlml_slam.slam.front_end.joint_state import BIAS, VELOCITY, JointState
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Level, Motion

SIGMA = np.array([0.8, 0.3, 1.2])
TIME = 2.0
UNMEASURED = Motion(np.zeros(3), np.eye(3), known=False)


def moving(seed=0, theta=0.4):
    """A state with every correlation there can be, at speeds of a robot."""
    return made(seed, landmarks=1, theta=theta, spread=0.7)


@pytest.mark.parametrize('theta', [0.0, 0.4, 3.1])
@pytest.mark.parametrize('gain', [0.0, -0.5])
def test_state_moves_by_its_velocity_as_in_a_dense_ekf(theta, gain):
    state, dt = moving(theta=theta), 0.5
    x, P = state.x.copy(), state.P.copy()
    motion = Motion(
        np.array([0.0, 0.0, 0.3]), np.diag([1.0, 1.0, 1e-4]), False, np.array([0.0, 0.0, gain])
    )
    span = TIME * (1.0 - np.exp(-dt / TIME))

    def f(y):
        out = y.copy()
        d = span * y[VELOCITY : VELOCITY + 3]
        if gain:  # a gyro measures the turn
            d[2] = 0.3 + gain * y[BIAS]
        half = se2.compose(y[:3], (0.0, 0.0, 0.5 * d[2]))
        out[:3] = se2.compose(half, (d[0], d[1], 0.5 * d[2]))
        out[VELOCITY : VELOCITY + 3] *= np.exp(-dt / TIME)
        return out

    F = central_differences(f, x, angles=(2,))
    way = coast(state, dt, SIGMA, TIME, 0.0, motion)
    np.testing.assert_allclose(state.x, f(x), atol=1e-12)
    Q = state.P - F @ P @ F.T
    rest = np.delete(np.arange(len(x)), [0, 1, 2, VELOCITY, VELOCITY + 1, VELOCITY + 2])
    np.testing.assert_allclose(Q[rest], 0.0, atol=1e-8)
    np.testing.assert_allclose(Q, Q.T, atol=1e-12)
    assert np.linalg.eigvalsh(Q).min() > -1e-9
    assert np.linalg.eigvalsh(way).min() > 0.0


def test_two_steps_are_as_uncertain_as_one_of_the_same_time():
    once, twice = (JointState(np.zeros(3), np.zeros((3, 3)), 0.02, SIGMA) for _ in range(2))
    for state in (once, twice):
        state.x[VELOCITY] = 0.7  # straight on, so that the model is linear
    coast(once, 0.6, SIGMA, TIME, 0.0, UNMEASURED)
    for _ in range(2):
        coast(twice, 0.3, SIGMA, TIME, 0.0, UNMEASURED)
    np.testing.assert_allclose(twice.x, once.x, atol=1e-12)
    straight = [0, 2, VELOCITY, VELOCITY + 2]
    cov = np.ix_(straight, straight)
    np.testing.assert_allclose(twice.P[cov], once.P[cov], atol=1e-12)


def test_speed_fades_and_is_never_less_sure_than_an_unknown_one():
    state = JointState(np.zeros(3), np.zeros((3, 3)), 0.02, SIGMA)
    moving = slice(VELOCITY, VELOCITY + 3)
    state.x[VELOCITY], state.P[moving, moving] = 3.0, 0.0
    for _ in range(400):
        coast(state, 0.1, SIGMA, TIME, 0.0, UNMEASURED)
    np.testing.assert_allclose(state.x[moving], 0.0, atol=1e-6)
    np.testing.assert_allclose(state.P[moving, moving], np.diag(SIGMA**2), atol=1e-6)
    # what is left of the way is that of the first two seconds
    assert state.x[0] == pytest.approx(3.0 * TIME, abs=1e-6)


def test_motion_is_as_sure_as_the_scans_and_no_surer_than_the_speed_where_they_are_blind():
    way = np.diag([0.04, 0.04, 0.04])
    before = np.diag([0.01, 1e-4, 1e-5])
    scan = np.diag([0.0, 1e4, 1e5])  # blind along x
    after = np.linalg.inv(np.linalg.inv(before + way) + scan)
    cov = way_cov(way, before, after, 0.0)
    assert cov[1, 1] == pytest.approx(2e-4, rel=0.01)  # that of both ends
    assert cov[2, 2] == pytest.approx(2e-5, rel=0.01)
    # and what is lost along x, a speed that may be wrong for long, counts once more
    assert cov[0, 0] == pytest.approx(0.08, rel=0.01)


def test_covariance_of_a_motion_is_symmetric_however_little_is_known_of_it():
    """Beside the noise of a sharp sensor, rounding of the wide ones made it none for the graph."""
    rng = np.random.default_rng(0)

    def covariance():
        axes, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        A = axes @ np.diag(10.0 ** rng.uniform(-8.0, 2.0, 3)) @ axes.T
        return 0.5 * (A + A.T)

    for _ in range(200):
        cov = way_cov(covariance(), covariance(), covariance(), rng.uniform(-np.pi, np.pi))
        np.testing.assert_allclose(cov, cov.T, rtol=1e-12)
        assert np.linalg.eigvalsh(cov)[0] > 0.0


@pytest.mark.parametrize(
    ('world', 'reflectors', 'ray_times'),
    [('hall', False, False), ('hall', False, True), ('yard', True, False)],
)
def test_pose_is_held_without_odometry_and_as_sure_as_it_is_told(world, reflectors, ray_times):
    drive: SimulatorParameters = from_mapping(
        {'world': world, 'duration': 25.0, 'laser.ray_times': ray_times}, SimulatorParameters
    )
    messages, truth = simulate(drive, 3)
    node = Node(use_odom=False, use_imu=False, use_reflectors=reflectors)
    frames = [f for one in feed(Slam(Parameters(node=node)), messages) for f in one]
    path = truth.trajectory
    at = np.searchsorted(path.stamps, [f.stamp for f in frames])
    true = path.poses[np.minimum(at, len(path.stamps) - 1)]
    e = se2.between(se2.between(true[0], true), np.array([f.T_local_base for f in frames]))
    nees = []
    for error, frame in zip(e[50:], frames[50:], strict=True):
        R = np.eye(3)  # from the axes of the local frame to those of the base
        R[:2, :2] = se2.rotation(frame.T_local_base[2]).T
        nees.append(error @ np.linalg.solve(R @ frame.cov_local @ R.T, error))
    assert len(nees) > 100
    assert all(f.health.level is Level.OK for f in frames)
    # 0.3 % of a way of 23 m, and as much of a half turn
    assert np.hypot(e[:, 0], e[:, 1]).max() < 0.07
    assert np.abs(e[:, 2]).max() < np.deg2rad(0.5)
    # one drive has few independent errors: the 95 % of a chi-square of one of them
    assert np.mean(nees) < 7.8
