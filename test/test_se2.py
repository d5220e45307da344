# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from differences import central_differences
from scipy.linalg import expm

from rlml_slam import se2

SHAPES = [(), (5,), (2, 3)]
# near zero and near pi is where formulas break
ANGLES = [0.0, 1e-12, -1e-8, 1e-4, 0.7, -2.0, np.pi - 1e-9, -np.pi + 1e-9, np.pi]


def poses(shape, seed=0):
    rng = np.random.default_rng(seed)
    p = rng.normal(0.0, 3.0, (*shape, 3))
    p[..., 2] = rng.uniform(-np.pi, np.pi, shape)
    return p


def matrix(T):
    M = np.eye(3)
    M[:2, :2], M[:2, 2] = se2.rotation(T[2]), T[:2]
    return M


def assert_same_pose(a, b, atol=1e-12):
    np.testing.assert_allclose(np.asarray(a)[..., :2], np.asarray(b)[..., :2], atol=atol)
    turn = se2.wrap(np.asarray(a)[..., 2] - np.asarray(b)[..., 2])
    np.testing.assert_allclose(turn, 0.0, atol=atol)


@pytest.mark.parametrize('turn', ANGLES)
def test_belief_goes_on_with_its_pose_and_turns_with_the_frame(turn):
    T_a_b, T_b_c = np.array([0.3, -1.2, turn]), np.array([2.0, 0.7, -2.9])
    half = np.random.default_rng(1).normal(size=(3, 3))
    pose, cov = se2.compose_belief(T_a_b, T_b_c, half @ half.T)
    assert_same_pose(pose, se2.compose(T_a_b, T_b_c))
    assert -np.pi < pose[2] <= np.pi
    R = np.eye(3)
    R[:2, :2] = se2.rotation(turn)
    np.testing.assert_allclose(cov, R @ half @ half.T @ R.T, atol=1e-12)


def hat(t):
    return np.array([[0.0, -t[2], t[0]], [t[2], 0.0, t[1]], [0.0, 0.0, 0.0]])


# --- group -------------------------------------------------------------------------------------


def test_angle_is_wrapped_to_half_open_interval():
    angles = np.linspace(-20.0, 20.0, 1001)
    w = se2.wrap(angles)
    assert (w > -np.pi).all()
    assert (w <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * w), np.exp(1j * angles), atol=1e-12)
    assert se2.wrap(np.pi) == np.pi
    assert se2.wrap(-np.pi) == np.pi
    assert np.isnan(se2.wrap([np.nan, np.inf])).all()


@pytest.mark.parametrize('turn', [*ANGLES, np.nan])
@pytest.mark.parametrize('f', [se2.inverse, se2.exp, se2.log])
def test_one_pose_is_like_one_of_many(f, turn):
    a = np.array([0.3, -1.2, turn])
    np.testing.assert_allclose(f(a), f(a[None])[0], atol=1e-14)


@pytest.mark.parametrize('turn', [*ANGLES, np.nan])
@pytest.mark.parametrize(
    'f', [se2.compose, se2.between, se2.compose_jacobians, se2.between_jacobians]
)
def test_one_pair_is_like_one_of_many(f, turn):
    a, b = np.array([0.3, -1.2, turn]), poses(())
    one, many = f(a, b), f(a[None], b[None])
    np.testing.assert_allclose(one, np.asarray(many).reshape(np.shape(one)), atol=1e-14)


@pytest.mark.parametrize('turn', [*ANGLES, np.nan])
def test_points_of_one_frame_are_like_those_of_many(turn):
    a, points = np.array([0.3, -1.2, turn]), poses((7,))[:, :2]
    np.testing.assert_allclose(se2.transform(a, points), se2.transform(a[None], points)[0])
    np.testing.assert_allclose(se2.rotation(turn), se2.rotation([turn])[0], atol=1e-16)


@pytest.mark.parametrize('shape', SHAPES)
def test_group_laws_hold_over_any_leading_shape(shape):
    a, b, c = (poses(shape, seed) for seed in (1, 2, 3))
    e = np.zeros(3)
    assert se2.compose(a, b).shape == (*shape, 3)
    assert_same_pose(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))
    for same in (se2.compose(a, e), se2.compose(e, a), se2.inverse(se2.inverse(a))):
        assert_same_pose(same, a)
    assert_same_pose(se2.compose(a, se2.inverse(a)), np.zeros((*shape, 3)))
    assert_same_pose(se2.between(a, b), se2.compose(se2.inverse(a), b))
    assert_same_pose(se2.compose(a, se2.between(a, b)), b)


def test_leading_shapes_broadcast():
    a, b = poses((4, 1)), poses((3,), 1)
    for function in (se2.compose, se2.between):
        out = function(a, b)
        assert out.shape == (4, 3, 3)
        for i in range(4):
            for j in range(3):
                assert_same_pose(out[i, j], function(a[i, 0], b[j]))


def test_composition_is_that_of_matrices():
    a, b = poses((), 1), poses((), 2)
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)
    np.testing.assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=1e-12)


@pytest.mark.parametrize('shape', SHAPES)
def test_transforming_points_is_a_group_action(shape):
    a, b = poses(shape, 1), poses(shape, 2)
    p = np.random.default_rng(3).normal(0.0, 3.0, (*shape, 7, 2))
    both = se2.transform(a, se2.transform(b, p))
    assert both.shape == (*shape, 7, 2)
    np.testing.assert_allclose(both, se2.transform(se2.compose(a, b), p), atol=1e-12)
    np.testing.assert_allclose(se2.transform(se2.inverse(a), se2.transform(a, p)), p, atol=1e-12)


def test_integers_are_taken_as_floats():
    assert se2.compose([1, 2, 0], [1, 0, 0]).dtype == np.float64
    np.testing.assert_array_equal(se2.compose([1, 2, 0], [1, 0, 0]), [2.0, 2.0, 0.0])


# --- exp and log -------------------------------------------------------------------------------


@pytest.mark.parametrize('w', ANGLES)
def test_exp_is_the_matrix_exponential(w):
    t = np.array([1.3, -0.4, w])
    np.testing.assert_allclose(matrix(se2.exp(t)), expm(hat(t)), atol=1e-12)


@pytest.mark.parametrize('w', ANGLES)
def test_log_undoes_exp(w):
    t = np.array([1.3, -0.4, w])
    np.testing.assert_allclose(se2.log(se2.exp(t)), t, atol=1e-11)
    T = np.array([0.2, 5.0, w])
    assert_same_pose(se2.exp(se2.log(T)), T, atol=1e-11)


@pytest.mark.parametrize('shape', SHAPES)
def test_exp_and_log_take_any_leading_shape(shape):
    T = poses(shape)
    assert se2.log(T).shape == (*shape, 3)
    assert_same_pose(se2.exp(se2.log(T)), T)


@pytest.mark.parametrize('w', ANGLES)
def test_adjoint_moves_twists_between_frames(w):
    T, t = np.array([1.0, -2.0, w]), np.array([0.3, 0.2, -0.5])
    left = se2.compose(T, se2.exp(t))
    right = se2.compose(se2.exp(se2.adjoint(T) @ t), T)
    assert_same_pose(left, right)


def test_adjoint_of_a_product_is_the_product():
    a, b = poses((4,), 1), poses((4,), 2)
    product = se2.adjoint(a) @ se2.adjoint(b)
    np.testing.assert_allclose(se2.adjoint(se2.compose(a, b)), product, atol=1e-12)


def test_interpolation_goes_along_the_twist():
    a, b = poses((6,), 1), poses((6,), 2)
    assert_same_pose(se2.interpolate(a, b, np.zeros(6)), a)
    assert_same_pose(se2.interpolate(a, b, np.ones(6)), b)
    half = se2.interpolate(a, b, np.full(6, 0.5))
    assert_same_pose(se2.between(a, half), se2.between(half, b))


# --- Jacobians ---------------------------------------------------------------------------------


@pytest.mark.parametrize('w', ANGLES)
@pytest.mark.parametrize(
    ('function', 'jacobians'),
    [(se2.compose, se2.compose_jacobians), (se2.between, se2.between_jacobians)],
)
def test_jacobians_are_those_of_central_differences(function, jacobians, w):
    a, b = np.array([1.0, -2.0, w]), np.array([0.4, 3.0, 0.9])
    J_a, J_b = jacobians(a, b)
    # values of 3 m: eps 3 / 1e-6 and step^2 leave some 1e-9
    at_a = central_differences(lambda x: function(x, b), a, angles=(2,))
    at_b = central_differences(lambda x: function(a, x), b, angles=(2,))
    np.testing.assert_allclose(J_a, at_a, atol=1e-8)
    np.testing.assert_allclose(J_b, at_b, atol=1e-8)


@pytest.mark.parametrize('jacobians', [se2.compose_jacobians, se2.between_jacobians])
def test_jacobians_broadcast(jacobians):
    a, b = poses((4, 1)), poses((3,), 1)
    J_a, J_b = jacobians(a, b)
    assert J_a.shape == J_b.shape == (4, 3, 3, 3)
    one = jacobians(a[2, 0], b[1])
    np.testing.assert_array_equal(J_a[2, 1], one[0])
    np.testing.assert_array_equal(J_b[2, 1], one[1])
