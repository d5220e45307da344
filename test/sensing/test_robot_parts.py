# SPDX-License-Identifier: Apache-2.0
"""What sticks to the robot is left out of its scans; what stays where it is never."""

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.params import Parameters
from rlml_slam.sensing.robot_parts import GONE, RobotParts
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Odometry, Scan

SECOND = 10**9

BEAMS = np.linspace(-np.pi, np.pi, 361)[:-1]
SIZE = np.array([9.0, 5.0])  # [m] of a room whose corner is at the origin


def in_room(pose, noise=0.0, rng=None):
    """Ranges of all BEAMS from a pose (3,) in the room, which has a cupboard in it."""
    angles = BEAMS + pose[2]
    u = np.column_stack([np.cos(angles), np.sin(angles)])
    with np.errstate(divide='ignore'):
        walls = np.where(u > 0, (SIZE - pose[:2]) / u, -pose[:2] / u).min(axis=1)
    away = np.array([6.0, 1.0]) - pose[:2]  # a cupboard, round
    along = u @ away
    beside2 = away @ away - along**2
    hit = (along > 0) & (beside2 < 0.4**2)
    near = along - np.sqrt(np.maximum(0.4**2 - beside2, 0.0))
    ranges = np.where(hit, np.minimum(walls, near), walls)
    return ranges if rng is None else ranges + noise * rng.standard_normal(len(ranges))


def in_corridor(pose, noise=0.0, rng=None):
    """Ranges of all BEAMS between two walls along x, of which 8 m are seen."""
    angles = BEAMS + pose[2]
    with np.errstate(divide='ignore'):
        away = np.where(np.sin(angles) > 0, 1.0 - pose[1], 1.0 + pose[1])
        ranges = away / np.abs(np.sin(angles))
    noise = 0.0 if rng is None else noise * rng.standard_normal(len(BEAMS))
    return np.where(ranges < 8.0, ranges, np.inf) + noise


def scan(ranges, stamp=1):
    none = np.zeros(0, np.float32)
    step = float(BEAMS[1] - BEAMS[0])
    return Scan(stamp, 'laser', -np.pi, step, 0.0, 0.1, 30.0, ranges.astype(np.float32), none)


def drive(parts, poses, change=lambda ranges: ranges, mounted=0.0, rng=None, ranges=in_room):
    """The beams that are left out after each pose (k, n)."""
    out = []
    for pose in poses:
        given = scan(change(ranges(pose + np.array([0, 0, mounted]), 0.01, rng)))
        out.append(np.isnan(parts.left_out(given, pose, mounted).ranges))
    return np.array(out)


def straight(length, num=30):
    return np.linspace([1.5, 2.0, 0.2], [1.5 + length, 2.0 + 0.2 * length, 0.2], num)


def turning(turn, num=40):
    return np.linspace([2.0, 2.5, 0.0], [2.0, 2.5, turn], num)


def mast(at, width=0.5, distance=0.4):
    seen = np.abs(se2.wrap(BEAMS - at)) < 0.5 * width
    return seen, lambda ranges: np.where(seen, distance, ranges)


@pytest.mark.parametrize('mounted', [0.0, 2.0])
def test_what_is_before_the_robot_is_found_on_the_first_way(mounted):
    seen, change = mast(-mounted)
    rng = np.random.default_rng(1)
    out = drive(RobotParts(), straight(0.5), change, mounted, rng)
    assert not out[:8].any()
    assert (out[-1] == seen).all()


@pytest.mark.parametrize('at', [0.0, 1.5, -2.5])
def test_a_thin_mast_anywhere_is_found_in_a_turn(at):
    seen, change = mast(at, 0.05)
    out = drive(RobotParts(), turning(3.1), change, rng=np.random.default_rng(2))
    assert not out[:30].any()
    assert (out[-1] == seen).all()


@pytest.mark.parametrize('seed', range(5))
def test_nothing_that_stays_where_it_is_is_left_out(seed):
    rng = np.random.default_rng(seed)
    parts, pose, turn = RobotParts(), np.array([2.0, 1.0, 0.0]), 0.0
    for k in range(1000):
        if k % 15 == 0:  # straight on, slow and fast curves
            turn, ahead = rng.choice([0.0, 0.0, 0.01, 0.05, 0.2]) * rng.choice([-1, 1]), 0.05
        there = se2.compose(pose, np.array([ahead, 0.0, turn]))
        if not ((there[:2] > 0.25) & (there[:2] < SIZE - 0.25)).all():
            there = se2.compose(pose, np.array([0.0, 0.0, 0.4]))
        if np.hypot(*(there[:2] - [6.0, 1.0])) < 0.7:
            there = se2.compose(pose, np.array([0.0, 0.0, 0.4]))
        pose = there
        given = scan(in_room(pose, 0.01, rng))
        assert parts.left_out(given, pose, 0.0) is given


def test_a_cart_that_is_left_behind_is_seen_again():
    seen, change = mast(np.pi, 0.6, 0.8)
    parts, rng = RobotParts(), np.random.default_rng(3)
    out = drive(parts, straight(0.5), change, rng=rng)
    assert (out[-1] == seen).all()
    out = drive(parts, straight(0.5, GONE + 1)[::-1], rng=rng)
    assert out[GONE - 2][seen].all()
    assert not out[-1].any()


def test_mast_that_was_found_stays_left_out_where_scans_are_far_apart():
    seen, change = mast(0.0)
    parts, rng = RobotParts(), np.random.default_rng(8)
    out = drive(parts, straight(0.5), change, rng=rng)
    assert (out[-1] == seen).all()
    out = drive(parts, straight(5.0, 6), change, rng=rng)
    assert out[:, seen].all()
    assert not out[:, ~seen].any()


def test_mast_beside_a_wall_as_near_stays_left_out_and_the_wall_in():
    seen, change = mast(0.3, 1.05)
    parts, rng = RobotParts(), np.random.default_rng(9)
    out = drive(parts, straight(0.5), change, rng=rng)
    assert (out[-1] == seen).all()

    def with_doors(pose, noise, rng):
        right = np.where((BEAMS < 0.0) & (pose[0] % 0.5 < 0.25), 0.5, 0.0)
        ahead = np.abs(BEAMS) < 0.5 * np.pi
        return np.where(ahead, in_corridor(pose, noise, rng) + right, np.inf)

    way = np.linspace([0.0, 0.7, 0.0], [3.0, 0.7, 0.0], 60)
    out = drive(parts, way, change, rng=rng, ranges=with_doors)
    assert (out[1:] == seen).all()


def test_what_is_ahead_all_along_a_bare_corridor_is_left_out_while_it_is_there():
    """The walls do not say whether the robot drives: then neither that nor the odometry does."""
    seen, change = mast(0.0)
    parts, rng = RobotParts(), np.random.default_rng(10)
    way = np.linspace([0.0, 0.0, 0.0], [0.5, 0.0, 0.0], 30)
    out = drive(parts, way, change, rng=rng, ranges=in_corridor)
    assert not out[:8].any()
    assert (out[-1] == seen).all()
    assert not drive(parts, way[-1:], rng=rng, ranges=in_corridor).any()


@pytest.mark.parametrize('turn', [0.0, 1.0], ids=['straight', 'turning'])
@pytest.mark.parametrize('here', [[2.0, 2.5, 0.0], [1.0, 4.0, 0.3]])
@pytest.mark.parametrize('noise', [0.005, 0.02])
def test_wheels_that_spin_make_no_parts_of_the_walls(here, noise, turn):
    parts, here, rng = RobotParts(), np.array(here), np.random.default_rng(4)
    for way in np.linspace(0.0, 4.0, 80):
        given = scan(in_room(here, noise, rng))
        spun = here + np.array([way, 0.0, turn * way])
        assert parts.left_out(given, spun, 0.0) is given


def test_odometry_that_is_reset_beside_a_wall_is_no_way():
    parts, rng = RobotParts(), np.random.default_rng(5)
    for k, x in enumerate(np.linspace(1.0, 5.0, 60)):
        pose = np.array([x, 4.5, 0.0])
        given = scan(in_room(pose, 0.01, rng))
        reported = pose if k < 30 else pose - np.array([3.0, 1.0, 0.0])
        assert parts.left_out(given, reported, 0.0) is given


def test_wall_that_is_out_of_sight_in_a_turn_and_there_again_is_no_part():
    parts, rng = RobotParts(), np.random.default_rng(6)
    turn = [np.array([3.0, 4.3, heading]) for heading in np.linspace(0.0, np.pi, 40)]
    for k, pose in enumerate([*turn[:1], *turn, *turn[-1:]]):
        ranges = in_room(pose, 0.02, rng)
        ahead = ranges if k in (0, 41) else np.where(ranges < 1.5, np.inf, ranges)
        assert parts.left_out(scan(ahead), pose, 0.0) is not None
        assert not parts._beams['laser'].is_part.any()


def test_most_of_a_scan_is_never_taken_for_the_robot():
    """Under a shelf a robot sees four legs and little else; it turns on the spot."""
    parts, rng = RobotParts(), np.random.default_rng(7)
    near = np.arange(len(BEAMS)) % 30 < 10
    for k, heading in enumerate(np.linspace(0.0, 6.0, 120)):
        far = 4.0 + np.sin(3.0 * (BEAMS + heading))
        ranges = np.where(near, 0.6 + 0.01 * rng.standard_normal(len(BEAMS)), np.inf)
        ranges[15::30] = far[15::30]
        given = scan(ranges)
        assert parts.left_out(given, np.array([0.0, 0.0, heading]), 0.0) is given, k


def test_without_odometry_nothing_is_learned():
    _, change = mast(0.0)
    parts = RobotParts()
    for pose in straight(2.0):
        given = scan(change(in_room(pose)))
        assert parts.left_out(given, None, 0.0) is given


def test_a_robot_that_sees_itself_does_not_stand_still():
    """Without odometry's word a third of all beams would hold it at its first pose."""
    _, change = mast(0.6, 1.0)
    ahead = np.abs(BEAMS) < 0.5 * np.pi
    slam, rng, frames = Slam(Parameters()), np.random.default_rng(0), []
    for k in range(120):
        pose, stamp = np.array([1.5 + max(0, k - 20) * 0.03, 2.0, 0.0]), SECOND + k * SECOND // 10
        frames += slam.add_odometry(Odometry(stamp, pose))
        ranges = np.where(ahead, change(in_room(pose, 0.01, rng)), np.nan)
        frames += slam.add_scan(scan(ranges, stamp))
    last = (frames + slam.finish())[-1]
    assert last.T_map_base[0] == pytest.approx(2.97, abs=0.2)
    assert slam.counts['scan']['robot_parts'] > 80
    seen_by = np.arctan2(*last.observation.points.T[::-1])
    assert not (np.abs(seen_by - 0.6) < 0.49).any()
