# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.matching.scans.scan_information import information
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import ScanMatch

PARAMS = ScanMatch()
POSE = np.array([0.2, -0.1, 0.3])


def wall(a, b, spacing=0.05):
    """Points (n, 2) from a to b, in the order a scan has them."""
    a, b = np.array(a), np.array(b)
    n = round(np.linalg.norm(b - a) / spacing)
    return a + (np.arange(n) / n)[:, None] * (b - a)


ROOM = np.vstack(
    [
        wall((4.0, -2.0), (4.0, 3.0)), wall((4.0, 3.0), (-3.0, 3.0)),
        wall((-3.0, 3.0), (-3.0, -2.0)), wall((-3.0, -2.0), (4.0, -2.0)),
    ]
)  # fmt: skip
BARE_WALL = wall((6.0, 2.0), (-6.0, 2.0))
CORRIDOR = np.vstack([wall((8.0, 1.2), (-8.0, 1.2)), wall((-8.0, -1.2), (8.0, -1.2))])


def information_of(points, pose=POSE, sigma=0.01, params=PARAMS, turn=0.0):
    """Information of a scan of ``points`` (submap frame, turned) taken from ``pose``."""
    rng = np.random.default_rng(0)
    T = np.array([0.0, 0.0, turn])
    points = se2.transform(T, points)
    pose = se2.compose(T, pose)
    submap = Submap()
    for _ in range(12):
        submap.insert(points + sigma * rng.standard_normal(points.shape), pose[:2])
    seen = points + sigma * rng.standard_normal(points.shape)
    return information(submap, se2.transform(se2.inverse(pose), seen), pose, params)


@pytest.mark.parametrize('angle', [0.0, 0.5, np.pi / 2, 2.0])
@pytest.mark.parametrize('points', [BARE_WALL, CORRIDOR], ids=['wall', 'corridor'])
def test_direction_along_bare_walls_is_left_open(points, angle):
    info = information_of(points, turn=angle)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-np.sin(angle), np.cos(angle)])
    # against the strongest direction: what the noise of the normals makes up is taken off
    strong = across @ info[:2, :2] @ across
    assert strong > 1.0 / 0.02**2
    # with the heading estimated along: the marginal of the position along the wall
    marginal = info[:2, :2] - np.outer(info[:2, 2], info[:2, 2]) / info[2, 2]
    assert along @ marginal @ along < 0.002 * strong
    assert info[2, 2] > 1.0 / 0.02**2


def test_room_holds_all_directions():
    info = information_of(ROOM)
    sigma = np.sqrt(np.diag(np.linalg.inv(info)))
    # never better than the floor that more beams do not lower, and close to it
    floor = np.sqrt(PARAMS.variance_floor)
    assert (sigma >= floor).all()
    assert (sigma[:2] < 0.03).all()
    assert sigma[2] < 0.01


def test_information_is_symmetric_and_not_negative():
    for points in (ROOM, BARE_WALL, CORRIDOR, ROOM[:80]):
        info = information_of(points)
        np.testing.assert_array_equal(info, info.T)
        assert np.linalg.eigvalsh(info).min() > -1e-9 * np.trace(info)


def test_turning_the_world_turns_the_information():
    info, turned = information_of(ROOM), information_of(ROOM, turn=np.pi / 2)
    R = np.eye(3)
    R[:2, :2] = se2.rotation(np.pi / 2)
    # the same noise on another axis and other cells: a few points change sides
    scale = np.sqrt(np.outer(np.diag(info), np.diag(info)))
    np.testing.assert_allclose(R.T @ turned @ R / scale, info / scale, atol=0.06)


def test_moving_the_world_by_whole_cells_changes_nothing():
    shift = np.array([40 * 0.05, -60 * 0.05])
    a = information_of(ROOM)
    b = information_of(ROOM + shift, pose=POSE + np.append(shift, 0.0))
    scale = np.sqrt(np.outer(np.diag(a), np.diag(a)))
    np.testing.assert_allclose(b / scale, a / scale, atol=0.02)


def test_scan_elsewhere_tells_nothing():
    submap = Submap()
    submap.insert(ROOM, np.zeros(2))
    np.testing.assert_array_equal(information(submap, ROOM, np.array([30.0, 0.0, 0.0]), PARAMS), 0)


def test_patch_that_faces_the_laser_does_not_tell_the_heading():
    # its normal points at the laser: the heading gets what is taken off and nothing else
    y = np.linspace(-0.2, 0.2, 9)
    patch = np.stack([5.025 + 0.015 * (-1.0) ** np.arange(9), y], -1)
    submap = Submap()
    for _ in range(12):
        # as thick as two cells, so that every point of it is explained
        submap.insert(patch + np.array([0.025, 0.0]), np.zeros(2))
        submap.insert(patch - np.array([0.025, 0.0]), np.zeros(2))
    info = information(submap, patch, np.zeros(3), PARAMS)
    assert np.isfinite(info).all()
    assert np.linalg.eigvalsh(info).min() > -1e-9 * np.trace(info)
    assert info[0, 0] > 0.0
    assert info[2, 2] < 0.01 * info[0, 0]


def test_bare_walls_tell_a_robot_alone_with_its_scans_nothing_along_them():
    submap = Submap()
    rng = np.random.default_rng(3)
    for _ in range(12):
        submap.insert(CORRIDOR + 0.01 * rng.standard_normal(CORRIDOR.shape), np.zeros(2))
    for _ in range(50):
        seen = CORRIDOR + 0.01 * rng.standard_normal(CORRIDOR.shape)
        info = information(submap, seen, np.zeros(3), PARAMS, alone=True)
        assert np.linalg.eigvalsh(info)[0] < 1e-6


def test_a_post_that_the_submap_does_not_have_holds_nothing_along_the_wall():
    """A wall point has post and wall for neighbours, and only of the wall it is said to fit."""
    rng = np.random.default_rng(0)
    submap = Submap()
    for _ in range(12):
        submap.insert(CORRIDOR + 0.01 * rng.standard_normal(CORRIDOR.shape), np.zeros(2))
    posts = [wall((x, 1.0), (x, 1.2)) for x in (-5.0, -2.0, 3.0, 6.0)]
    at = [int(np.argmin(np.hypot(*(CORRIDOR - p[-1]).T))) for p in posts]
    points = np.insert(CORRIDOR, np.repeat(at, [len(p) for p in posts]), np.vstack(posts), axis=0)
    seen = points + 0.01 * rng.standard_normal(points.shape)
    info = information(submap, seen, np.zeros(3), PARAMS, alone=True)
    assert info[0, 0] < 1e-3 * info[1, 1]


def test_few_beams_on_the_end_of_a_corridor_hold_a_robot_alone_with_its_scans():
    end = wall((8.0, -1.0), (8.0, 1.0), spacing=0.25)
    scan = np.vstack([CORRIDOR[len(CORRIDOR) // 2 :], end, CORRIDOR[: len(CORRIDOR) // 2]])
    submap = Submap()
    for _ in range(12):
        submap.insert(scan, np.zeros(2))
    alone = information(submap, scan, np.zeros(3), PARAMS, alone=True)
    assert alone[0, 0] > 1.0 / 0.03**2
    assert np.linalg.eigvalsh(information(submap, scan, np.zeros(3), PARAMS))[0] < 1e-6
