# SPDX-License-Identifier: Apache-2.0
"""The filter's three steps against textbook matrices; the postponed update against the plain."""

import numpy as np
import pytest
from differences import central_differences

from rlml_slam import se2
from rlml_slam.ekf.filter import BIAS, JOINED, ROBOT, SPEED, TURN, WHEELS, Filter
from rlml_slam.estimation.landmark_models import POINT, line_model
from rlml_slam.types import Motion

POSE, COV = np.array([0.2, -0.1, 0.3]), np.diag([0.01, 0.02, 0.005])
R = np.diag([0.02**2, 0.01**2])
Q = np.array([[4e-4, 1e-5, 2e-5], [1e-5, 1e-4, -1e-5], [2e-5, -1e-5, 9e-5]])


def small(seed=0, n=4):
    rng = np.random.default_rng(seed)
    f = Filter(POSE, COV, 0.02, POINT)
    for _ in range(n):
        f.augment(np.array([rng.uniform(1.0, 6.0), rng.uniform(-3.0, 3.0)]), R)
    f.predict(Motion(np.array([0.4, 0.02, 0.1]), Q))
    return f, rng


def is_covariance(P):
    return np.array_equal(P, P.T) and np.linalg.eigvalsh(P)[0] > -1e-14


def test_predict_is_the_full_matrix_equation_with_numeric_jacobians():
    f, _ = small()
    x, P = f.x.copy(), f.P.copy()
    motion = Motion(np.array([0.5, -0.03, 0.2]), Q, bias_gain=np.array([0.01, 0.02, -0.1]))
    move = lambda s, u: se2.compose(s[:3], u + motion.bias_gain * s[3])  # noqa: E731
    n = len(x)
    A, B = np.eye(n), np.zeros((n, 3))
    A[:3] = central_differences(lambda s: move(s, motion.delta), x, angles=(2,))
    B[:3] = central_differences(lambda u: move(x, u), motion.delta, angles=(2,))
    f.predict(motion)
    assert np.allclose(f.x[:3], move(x, motion.delta), atol=1e-14)
    assert np.abs(f.P - (A @ P @ A.T + B @ Q @ B.T)).max() < 1e-9
    assert is_covariance(f.P)


def test_wheels_that_err_are_moved_by_with_numeric_jacobians():
    rng = np.random.default_rng(3)
    f = Filter(POSE, COV, 0.02, POINT, wheels=(0.1, 0.2))
    for _ in range(4):
        f.augment(np.array([rng.uniform(1.0, 6.0), rng.uniform(-3.0, 3.0)]), R)
    motion = Motion(
        np.array([0.5, -0.03, 0.2]), Q, bias_gain=np.array([0.01, 0.02, -0.1]),
        turn_gain=np.array([0.02, 0.2, 0.1]),
    )  # fmt: skip
    f.predict(motion, 0.0, 0.9)
    f.x[BIAS:ROBOT] = 0.01, 0.08, -0.15
    x, P = f.x.copy(), f.P.copy()

    def move(s, u):
        delta = u + motion.bias_gain * s[BIAS] + motion.turn_gain * s[TURN]
        delta[:2] *= 1.0 + s[SPEED]
        return se2.compose(s[:3], delta)

    n, kept = len(x), 0.7
    A, Qs = np.eye(n), np.zeros((n, n))
    A[:3] = central_differences(lambda s: move(s, motion.delta), x, angles=(2,))
    A[WHEELS, WHEELS] *= kept
    turned = se2.compose_jacobians(x[:3], motion.delta)[1]
    Qs[:3, :3] = turned @ Q @ turned.T
    Qs[WHEELS, WHEELS] = (1.0 - kept**2) * np.diag([0.1, 0.2]) ** 2
    f.predict(motion, 0.0, kept)
    assert np.allclose(f.x[:3], move(x, motion.delta), atol=1e-14)
    assert np.allclose(f.x[WHEELS], kept * x[WHEELS], atol=1e-15)
    assert np.abs(f.P - (A @ P @ A.T + Qs)).max() < 1e-9
    assert is_covariance(f.P)


def test_wheels_that_do_not_err_are_the_filter_without_them():
    plain, _ = small()
    gain = np.array([0.02, 0.2, 0.1])
    plain.predict(Motion(np.array([0.5, -0.03, 0.2]), Q, turn_gain=gain), 0.0, 0.5)
    other, _ = small()
    other.predict(Motion(np.array([0.5, -0.03, 0.2]), Q))
    for f in (plain, other):
        f.update(1, f.model.observe(f.x[:3], f.points)[0][1] + 0.01, R)
    assert np.array_equal(plain.x, other.x)
    assert np.array_equal(plain.P, other.P)
    assert not plain.P[WHEELS].any()


def test_update_is_the_joseph_form_with_numeric_jacobians():
    f, _ = small()
    x, P = f.x.copy(), f.P.copy()
    h = lambda s: POINT.observe(s[:3], s[None, ROBOT + 4 : ROBOT + 6])[0][0]  # noqa: E731
    H = central_differences(h, x, angles=(1,))
    z = h(x) + np.array([0.03, -0.02])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    I_KH = np.eye(len(x)) - K @ H
    f.update(2, z, R)
    assert np.abs(f.x - (x + K @ (z - h(x)))).max() < 1e-8
    assert np.abs(f.P - (I_KH @ P @ I_KH.T + K @ R @ K.T)).max() < 1e-9
    assert is_covariance(f.P)


def test_augment_is_the_full_matrix_equation_with_numeric_jacobians():
    f, _ = small()
    x, P, z = f.x.copy(), f.P.copy(), np.array([2.0, -0.7])
    place = lambda s, q: POINT.place(s[:3], q[None])[0][0]  # noqa: E731
    n = len(x)
    G = np.vstack([np.eye(n), central_differences(lambda s: place(s, z), x)])
    J_z = central_differences(lambda q: place(x, q), z)
    expected = G @ P @ G.T
    expected[n:, n:] += J_z @ R @ J_z.T
    f.augment(z, R)
    assert np.abs(f.P - expected).max() < 1e-9
    assert is_covariance(f.P)


def near(f, radius):
    f.settle()
    return np.hypot(*(f.points - f.x[:2]).T) < radius


def near_now(f, radius):
    return f.local[np.hypot(*(f.points - f.x[:2]).T) < radius]


@pytest.mark.parametrize(('wheels', 'steps'), [((0.0, 0.0), 200), ((0.03, 0.05), 100)])
@pytest.mark.parametrize('invariant', [False, True])
def test_postponed_update_equals_the_plain_filter(invariant, wheels, steps):
    plain = Filter(POSE, COV, 0.02, POINT, invariant, wheels)
    rng = np.random.default_rng(5)
    delta = np.array([0.3, 0.0, 0.05])
    motions = [
        Motion(delta + 0.01 * rng.standard_normal(3), Q, turn_gain=delta * [0.0, 0.0, 1.0])
        for _ in range(200)
    ]
    noise = 0.01 * rng.standard_normal((200, 50, 2))
    new = np.stack([rng.uniform(0.5, 2.5, 200), rng.uniform(-3.0, 3.0, 200)], -1)
    postponed = Filter(POSE, COV, 0.02, POINT, invariant, wheels)
    shares = []
    for k, motion in enumerate(motions[:steps]):
        for f in (plain, postponed):
            f.predict(motion, 0.0, 0.99)
        if k % 10 == 0:
            postponed.choose(near(postponed, 7.0))
        if k % 4 == 0:
            for f in (plain, postponed):
                f.augment(new[k], R)
        seen = near_now(plain, 3.0)
        shares.append(len(postponed.local) / len(plain.local))
        for i, number in enumerate(seen):
            z = POINT.observe(plain.x[:3], plain.points[number][None])[0][0] + noise[k, i]
            plain.update(int(number), z, R)
            postponed.update(int(np.flatnonzero(postponed.local == number)[0]), z, R)
    # the region did leave landmarks out
    assert min(shares) < 0.75
    postponed.settle()
    # rounding of some thousand updates
    assert np.abs(postponed.x - plain.x).max() < 1e-9
    assert np.abs(postponed.P - plain.P).max() < 1e-10
    assert is_covariance(plain.P)


def test_a_region_that_holds_all_again_is_plain():
    f, _ = small()
    f.choose(np.array([True, False, True, True]))
    f.update(0, f.model.observe(f.x[:3], f.points)[0][0] + 0.01, R)
    f.choose(np.ones(4, dtype=np.bool_))
    f.update(1, f.model.observe(f.x[:3], f.points)[0][1] + 0.01, R)
    assert len(f.local) == 4
    assert is_covariance(f.P)


def test_a_line_does_not_tell_the_place_along_it():
    f = Filter(np.zeros(3), np.diag([0.04, 0.04, 1e-6]), 0.0, line_model(np.zeros(2)))
    f.fix(np.array([0.0, 2.0]), 1e-12 * np.eye(2))
    f.update(0, np.array([2.0, 0.5 * np.pi]), np.diag([1e-4, 1e-4]))
    assert f.P[0, 0] == pytest.approx(0.04, rel=1e-6)
    assert f.P[1, 1] < 2e-4


def test_an_invariant_filter_learns_no_heading_from_landmarks_it_does_not_know():
    """Turning the map about the origin changes no measurement, wherever the estimate went."""
    rng = np.random.default_rng(2)
    gained = {}
    for invariant in (False, True):
        f = Filter(np.zeros(3), np.diag([1e-6, 1e-6, 0.5**2]), 0.1, POINT, invariant)
        for bearing in (-1.0, 0.2, 1.3):
            f.augment(np.array([4.0, bearing]), 25.0 * R)
        before = f.P[2, 2]
        for k in range(60):
            f.predict(Motion(np.array([0.1, 0.0, 0.3]), np.diag([1e-3, 1e-3, 0.02])))
            slot = k % 3
            z = POINT.observe(f.x[:3], f.points[slot][None])[0][0]
            f.update(slot, z + 5.0 * np.sqrt(np.diag(R)) * rng.standard_normal(2), 25.0 * R)
        # the heading of the whole: the direction in state space that no measurement sees
        turn = np.zeros(len(f.x))
        turn[2] = 1.0
        for k in (0, *range(ROBOT, len(f.x), 2)):
            turn[k], turn[k + 1] = -f.x[k + 1], f.x[k]
        varies = np.delete(np.arange(len(f.x)), [SPEED, TURN])  # these wheels do not err
        P, turn = f.P[np.ix_(varies, varies)], turn[varies]
        gained[invariant] = 1.0 / (turn @ np.linalg.solve(P, turn)) / before
    # what the robot forgets on its way is less than a hundredth of it
    assert gained[True] == pytest.approx(1.0, abs=1e-2)
    assert gained[False] < 0.7


def test_small_corrections_are_the_same_in_both_errors():
    corrections = []
    for invariant in (False, True):
        f = Filter(POSE, 1e-8 * COV, 0.0, POINT, invariant)
        f.augment(np.array([3.0, 0.4]), 1e-8 * R)
        x = f.x.copy()
        z = POINT.observe(x[:3], f.points)[0][0] + 1e-6
        f.update(0, z, 1e-8 * R)
        corrections.append(f.x - x)
    assert np.abs(corrections[0] - corrections[1]).max() < 1e-10
    assert np.abs(corrections[0]).max() > 1e-7


def test_join_is_the_state_on_condition_that_two_landmarks_are_one():
    f, _ = small()
    x, P = f.x.copy(), f.P.copy()
    a, b = ROBOT + 2 * 1, ROBOT + 2 * 3
    H = np.zeros((2, len(x)))
    H[:, a : a + 2], H[:, b : b + 2] = np.eye(2), -np.eye(2)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + JOINED**2 * np.eye(2))
    rest = np.arange(b)
    f.join(1, 3)
    assert f.num_landmarks == 3
    assert np.abs(f.x - (x - K @ H @ x)[rest]).max() < 1e-9
    assert np.abs(f.P - (P - K @ H @ P)[np.ix_(rest, rest)]).max() < 1e-9
    assert is_covariance(f.P)


def test_join_in_a_region_is_join_in_the_whole():
    plain, _ = small()
    postponed, _ = small()
    postponed.choose(np.array([True, True, False, True]))
    for f in (plain, postponed):
        f.update(0, f.model.observe(f.x[:3], f.points)[0][0] + 0.01, R)
        f.join(0, 2)
    assert np.abs(postponed.x - plain.x).max() < 1e-12
    assert np.abs(postponed.P - plain.P).max() < 1e-12
