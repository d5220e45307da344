# SPDX-License-Identifier: Apache-2.0
"""Every Jacobian of the EKF against central differences, and the note's slips beside them."""

import numpy as np
import pytest
from differences import central_differences

from rlml_slam import se2
from rlml_slam.estimation.landmark_models import POINT, line_innovation, line_model, to_polar

# random, near 0 and near pi
POSES = [(0.3, -0.7, 0.4), (2.0, 1.0, 1e-7), (-1.0, 0.5, np.pi - 1e-7), (0.1, 0.2, -2.6)]
MODELS = {'point': POINT, 'line': line_model(np.array([0.4, -3.0]))}
# relative to the largest entry of each Jacobian
TOLERANCE = 1e-6


def close(J, expected):
    assert np.abs(J - expected).max() <= TOLERANCE * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('pose', POSES)
def test_measurement_jacobians_are_the_derivatives(name, pose):
    model, pose, m = MODELS[name], np.array(pose), np.array([3.2, 1.9])
    _, H_r, H_m = model.observe(pose, m[None])
    h = lambda p, q: model.observe(p, q[None])[0][0]  # noqa: E731
    close(H_r[0], central_differences(lambda p: h(p, m), pose, angles=(1,)))
    close(H_m[0], central_differences(lambda q: h(pose, q), m, angles=(1,)))


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('pose', POSES)
def test_jxr_and_jz_are_the_derivatives(name, pose):
    model, pose, z = MODELS[name], np.array(pose), np.array([2.5, -0.8])
    _, J_xr, J_z = model.place(pose, z[None])
    close(J_xr[0], central_differences(lambda p: model.place(p, z[None])[0][0], pose))
    close(J_z[0], central_differences(lambda q: model.place(pose, q[None])[0][0], z))


@pytest.mark.parametrize('name', MODELS)
def test_a_pose_of_each_landmark_gives_what_each_pose_gives(name):
    model, poses = MODELS[name], np.array(POSES)
    given = np.random.default_rng(0).uniform(1.0, 4.0, (len(poses), 2))
    for of in (model.observe, model.place):
        alone = [of(pose, row[None]) for pose, row in zip(poses, given, strict=True)]
        for k, together in enumerate(of(poses, given)):
            np.testing.assert_allclose(together, np.concatenate([a[k] for a in alone]), atol=1e-12)


def test_polar_noise_is_turned_by_the_derivative():
    p, C = np.array([1.2, -0.7]), np.array([[0.04, 0.01], [0.01, 0.09]])
    J = central_differences(lambda q: to_polar(q[None], C[None])[0][0], p)
    close(to_polar(p[None], C[None])[1][0], J @ C @ J.T)


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('pose', POSES)
def test_a_placed_landmark_is_measured_as_it_was(name, pose):
    model, pose = MODELS[name], np.array(pose)
    z = np.array([[2.5, -0.8], [0.7, 3.0], [6.0, 1.5]])
    h = model.observe(pose, model.place(pose, z)[0])[0]
    assert np.abs(model.innovation(z, h)).max() < 1e-12


def test_both_descriptions_of_a_line_are_one_line():
    z = np.array([[1.5, 0.3], [-1.5, 0.3 - np.pi], [-1.5, 0.3 + np.pi]])
    assert np.abs(line_innovation(z, z[:1])).max() < 1e-12


def test_the_note_s_bearing_row_has_one_wrong_sign():
    pose, m = np.array([0.5, -0.2, 0.3]), np.array([3.0, 2.0])
    dx, dy = m - pose[:2]
    q = dx * dx + dy * dy
    numeric = central_differences(lambda p: POINT.observe(p, m[None])[0][0], pose, angles=(1,))[1]
    note, corrected = np.array([dy / q, dx / q, -1.0]), np.array([dy / q, -dx / q, -1.0])
    assert np.abs(corrected - numeric).max() < 1e-8
    assert np.abs(note - numeric).max() == pytest.approx(2.0 * dx / q, rel=1e-6)


def test_the_note_s_range_lacks_a_square():
    pose, m = np.zeros(3), np.array([3.0, 4.0])
    assert POINT.observe(pose, m[None])[0][0, 0] == pytest.approx(5.0, abs=1e-12)
    assert np.sqrt(m[0] ** 2 + m[1]) == pytest.approx(np.sqrt(13.0))


def test_the_note_s_jz_has_one_wrong_sign():
    pose, z = np.array([0.5, -0.2, 0.3]), np.array([2.5, 0.4])
    J_z = POINT.place(pose, z[None])[2][0]
    note = J_z * np.array([[1.0, 1.0], [1.0, -1.0]])
    numeric = central_differences(lambda q: POINT.place(pose, q[None])[0][0], z)
    assert np.abs(J_z - numeric).max() < 1e-8
    assert np.abs(note - numeric).max() == pytest.approx(2.0 * z[0] * np.cos(0.7), rel=1e-6)


def test_the_note_s_line_landmark_follows_the_robot_s_error():
    """Its range and bearing, made with a pose that is 0.5 m off along the wall, fit that pose."""
    true, wrong = np.array([1.0, 0.0, 0.0]), np.array([1.5, 0.0, 0.0])
    seen = np.array([[2.0, 0.5 * np.pi]])  # a wall along x, 2 m to the left
    fixed = np.zeros(2)

    def as_range_and_bearing(pose):
        n = np.array([np.cos(seen[0, 1] + pose[2]), np.sin(seen[0, 1] + pose[2])])
        rho, normal = seen[0, 0] + n @ pose[:2], seen[0, 1] + pose[2]
        # the note's landmark: the point of the line in the map that is nearest to the fixed one
        axis = np.array([np.cos(normal), np.sin(normal)])
        d = fixed + (rho - axis @ fixed) * axis - pose[:2]
        return np.array([np.hypot(*d), se2.wrap(np.arctan2(d[1], d[0]) - pose[2])])

    landmark = np.array([[0.0, 2.0]])
    for pose in (true, wrong):
        h = POINT.observe(pose, landmark)[0]
        # no innovation at all, though H says that x was measured
        assert np.abs(as_range_and_bearing(pose) - h).max() < 1e-12
    assert abs(POINT.observe(wrong, landmark)[1][0, 0, 0]) > 0.5
    # the information of a line does not change along the wall
    line = line_model(fixed)
    assert np.abs(line.observe(true, landmark)[1][0, :, 0]).max() < 1e-12


def test_noise_in_proportion_to_the_bearing_vanishes_straight_ahead():
    assert np.linalg.det(np.diag([0.01 * 5.0, 0.01 * 0.0])) == 0.0


def test_prediction_without_the_transpose_is_no_covariance():
    A = se2.compose_jacobians(np.zeros(3), np.array([1.0, 0.5, 0.2]))[0]
    P = np.diag([0.01, 0.02, 0.04])
    note, right = A @ P @ A, A @ P @ A.T
    assert np.abs(right - right.T).max() < 1e-15
    assert np.abs(note - note.T).max() > 0.01
