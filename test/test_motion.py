# SPDX-License-Identifier: Apache-2.0
import itertools
import math

import numpy as np
import pytest
from differences import central_differences

from rlml_slam import se2
from rlml_slam.motion import COAST, SECOND, STILL, MotionBuffer, compose_motion, integrate
from rlml_slam.params import MotionNoise
from rlml_slam.types import Imu, Motion, Odometry

NOISE = MotionNoise()
MS = SECOND // 1000
T0 = 10 * SECOND


def path(t):
    """A smooth path (3,) with both turns and straights."""
    return np.array([0.8 * t, 0.3 * math.sin(t), 0.4 * math.sin(0.9 * t)])


def filled(pose_at=path, rate=50, duration=4.0, imu=None, imu_rate=100, noise=NOISE, memory=60.0):
    """A buffer with odometry of ``pose_at``(t [s]) and yaw rates of ``imu``(t) from T0 on."""
    buffer = MotionBuffer(noise, memory)
    for k in range(round(duration * rate) + 1):
        t = k / rate
        buffer.add_odometry(Odometry(T0 + round(t * SECOND), np.asarray(pose_at(t), dtype=float)))
    if imu is not None:
        for k in range(round(duration * imu_rate) + 1):
            t = k / imu_rate
            buffer.add_imu(Imu(T0 + round(t * SECOND), float(imu(t))))
    return buffer


def line(v, w=0.0):
    return lambda t: se2.exp(np.array([v * t, 0.0, w * t]))


def chained(v, w, dt, side, noise=None):
    """Eq. 7 to 9 as the notes have them, on dense matrices, one interval after another.

    With a velocity ``side`` across the heading, which the notes do not have.
    """
    X, P = np.zeros(3), np.zeros((3, 3))
    for k in range(len(v)):
        h, th = dt[k], X[2] + 0.5 * w[k] * dt[k]
        dx, dy = se2.rotation(th) @ (v[k] * h, side[k] * h)
        G_x = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0, 0, 1.0]])
        G_u = np.array(
            [
                [h * math.cos(th), -0.5 * h * dy, -h * math.sin(th)],
                [h * math.sin(th), 0.5 * h * dx, h * math.cos(th)],
                [0.0, h, 0.0],
            ]
        )
        X = X + np.array([dx, dy, w[k] * h])
        if noise is not None:
            P = G_x @ P @ G_x.T + G_u @ np.diag(noise[:, k]) @ G_u.T
    return X, P


# --- eq. 5 to 9 --------------------------------------------------------------------------------


def test_integration_is_equations_7_to_9():
    rng = np.random.default_rng(0)
    v, w, dt = rng.normal(0.5, 1.0, 9), rng.normal(0.0, 2.0, 9), rng.uniform(0.01, 0.3, 9)
    side, noise = rng.normal(0.0, 0.3, 9), rng.uniform(0.0, 0.1, (3, 9))
    out = integrate(v, w, dt, noise[0], noise[1], noise[2], np.zeros(9), side)
    X, P = chained(v, w, dt, side, noise)
    np.testing.assert_allclose(out[0], X, rtol=1e-12)
    np.testing.assert_allclose(out[1:4], P, rtol=1e-10, atol=1e-15)
    np.testing.assert_array_equal(out[4], 0.0)


def test_control_jacobian_is_that_of_the_midpoint_model():
    v, w, dt = np.array([0.7, 1.1]), np.array([0.9, -1.3]), np.array([0.2, 0.3])
    zero, side = np.zeros(2), np.linspace(-0.2, 0.3, 2)

    def moved(u):
        return integrate(u[:2], u[2:4], dt, zero, zero, zero, zero, side)[0]

    J = central_differences(moved, np.concatenate([v, w]))
    var = np.array([0.03, 0.05, 0.02, 0.04])
    P = integrate(v, w, dt, var[:2], var[2:4], zero, zero, side)[1:4]
    # 1e-9 is what central differences leave
    np.testing.assert_allclose(P, J @ np.diag(var) @ J.T, atol=1e-9)


def test_bias_gain_is_the_derivative_by_the_gyros_bias():
    rng = np.random.default_rng(1)
    v, w, dt = rng.normal(0.5, 1.0, 7), rng.normal(0.0, 1.0, 7), rng.uniform(0.05, 0.3, 7)
    gyro = np.array([1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    zero, side = np.zeros(7), np.linspace(-0.2, 0.3, 7)

    def moved(bias):
        return integrate(v, w - gyro * bias[0], dt, zero, zero, zero, gyro, side)[0]

    gain = central_differences(moved, np.zeros(1))[:, 0]
    out = integrate(v, w, dt, zero, zero, zero, gyro, side)
    np.testing.assert_allclose(out[4], gain, atol=1e-8)
    assert abs(gain[2]) > 0.1


def test_turn_gain_is_the_derivative_by_what_the_wheels_turn_too_little():
    rng = np.random.default_rng(4)
    v, w, dt = rng.normal(0.5, 1.0, 7), rng.normal(0.0, 1.0, 7), rng.uniform(0.05, 0.3, 7)
    gyro = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    zero, side = np.zeros(7), np.linspace(-0.2, 0.3, 7)

    def moved(share):
        wheels = 1.0 + (1.0 - gyro) * share[0]
        return integrate(v, wheels * w, dt, zero, zero, zero, gyro, side)[0]

    gain = central_differences(moved, np.zeros(1))[:, 0]
    out = integrate(v, w, dt, zero, zero, zero, gyro, side)
    np.testing.assert_allclose(out[5], gain, atol=1e-8)
    assert np.abs(gain).min() > 0.01


def test_drift_gain_is_the_derivative_by_the_turn_per_distance():
    rng = np.random.default_rng(4)
    v, w, dt = rng.normal(0.5, 1.0, 7), rng.normal(0.0, 1.0, 7), rng.uniform(0.05, 0.3, 7)
    gyro = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    zero, side = np.zeros(7), np.linspace(-0.2, 0.3, 7)

    def moved(drift):
        turn = w + (1.0 - gyro) * drift[0] * v
        return integrate(v, turn, dt, zero, zero, zero, gyro, side)[0]

    gain = central_differences(moved, np.zeros(1))[:, 0]
    out = integrate(v, w, dt, zero, zero, zero, gyro, side)
    np.testing.assert_allclose(out[6], gain, atol=1e-8)
    assert np.abs(gain).min() > 0.01


def test_way_is_its_own_derivative_by_the_share_of_speed():
    rng = np.random.default_rng(5)
    v, w, dt = rng.normal(0.5, 1.0, 7), rng.normal(0.0, 1.0, 7), rng.uniform(0.05, 0.3, 7)
    zero, side = np.zeros(7), np.linspace(-0.2, 0.3, 7)

    def moved(share):
        return integrate(
            (1.0 + share[0]) * v, w, dt, zero, zero, zero, zero, (1.0 + share[0]) * side
        )[0]

    gain = central_differences(moved, np.zeros(1))[:, 0]
    np.testing.assert_allclose(gain, [*moved(np.zeros(1))[:2], 0.0], atol=1e-8)


def test_covariance_is_that_of_sampled_noise():
    rng = np.random.default_rng(2)
    n, samples = 10, 4000
    v, w, dt = np.full(n, 1.0), np.full(n, 0.7), np.full(n, 0.1)
    sigma = np.array([0.1, 0.05, 0.05])
    P = integrate(v, w, dt, *(np.full(n, s * s) for s in sigma), *np.zeros((2, n)))[1:4]
    noise = sigma[:, None, None] * rng.standard_normal((3, samples, n))
    ends = np.zeros((samples, 3))
    for k in range(n):
        vk, wk, sk = v[k] + noise[0, :, k], w[k] + noise[1, :, k], noise[2, :, k]
        th = ends[:, 2] + 0.5 * wk * dt[k]
        ends[:, 0] += dt[k] * (vk * np.cos(th) - sk * np.sin(th))
        ends[:, 1] += dt[k] * (vk * np.sin(th) + sk * np.cos(th))
        ends[:, 2] += wk * dt[k]
    # a sampled variance has a relative sigma of sqrt(2 / samples) = 2.2 %; four of them
    L = np.linalg.inv(np.linalg.cholesky(P))
    np.testing.assert_allclose(L @ np.cov(ends.T) @ L.T, np.eye(3), atol=0.09)


def test_composition_is_the_integration_in_parts():
    rng = np.random.default_rng(3)
    rows = np.vstack(
        [
            rng.normal(0.5, 1.0, 8), rng.normal(0.0, 2.0, 8), rng.uniform(0.01, 0.3, 8),
            rng.uniform(0.0, 0.1, (3, 8)), np.array([[1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0]]),
            rng.normal(0.0, 0.3, 8),
        ]
    )  # fmt: skip
    parts = [integrate(*np.ascontiguousarray(r)) for r in (rows, rows[:, :3], rows[:, 3:])]
    both, a, b = (Motion(p[0], p[1:4], True, p[4], turn_gain=p[5], drift_gain=p[6]) for p in parts)
    c = compose_motion(a, b)
    np.testing.assert_allclose(c.delta[:2], both.delta[:2], atol=1e-12)
    assert abs(se2.wrap(c.delta[2] - both.delta[2])) < 1e-12
    np.testing.assert_allclose(c.cov, both.cov, atol=1e-12)
    np.testing.assert_allclose(c.bias_gain, both.bias_gain, atol=1e-12)
    np.testing.assert_allclose(c.turn_gain, both.turn_gain, atol=1e-12)
    np.testing.assert_allclose(c.drift_gain, both.drift_gain, atol=1e-12)


def test_composition_weighs_what_its_parts_say_of_the_bias():
    buffer = filled(line(1.0, 0.5), imu=lambda t: 0.6 + 0.1 * t)
    a, b, c = T0 + SECOND, T0 + 1400 * MS, T0 + 3 * SECOND
    whole = buffer.motion(a, c)
    parts = compose_motion(buffer.motion(a, b), buffer.motion(b, c))
    assert parts.bias == pytest.approx(whole.bias, rel=1e-9)
    assert parts.bias_var == pytest.approx(whole.bias_var, rel=1e-9)
    assert parts.bias_turn == pytest.approx(whole.bias_turn, rel=1e-9)
    assert parts.bias_way == pytest.approx(whole.bias_way, rel=1e-9)
    silent = Motion(np.zeros(3), np.zeros((3, 3)))
    assert compose_motion(silent, silent).bias_var == math.inf


def test_standing_still_is_the_identity_of_composition():
    m = Motion(
        np.array([1.0, 0.2, 0.3]), np.diag([1.0, 2.0, 3.0]), True, np.arange(3.0), 0.01, 1e-4,
        np.array([0.1, -0.2, 0.3]), 0.4, np.array([0.2, 0.1, -0.3]), 0.6,
    )  # fmt: skip
    for c in (compose_motion(STILL, m), compose_motion(m, STILL)):
        np.testing.assert_allclose(c.delta, m.delta)
        np.testing.assert_allclose(c.cov, m.cov)
        np.testing.assert_allclose(c.bias_gain, m.bias_gain)
        assert c.bias == pytest.approx(m.bias)
        assert c.bias_var == pytest.approx(m.bias_var)
        np.testing.assert_allclose(c.turn_gain, m.turn_gain)
        assert c.bias_turn == pytest.approx(m.bias_turn)
        np.testing.assert_allclose(c.drift_gain, m.drift_gain)
        assert c.bias_way == pytest.approx(m.bias_way)
    unknown = Motion(np.zeros(3), np.eye(3), known=False)
    assert not compose_motion(m, unknown).known
    assert not compose_motion(unknown, m).known


# --- odometry ----------------------------------------------------------------------------------


# the midpoint chord differs from the path by O((w dt)^2): 1e-5 at 50 Hz, 100 times that at 5 Hz
@pytest.mark.parametrize(('rate', 'tolerance'), [(5, 5e-3), (20, 4e-4), (100, 2e-5)])
def test_motion_follows_the_odometry_at_any_rate(rate, tolerance):
    buffer = filled(rate=rate)
    for start, end in [(0.0, 4.0), (0.4, 3.2), (1.0, 1.2)]:
        m = buffer.motion(T0 + round(start * SECOND), T0 + round(end * SECOND))
        expected = se2.between(path(start), path(end))
        # a robot on wheels: the sideways part of the path is not in (v, omega)
        assert np.abs(m.delta - expected)[2] < tolerance
        assert m.known
    arc = filled(line(0.9, 0.8), rate=rate)
    m = arc.motion(T0 + 333 * MS, T0 + 2777 * MS)
    np.testing.assert_allclose(m.delta, line(0.9, 0.8)(2.444), atol=tolerance)


@pytest.mark.parametrize('place', [(1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.3, -0.2, np.pi / 2)])
def test_motion_is_that_of_any_point_of_the_robot(place):
    """A base that is not on the axle, or is turned, moves sideways; so do robots with mecanum."""
    at, spin = np.array(place), se2.exp
    drive = {'pose_at': lambda t: spin(np.array([0.4 * t, 0.0, 0.5 * t])), 'duration': 8.0}
    times = T0 + 5 * SECOND, T0 + 7 * SECOND  # it has turned before
    axle = filled(**drive).motion(*times)
    buffer = filled(lambda t: se2.compose(drive['pose_at'](t), at), duration=8.0)
    wanted = se2.between(at, se2.compose(axle.delta, at))
    np.testing.assert_allclose(buffer.motion(*times).delta, wanted, atol=1e-4)


def test_noise_is_along_the_way_whatever_that_is():
    times = T0 + 3 * SECOND, T0 + 4 * SECOND
    forward = filled(line(0.5)).motion(*times)
    aside = filled(lambda t: np.array([0.0, 0.5 * t, 0.0])).motion(*times)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(aside.delta, turn @ forward.delta, atol=1e-9)
    np.testing.assert_allclose(aside.cov, turn @ forward.cov @ turn.T, rtol=1e-9, atol=1e-15)


def test_rounding_is_no_sideways_motion():
    """A robot that cannot move sideways is as it was before: exactly."""
    rng = np.random.default_rng(3)
    wheels = filled(lambda t: np.round(line(0.5, 0.3)(t) + 2e-4 * rng.standard_normal(3), 3))
    assert wheels._noise_values.moves_sideways == 0.0


def test_covariance_does_not_depend_on_the_rates():
    covs = [
        filled(line(0.9, 0.5), rate=rate).motion(T0 + 500 * MS, T0 + 3500 * MS).cov
        for rate in (10, 50, 200)
    ]
    # the chords of a coarser rate lie a little elsewhere
    for cov in covs[1:]:
        np.testing.assert_allclose(cov, covs[0], rtol=0.01, atol=1e-6)


@pytest.mark.parametrize(('v', 'w'), [(0.9, 0.5), (-0.9, 0.5), (0.9, -0.5), (0.0, 0.4)])
def test_variances_are_those_of_equation_6(v, w):
    n = NOISE
    duration = n.noise_interval
    m = filled(line(v, w)).motion(T0 + SECOND, T0 + SECOND + round(duration * SECOND))
    # driving backwards does not cancel the noise floor
    sigma_w = n.turn_noise * abs(w) + n.turn_noise_floor
    assert m.cov[2, 2] == pytest.approx((sigma_w * duration) ** 2, rel=1e-9)
    sigma_v, lateral = n.speed_noise * abs(v) + n.speed_noise_floor, n.lateral_noise * abs(v)
    # the turn and the heading's noise mix a little of one into the other
    swing = abs(v) * duration * (sigma_w * duration)
    assert m.cov[0, 0] == pytest.approx((sigma_v * duration) ** 2, rel=0.01)
    assert m.cov[1, 1] == pytest.approx((lateral * duration) ** 2, abs=1.1 * swing**2 + 1e-7)


def test_standing_robot_stays_where_it_is_almost_surely():
    m = filled(lambda t: np.array([3.0, 4.0, 1.0])).motion(T0, T0 + SECOND)
    np.testing.assert_array_equal(m.delta, 0.0)
    moving = filled(line(0.01)).motion(T0, T0 + SECOND)
    assert (np.diag(m.cov)[[0, 2]] < 0.001 * np.diag(moving.cov)[[0, 2]]).all()


def test_intervals_compose():
    buffer = filled(line(0.9, 0.6), imu=lambda t: 0.61)
    a, b, c = T0 + 210 * MS, T0 + 1003 * MS, T0 + 2777 * MS
    whole = buffer.motion(a, c)
    parts = compose_motion(buffer.motion(a, b), buffer.motion(b, c))
    np.testing.assert_allclose(parts.delta, whole.delta, atol=1e-6)
    np.testing.assert_allclose(parts.cov, whole.cov, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(parts.bias_gain, whole.bias_gain, atol=1e-5)


def test_no_time_is_no_motion():
    buffer = filled()
    for end in (T0 + SECOND, T0):
        m = buffer.motion(T0 + SECOND, end)
        np.testing.assert_array_equal(m.delta, 0.0)
        np.testing.assert_array_equal(m.cov, 0.0)


def test_pose_at_interpolates_and_ends_where_odometry_ends():
    buffer = filled(line(0.9, 0.8))
    for t in (0.0, 0.02, 1.234, 4.0):
        pose = buffer.pose_at(T0 + round(t * SECOND))
        np.testing.assert_allclose(pose, line(0.9, 0.8)(t), atol=1e-9)
    assert buffer.pose_at(T0 - 1) is None
    assert buffer.pose_at(T0 + 4 * SECOND + 1) is None
    assert buffer.covers(T0)
    assert not buffer.covers(T0 + 5 * SECOND)


# --- IMU ---------------------------------------------------------------------------------------


def test_turn_rate_is_the_imus_where_there_is_one():
    buffer = filled(line(1.0, 0.5), imu=lambda t: 0.7)
    m = buffer.motion(T0 + SECOND, T0 + 2 * SECOND)
    np.testing.assert_allclose(m.delta, line(1.0, 0.7)(1.0), atol=1e-4)
    sigma = NOISE.imu_turn_noise * 0.7 + NOISE.imu_turn_noise_floor
    assert m.cov[2, 2] == pytest.approx(sigma**2 * NOISE.noise_interval * 1.0, rel=1e-6)
    assert m.bias_gain[2] == pytest.approx(-1.0)
    np.testing.assert_array_equal(m.turn_gain, 0.0)
    np.testing.assert_array_equal(m.drift_gain, 0.0)
    assert m.bias_way == pytest.approx(1.0, rel=1e-6)
    # the difference of wheels and IMU is the bias, with the variance of both
    assert m.bias == pytest.approx(0.2, rel=1e-6)
    assert m.bias_turn == pytest.approx(0.7, rel=1e-6)
    wheels = NOISE.turn_noise * 0.5 + NOISE.turn_noise_floor
    assert m.bias_var == pytest.approx((sigma**2 + wheels**2) * NOISE.noise_interval, rel=1e-6)


def test_without_an_imu_nothing_is_said_of_its_bias():
    m = filled(line(1.0, 0.5)).motion(T0, T0 + SECOND)
    np.testing.assert_array_equal(m.bias_gain, 0.0)
    assert m.bias_var == math.inf


def test_standing_wheels_show_the_bias_and_the_robot_does_not_turn():
    m = filled(lambda t: np.zeros(3), imu=lambda t: 0.03).motion(T0 + SECOND, T0 + 2 * SECOND)
    np.testing.assert_array_equal(m.delta, 0.0)
    np.testing.assert_array_equal(m.bias_gain, 0.0)
    assert m.bias == pytest.approx(0.03)
    assert m.bias_turn == 0.0
    assert m.bias_var < 1e-4


def test_turn_in_a_short_gap_is_the_wheels_and_not_that_between_two_rates():
    buffer = filled(line(1.0, 0.3), duration=1.0, imu=lambda t: 0.3)
    buffer.add_imu(Imu(T0 + 2 * SECOND, -9.0))  # one wrong rate, 1 s after the last
    buffer.add_odometry(Odometry(T0 + 2 * SECOND, line(1.0, 0.3)(2.0)))
    m = buffer.motion(T0 + SECOND, T0 + 2 * SECOND)
    np.testing.assert_allclose(m.delta[2], 0.3, atol=1e-6)


def test_slow_imu_is_used_where_there_are_no_wheels():
    buffer = MotionBuffer(NOISE, 60.0)
    for k in range(6):
        buffer.add_imu(Imu(T0 + k * SECOND, 0.3))
    m = buffer.motion(T0 + SECOND, T0 + 3 * SECOND)
    assert m.delta[2] == pytest.approx(0.6)


def test_gap_of_the_imu_is_bridged_by_the_wheels():
    buffer = filled(line(1.0, 0.5), duration=10.0)
    for t in (0.0, 1.0, 9.0, 9.5):
        buffer.add_imu(Imu(T0 + round(t * SECOND), 0.7))
    m = buffer.motion(T0 + 2 * SECOND, T0 + 3 * SECOND)
    assert m.delta[2] == pytest.approx(0.5)
    assert m.bias_gain[2] == 0.0
    assert m.turn_gain[2] == pytest.approx(0.5)
    assert m.drift_gain[2] == pytest.approx(1.0)


# --- gaps, jumps, ends -------------------------------------------------------------------------


def with_gap(gap):
    buffer = filled(line(1.0), duration=2.0)
    after = T0 + 2 * SECOND + round(gap * SECOND)
    for k in range(50):
        t = 2.0 + gap + k / 50
        buffer.add_odometry(Odometry(after + k * 20 * MS, line(1.0)(t)))
    return buffer


@pytest.mark.parametrize(('gap', 'known'), [(20.0, False), (1.0, True)])
def test_odometry_that_is_at_zero_after_a_long_gap_began_again(gap, known):
    """The driver was started again; in a short time, no robot is back at zero by chance."""
    buffer = filled(line(0.5, 0.1), duration=4.0)
    end = T0 + round((4.0 + gap) * SECOND)
    for k in range(5):
        buffer.add_odometry(Odometry(end + k * 20 * MS, line(0.5)(k / 50)))
    assert buffer.motion(T0 + 3 * SECOND, end).known is known


def test_short_gap_is_interpolated_with_a_guess_of_when():
    m = with_gap(1.0).motion(T0 + SECOND, T0 + round(3.5 * SECOND))
    assert m.known
    np.testing.assert_allclose(m.delta, [2.5, 0.0, 0.0], atol=1e-9)
    whole = filled(line(1.0)).motion(T0 + SECOND, T0 + round(3.5 * SECOND))
    assert m.cov[0, 0] > 2.0 * whole.cov[0, 0]


def test_pose_after_a_long_gap_says_where_it_led_to():
    """Turned on the spot and went on in the gap: no arc, and all messages of it were lost."""
    gap, after = NOISE.max_gap + 1.0, np.array([2.0, 3.0, 1.5])
    buffer = filled(line(1.0), duration=2.0)
    for k in range(50):
        pose = se2.compose(after, line(1.0)(k / 50))
        buffer.add_odometry(Odometry(T0 + round((2.0 + gap + k / 50) * SECOND), pose))
    buffer.add_imu(Imu(T0 + 3 * SECOND, 0.4))  # says nothing of where
    m = buffer.motion(T0 + SECOND, T0 + round((2.0 + gap) * SECOND))
    assert m.known
    np.testing.assert_allclose(m.delta, [1.0, 3.0, 1.5], atol=1e-9)
    whole = filled(line(1.0), duration=10.0).motion(T0 + SECOND, T0 + round(4.0 * SECOND))
    assert np.trace(m.cov) > 4.0 * np.trace(whole.cov)


def test_robot_that_stood_through_most_of_a_gap_is_as_certain_as_its_way_is_short():
    def after(gap, way):
        buffer = filled(lambda t: np.zeros(3), duration=2.0)
        end = T0 + round((2.0 + gap) * SECOND)
        for k in range(5):
            buffer.add_odometry(Odometry(end + k * 20 * MS, np.array([way, 0.0, 0.0])))
        return buffer.motion(T0 + 2 * SECOND, end)

    # 0.2 m is a way of 4 s at most, however long the robot was not heard of
    short, long = after(20.0, 0.2), after(200.0, 0.2)
    np.testing.assert_allclose(long.cov, short.cov, rtol=0.05)
    assert math.sqrt(long.cov[2, 2]) < 0.04
    # on the way for all of the gap
    assert after(20.0, 10.0).cov[2, 2] > 3.0 * short.cov[2, 2]


def test_turn_just_before_a_long_gap_is_not_that_of_all_of_it():
    """What counts is the mean of the last seconds: nobody turns so fast for half a minute."""

    def after(rate):
        """Heading sigma after a gap, into which a robot drove with a turn of the last .1 s."""
        buffer = MotionBuffer(NOISE, 60.0)
        for k in range(151):
            turn = rate * max(k / 50 - 2.9, 0.0)
            buffer.add_odometry(Odometry(T0 + k * 20 * MS, np.array([k / 50, 0.0, turn])))
        end = T0 + 33 * SECOND
        for k in range(5):
            buffer.add_odometry(Odometry(end + k * 20 * MS, np.array([15.0 + k / 50, 0.0, 0.0])))
        return math.sqrt(buffer.motion(T0 + 3 * SECOND, end).cov[2, 2])

    assert after(1.5) < 1.5 * after(0.0)


def test_pose_after_a_gap_longer_than_the_memory_says_where_it_led_to():
    buffer = filled(line(1.0), rate=100, duration=10.0, memory=2.0)
    for k in range(5):
        buffer.add_odometry(Odometry(T0 + (40 + k) * SECOND, line(1.0)(12.0 + k)))
    m = buffer.motion(T0 + 9 * SECOND, T0 + 40 * SECOND)
    assert m.known
    np.testing.assert_allclose(m.delta, [3.0, 0.0, 0.0], atol=1e-9)


def test_robot_that_is_back_after_a_gap_may_have_driven_as_before():
    gap = 2.0
    buffer = filled(line(1.0, 0.5), duration=2.0)
    for k in range(5):  # it turns on, and where it came to is nearly where it was
        pose = se2.compose(line(1.0, 0.5)(2.1), line(1.0)(k / 50))
        buffer.add_odometry(Odometry(T0 + round((2.0 + gap + k / 50) * SECOND), pose))
    m = buffer.motion(T0 + SECOND, T0 + round((2.0 + gap) * SECOND))
    np.testing.assert_allclose(m.delta, line(1.0, 0.5)(1.1), atol=1e-4)
    driven = (NOISE.speed_noise + NOISE.long_interval_noise) * 1.0
    assert math.sqrt(m.cov[0, 0]) > 0.7 * driven * math.sqrt(gap * NOISE.noise_interval)


def test_burst_of_stamps_before_an_interval_is_no_speed():
    """A driver that sends two samples 1 ms apart: the robot has not driven at 50 m/s."""
    sigmas = []
    for burst in (0.1, 0.001):
        buffer, stamp = filled(line(0.5), duration=1.0), T0 + SECOND
        for dt in (burst, 0.45):
            stamp += round(dt * SECOND)
            buffer.add_odometry(
                Odometry(stamp, se2.compose(buffer.pose_at(buffer.newest), [0.05, 0.0, 0.01]))
            )
        sigmas.append(np.sqrt(np.diag(buffer.motion(stamp - round(0.45 * SECOND), stamp).cov)))
    assert (sigmas[1] < 2.0 * sigmas[0]).all()


def test_motion_in_a_part_of_a_long_gap_is_unknown_and_wide():
    gap = NOISE.max_gap + 1.0
    m = with_gap(gap + 0.5).motion(T0 + 2 * SECOND, T0 + round((2.0 + gap) * SECOND))
    assert not m.known
    np.testing.assert_array_equal(m.delta, 0.0)
    # a speed that lasts, and a turn rate that is independent in each interval: after so long, no
    # heading is left to be known either way
    expected = (np.array([NOISE.max_speed, NOISE.max_speed, NOISE.max_turn_rate]) / 5.0) ** 2
    lasted = np.array([gap, gap, NOISE.noise_interval])
    np.testing.assert_allclose(np.diag(m.cov), expected * gap * lasted, rtol=1e-6)
    longer = with_gap(gap).motion(T0 + 3 * SECOND, T0 + round((2.5 + gap) * SECOND))
    assert not longer.known


@pytest.mark.parametrize('early', [0.02, 0.15])
def test_scan_just_before_a_long_gap_ends_is_where_the_odometry_is_then(early):
    """The first message after a gap is a scan: odometry tells where it is a moment later."""
    gap = NOISE.max_gap + 1.0
    buffer, end = with_gap(gap), T0 + round((2.0 + gap) * SECOND)
    seen = end - round(early * SECOND)
    m, rest = buffer.motion(T0 + SECOND, seen), buffer.motion(seen, end)
    assert m.known
    assert rest.known
    np.testing.assert_allclose(m.delta, [1.0 + gap - early, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(rest.delta, [early, 0.0, 0.0], atol=1e-6)
    for part in (m, rest):  # it may have turned, stopped or hurried in that moment
        more = np.sqrt(np.diag(part.cov)) / early
        assert (
            more > np.array([NOISE.max_speed, NOISE.max_speed, NOISE.max_turn_rate]) / 5.01
        ).all()
    assert (np.sqrt(np.diag(m.cov)) < [0.3, 0.3, 0.7]).all()


def test_parts_of_a_gap_add_up_to_the_whole():
    gap = NOISE.max_gap + 1.0
    ends = T0 + 2 * SECOND + np.rint(np.linspace(0.0, gap, 8) * SECOND).astype(np.int64)
    buffer = with_gap(gap + 0.5)
    whole = buffer.motion(int(ends[0]), int(ends[-1])).cov
    parts = [buffer.motion(a, b).cov for a, b in itertools.pairwise(ends.tolist())]
    np.testing.assert_allclose(sum(np.diag(cov) for cov in parts), np.diag(whole), rtol=1e-6)


def test_one_sample_that_jumps_away_is_dropped():
    buffer = filled(line(1.0), duration=1.0)
    assert not buffer.add_odometry(Odometry(T0 + 1020 * MS, np.array([500.0, 3.0, 1.0])))
    for k in range(2, 50):
        buffer.add_odometry(Odometry(T0 + 1000 * MS + k * 20 * MS, line(1.0)(1.0 + k / 50)))
    m = buffer.motion(T0 + 500 * MS, T0 + 1500 * MS)
    assert m.known
    np.testing.assert_allclose(m.delta, [1.0, 0.0, 0.0], atol=1e-9)


def test_reset_odometry_is_followed_and_the_motion_across_unknown():
    buffer = filled(line(1.0), duration=1.0)
    far = np.array([500.0, 3.0, 1.0])
    for k in range(1, 50):
        pose = se2.compose(far, line(1.0)(k / 50))
        buffer.add_odometry(Odometry(T0 + 1000 * MS + k * 20 * MS, pose))
    across = buffer.motion(T0 + 900 * MS, T0 + 1200 * MS)
    assert not across.known
    assert np.hypot(*across.delta[:2]) < 0.4
    after = buffer.motion(T0 + 1200 * MS, T0 + 1700 * MS)
    assert after.known
    np.testing.assert_allclose(after.delta, [0.5, 0.0, 0.0], atol=1e-9)


def test_burst_of_stamps_is_no_jump():
    buffer = filled(line(1.0), duration=1.0)
    # 2 cm later by path, 50 us by stamp: a driver that sends what it held back
    assert buffer.add_odometry(Odometry(T0 + SECOND + MS // 20, line(1.0)(1.02)))
    m = buffer.motion(T0 + 500 * MS, T0 + SECOND + MS // 20)
    assert m.delta[0] == pytest.approx(0.52)
    assert math.sqrt(m.cov[0, 0]) < 0.2


def test_end_of_odometry_is_extrapolated_for_a_moment_only():
    buffer = filled(line(1.0, 0.5), duration=2.0)
    end = T0 + 2 * SECOND
    m = buffer.extrapolate(end - SECOND, end + 100 * MS)
    assert not m.known
    np.testing.assert_allclose(m.delta, line(1.0, 0.5)(1.1), atol=1e-4)
    covered = buffer.motion(end - SECOND, end)
    assert (np.diag(m.cov) > np.diag(covered.cov)).all()
    # what it does after that nobody knows: it counts as standing, within a wide covariance
    m = buffer.extrapolate(end - SECOND, end + SECOND)
    np.testing.assert_allclose(m.delta, line(1.0, 0.5)(1.0 + COAST), atol=1e-4)
    assert math.sqrt(np.linalg.eigvalsh(m.cov[:2, :2])[-1]) > NOISE.max_speed / 5.0


@pytest.mark.parametrize('speed', [0.0, 1.0])
def test_first_speed_holds_a_moment_before_the_odometry_begins(speed):
    moment = round(0.5 * NOISE.noise_interval * SECOND)
    buffer = filled(line(speed, 0.5 * speed), duration=2.0)
    m = buffer.motion(T0 - moment, T0 + moment)
    assert m.known
    np.testing.assert_allclose(m.delta, line(speed, 0.5 * speed)(NOISE.noise_interval), atol=1e-4)
    later = buffer.motion(T0, T0 + 2 * moment)
    np.testing.assert_allclose(m.cov, later.cov, rtol=1e-2, atol=1e-7)
    # how it went long before nobody knows: it counts as standing, within a wide covariance
    m = buffer.motion(T0 - SECOND, T0)
    assert not m.known
    np.testing.assert_array_equal(m.delta, 0.0)
    assert math.sqrt(m.cov[0, 0]) > 0.05 * NOISE.max_speed


def test_without_any_odometry_motion_is_unknown():
    buffer = MotionBuffer(NOISE, 10.0)
    assert buffer.newest is None
    for m in (buffer.motion(T0, T0 + SECOND), buffer.extrapolate(T0, T0 + SECOND)):
        assert not m.known
        np.testing.assert_array_equal(m.delta, 0.0)
        assert np.linalg.eigvalsh(m.cov).min() > 0.01


def test_old_samples_are_forgotten():
    buffer = filled(line(1.0), rate=100, duration=20.0, memory=2.0)
    assert not buffer.covers(T0 + 10 * SECOND)
    assert buffer.covers(T0 + 18 * SECOND)
    m = buffer.motion(T0 + 18 * SECOND, T0 + 20 * SECOND)
    assert m.known
    np.testing.assert_allclose(m.delta, [2.0, 0.0, 0.0], atol=1e-9)


# --- eq. 61 ------------------------------------------------------------------------------------


def test_covariance_of_a_gap_is_that_of_ways_that_nobody_saw():
    """Robots that turn now and then; odometry's error of the turn leads them aside (eq. 61)."""
    rng, gap, dt = np.random.default_rng(3), 20.0, NOISE.noise_interval
    n, distances = round(gap / dt), []
    for _ in range(150):
        v = np.full(n, 0.5)
        w = np.repeat(rng.uniform(-0.8, 0.8, n // 20), 20)
        errors = rng.normal(size=(2, n))
        v_odom = v + (NOISE.speed_noise * v + NOISE.speed_noise_floor) * errors[0]
        w_odom = w + (NOISE.turn_noise * np.abs(w) + NOISE.turn_noise_floor) * errors[1]
        true, measured = (
            chained(a, b, np.full(n, dt), np.zeros(n))[0] for a, b in ((v, w), (v_odom, w_odom))
        )
        before = line(0.5, 0.4)
        buffer = filled(before, duration=2.0)
        end = T0 + round((2.0 + gap) * SECOND)
        buffer.add_odometry(Odometry(end, se2.compose(before(2.0), measured)))
        m = buffer.motion(T0 + 2 * SECOND, end)
        error, cov = se2.between(m.delta, true), m.cov[:2, :2]
        place = error[:2] @ np.linalg.solve(cov, error[:2])
        distances.append([place, error[2] ** 2 / m.cov[2, 2]])
    place, heading = np.mean(distances, axis=0)
    assert 0.3 < place < 3.0  # 2 is consistent, more is too sure
    assert 0.2 < heading < 1.5
