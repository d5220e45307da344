# SPDX-License-Identifier: Apache-2.0
"""A robot that was carried away knows that it is lost, finds itself, and leaves the map alone."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import (
    FIRST,
    OTHER_ROOM,
    ROOM,
    STEP,
    TinyWorld,
    drive,
    errors,
    observations,
    polygon,
)

from rlml_slam import se2
from rlml_slam.estimation.health import HealthInputs, HealthMonitor, ScanEvidence
from rlml_slam.estimation.kidnapping_detection import KidnappingDetection
from rlml_slam.maps.occupancy import render
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import HealthLimits, Node, Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.front_end.grid_localization import GridMatch
from rlml_slam.slam.front_end.map_localization import MapConfirmation
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.types import Level, Motion, Reflectors

LOOP = drive((0.6, 0.0, 4.0), (0.5, 0.7, 5.0), (0.6, 0.0, 3.0), (0.5, 0.7, 4.0))
THERE = se2.compose(LOOP[-1], np.array([2.2, 0.9, 2.5]))
AFTER = drive((0.4, 0.3, 4.0), start=THERE)


def kidnapping(path=LOOP, after=AFTER, world=ROOM, elsewhere=ROOM, **kw):
    """Observations along a path, and from its end on along another that no motion leads to."""
    rng = np.random.default_rng(0)
    before = observations(world, path, rng=rng, **kw)
    then = observations(elsewhere, after, rng=rng, **kw)
    later = [replace(o, stamp=o.stamp + len(path) * STEP) for o in then]
    return [*before, *later], np.vstack([path, after])


def run(observed, slam=None):
    """Frames of a system that is given observations, and the system."""
    slam = slam or Slam(Parameters())
    frames = [frame for o in observed for frame in slam.process([o])]
    return frames, slam


def seconds(frames, path=LOOP):
    return np.array([f.stamp - FIRST - len(path) * STEP for f in frames]) * 1e-9


@pytest.mark.parametrize(
    'kw', [{}, {'reflectors': False}, {'scan': False}], ids=['both', 'scan', 'reflectors']
)
def test_carried_robot_is_lost_within_a_second_and_found_again_while_mapping(kw):
    observed, path = kidnapping(**kw)
    frames, slam = run(observed)
    levels, t = np.array([f.health.level for f in frames]), seconds(frames)
    assert (levels[t < 0.0] == Level.OK).all()
    lost = t[levels == Level.LOST]
    assert 0.0 < lost[0] < 1.0
    back = t[(levels == Level.OK) & (t > lost[0])]
    assert back[0] < 3.0
    assert [f.jumped for f in frames].count(True) == 1
    distance, turn = errors(np.array([f.T_map_base for f in frames]), path)
    assert distance[t > back[0]].max() < 0.06
    assert turn[t > back[0]].max() < 0.03
    # the map is that of one room
    slam.back_end.finish()
    reflectors = slam.reflectors()
    expected = len(ROOM.reflectors) if kw.get('reflectors', True) else 0
    assert len(reflectors) == expected
    stamps, poses = slam.trajectory()
    distance, _ = errors(poses, path)
    known = (t < 0.0) | (t > back[0])
    assert distance[known].max() < 0.06
    assert len(stamps) == len(observed)


def test_nothing_seen_in_doubt_is_mapped():
    observed, _ = kidnapping(elsewhere=OTHER_ROOM, after=AFTER[:5] - THERE)
    front_end, back_end = FrontEnd(Parameters()), BackEnd(Parameters())
    for o in observed[: len(LOOP)]:
        back_end.add(front_end.process(o))
    keys, grid = len(back_end.keyframes), front_end.submaps.target.values.copy()
    tracks = front_end.tracks.keys.copy()
    for o in observed[len(LOOP) :]:
        frame = front_end.process(o)
        assert frame.unconfirmed
        assert back_end.add(frame) is None
    assert len(back_end.keyframes) == keys
    np.testing.assert_array_equal(front_end.submaps.target.values, grid)
    np.testing.assert_array_equal(front_end.tracks.keys, tracks)


def test_robot_in_a_place_that_is_not_in_the_map_maps_on_after_a_while_and_stays_lost():
    """It was OK then, though nobody knows where the place is."""
    limits = HealthLimits(new_session_time=2.0)
    path = drive((0.0, 0.1, 6.0))
    observed, _ = kidnapping(after=path, elsewhere=OTHER_ROOM, reflectors=False)
    frames, slam = run(observed, Slam(Parameters(health=limits)))
    levels, t = np.array([f.health.level for f in frames]), seconds(frames)
    assert (levels[t > 0.8] == Level.LOST).all()
    assert not any(f.jumped for f in frames)
    used = np.array([f.scan_used for f in frames])
    assert not used[(t > 0.8) & (t < 2.0)].any()
    assert used[t > 3.1].all()
    assert not any(f.unconfirmed for f in frames[-10:])
    assert np.sqrt(frames[-1].cov_map[0, 0]) > 10.0
    begun = next(f.stamp for f, later in zip(frames, t > 3.1, strict=True) if later)
    assert slam.back_end.keyframes[-1].stamp > begun


def test_place_that_looks_like_another_stays_lost():
    """Half a turn changes nothing in this hall: who is carried about in it must not guess."""
    hall = replace(
        OTHER_ROOM,
        walls=np.array(
            [[-5.0, -3.0, 5.0, -3.0], [5.0, -3.0, 5.0, 3.0], [5.0, 3.0, -5.0, 3.0],
             [-5.0, 3.0, -5.0, -3.0], [-1.0, 1.0, 1.0, 2.0], [1.0, -1.0, -1.0, -2.0]]
        ),
        reflectors=np.array([[-4.0, -2.0], [2.0, 2.5], [4.5, -0.5], [4.0, 2.0], [-2.0, -2.5],
                             [-4.5, 0.5]]),
    )  # fmt: skip
    path = drive((0.5, 0.0, 4.0), (0.0, 0.8, 4.0), start=(-3.0, -0.4, 0.0))
    after = drive((0.0, 0.1, 3.0), start=(3.0, 0.9, 1.0))
    observed, _ = kidnapping(path, after, hall, hall)
    limits = HealthLimits(new_session_time=60.0)
    frames, slam = run(observed, Slam(Parameters(health=limits)))
    assert not any(f.jumped for f in frames)
    assert frames[-1].health.level is Level.LOST
    assert re.search('alike|more than one', slam.system.recovery.why)


# --- localization ------------------------------------------------------------------------------


def room_map(reflectors=ROOM.reflectors):
    seen = observations(ROOM, LOOP[::3])
    grid = render(LOOP[::3], [o.points for o in seen], [o.origin for o in seen])
    m = len(reflectors)
    return SavedMap(
        Reflectors(
            np.arange(m), reflectors.copy(), np.tile(1e-5 * np.eye(2), (m, 1, 1)),
            np.full(m, -1), np.full(m, 9), np.full(m, np.nan),
        ),
        grid,
    )  # fmt: skip


def localizing(saved, start=(0.0, 0.0, 0.0)):
    slam = Slam(Parameters(node=Node(mode='localization', map_start_pose=tuple(start))))
    slam.use_map(saved)
    return slam


@pytest.mark.parametrize('reflectors', [True, False])
def test_saved_map_tells_where_the_robot_starts(reflectors):
    """No initial pose is given: the first second determines it."""
    path = drive((0.0, 0.1, 1.0), (0.5, 0.3, 3.0), start=(2.0, 1.0, 2.0))
    observed = observations(ROOM, path, rng=np.random.default_rng(1), reflectors=reflectors)
    saved = room_map() if reflectors else room_map(np.zeros((0, 2)))
    frames, slam = run(observed, localizing(saved))
    distance, turn = errors(np.array([f.T_map_base for f in frames]), path)
    assert frames[0].health.level is Level.DEGRADED
    assert distance[0] > 1.0
    assert distance[12:].max() < 0.06
    assert turn[12:].max() < 0.03
    assert {f.health.level for f in frames[-5:]} == {Level.OK}
    assert slam.back_end.keyframes == []
    np.testing.assert_array_equal(slam.trajectory()[1], [f.T_map_base for f in frames])
    assert slam.map() is saved


def test_carried_robot_finds_itself_in_a_saved_map():
    observed, path = kidnapping()
    frames, _ = run(observed, localizing(room_map()))
    levels, t = np.array([f.health.level for f in frames]), seconds(frames)
    lost = t[levels == Level.LOST]
    assert 0.0 < lost[0] < 1.0
    distance, _ = errors(np.array([f.T_map_base for f in frames]), path)
    assert distance[(t < 0.0) | (t > 1.5)].max() < 0.06


def test_grid_of_a_saved_map_holds_the_pose_where_no_reflector_is_seen():
    """Odometry that is wrong by a tenth, and scans: only the grid knows the place in the map."""
    path = drive(*[(0.5, 0.35, 18.0)] * 3, start=(1.0, -1.5, 0.0))
    observed = observations(ROOM, path, reflectors=False, rng=np.random.default_rng(2))
    wrong = np.array([1.1, 1.0, 1.1])
    observed = [
        replace(o, motion=Motion(wrong * o.motion.delta, 4.0 * o.motion.cov)) for o in observed
    ]
    frames, _ = run(observed, localizing(room_map(), path[0]))
    distance, turn = errors(np.array([f.T_map_base for f in frames]), path)
    assert distance.max() < 0.05
    assert turn.max() < 0.02
    assert {f.health.level for f in frames[5:]} == {Level.OK}


def hall(seed, half=3.0, begin=-4.0, end=40.0):
    """Walls (n, 4) of a hall, 2 ``half`` wide, with boxes at random along both sides."""
    rng = np.random.default_rng(seed)
    walls = [polygon((begin, -half), (end, -half), (end, half), (begin, half))]
    for x in np.arange(begin + 1.0, end - 1.0, 1.5):
        y, side = rng.choice([-1, 1]) * (half - rng.uniform(0.4, 1.2)), rng.uniform(0.2, 0.4)
        x += rng.uniform(-0.5, 0.5)
        low, high = (x - side, y - side), (x + side, y + side)
        walls.append(polygon(low, (high[0], low[1]), high, (low[0], high[1])))
    return np.vstack(walls)


def in_hall(mapped, real, mapped_to):
    """Frames of a drive through one hall in the map of another, and their errors."""
    path, none = drive((1.0, 0.0, 26.0)), np.zeros((0, 2))
    seen = path[path[:, 0] < mapped_to][::3]
    scans = observations(TinyWorld(mapped, none), seen)
    grid = render(seen, [o.points for o in scans], [o.origin for o in scans])
    slam = localizing(SavedMap(room_map(none).reflectors, grid))
    rng = np.random.default_rng(0)
    frames, _ = run(observations(TinyWorld(real, none), path, rng=rng), slam)
    return frames, errors(np.array([f.T_map_base for f in frames]), path)[0]


def test_robot_that_drives_out_of_its_map_is_degraded_and_goes_on():
    """Nothing contradicts a pose out there, but nothing confirms it either."""
    frames, distance = in_hall(hall(0), hall(0), 4.0)
    levels = [f.health.level for f in frames]
    assert set(levels[5:150]) == {Level.OK}
    assert levels[-1] is Level.DEGRADED
    (reason,) = frames[-1].health.reasons
    assert re.fullmatch(r'no match with the saved map for 1\d m', reason)
    assert Level.LOST not in levels
    assert distance.max() < 0.1


def test_map_of_a_hall_that_was_rebuilt_is_no_place_to_be_sure_of():
    """Beyond the gate at 10 m, the walls of the map are missing and others stand farther out."""
    rebuilt = np.vstack([hall(0, 3.0, -4.0, 10.0), hall(1, 8.0, 10.0)])
    shut = (rebuilt[:, 0] == 10.0) & (rebuilt[:, 2] == 10.0)
    gate = np.array([[10.0, -3.0, 10.0, -8.0], [10.0, 3.0, 10.0, 8.0]])
    frames, _ = in_hall(hall(0), np.vstack([rebuilt[~shut], gate]), 26.0)
    levels = [f.health.level for f in frames]
    assert set(levels[5:100]) == {Level.OK}
    assert levels[-1] is Level.LOST
    assert levels.index(Level.DEGRADED) < levels.index(Level.LOST)
    assert 'and the scan contradicts it' in frames[-1].health.reasons[0]


def test_without_the_map_to_localize_in_nothing_is_sure():
    slam = Slam(Parameters(node=Node(mode='localization')))
    frames, _ = run(observations(ROOM, LOOP[:70], rng=np.random.default_rng(4)), slam)
    assert {f.health.reasons[0] for f in frames} == {'no map has been loaded for localization'}
    levels, t = np.array([f.health.level for f in frames]), seconds(frames, ())
    assert (levels == np.where(t > 5.0, Level.LOST, Level.DEGRADED)).all()
    assert all(f.unconfirmed for f in frames)
    assert len(slam.reflectors()) == len(slam.front_end.reflectors()) == 0


# --- the parts ---------------------------------------------------------------------------------


def test_scan_misfits_only_against_what_is_usual():
    doubt = KidnappingDetection(HealthLimits(contradiction_ratio=0.6))
    assert not doubt.is_misfit(0.0, 90)
    for score in (0.5, 0.6, 0.7, 0.6, 0.6):
        doubt.learn(score)
    assert doubt.is_misfit(0.35, 90)
    assert not doubt.is_misfit(0.37, 90)
    assert not doubt.is_misfit(0.0, 2)


@pytest.mark.parametrize(
    ('frame', 'contradicts'),
    [
        ((True, False, 0, 0), True),  # a scan alone
        ((True, False, 6, 4), False),  # reflectors speak for the map
        ((True, False, 6, 1), True),  # one of six may be chance
        ((False, True, 6, 0), False),  # the scan speaks for it
        ((False, False, 6, 0), True),  # reflectors alone: all are others
        ((False, False, 2, 0), False),  # two may be ghosts
        ((False, False, 0, 0), False),
    ],
)
def test_either_sense_overrules_the_other(frame, contradicts):
    doubt = KidnappingDetection(HealthLimits())
    doubt.check(FIRST, False, True, 4, 4, False)
    assert doubt.check(FIRST + STEP, *frame, False) is contradicts
    assert (doubt.since == FIRST + STEP) is contradicts


def test_new_reflectors_contradict_only_where_known_ones_were_seen_just_before():
    doubt = KidnappingDetection(HealthLimits())
    doubt.check(FIRST, False, True, 4, 4, False)
    assert not doubt.check(FIRST + 6 * STEP, False, False, 5, 0, False)
    assert doubt.check(FIRST + 7 * STEP, False, False, 5, 0, True)


@pytest.mark.parametrize(
    ('few', 'fits', 'contradicts'),
    [((2, 0), False, True), ((1, 0), False, True), ((2, 1), False, False), ((2, 0), True, False)],
)
def test_reflectors_that_replaced_the_known_ones_may_leave_the_view(few, fits, contradicts):
    """Two alone say nothing, but what more of them said is not taken back by it."""
    doubt = KidnappingDetection(HealthLimits())
    doubt.check(FIRST, False, True, 4, 4, False)
    assert doubt.check(FIRST + STEP, False, False, 3, 0, False)
    assert doubt.check(FIRST + 2 * STEP, False, fits, *few, False) is contradicts
    assert (doubt.since == FIRST + STEP) is contradicts


@pytest.mark.parametrize(('used', 'is_lost'), [(2, True), (3, False)])
def test_two_reflectors_do_not_confirm_a_pose_that_the_scan_contradicts(used, is_lost):
    """They may match by chance; the robot was OK and 8 m away."""
    confirmation = MapConfirmation(Parameters(node=Node(mode='localization')))
    confirmation.check(FIRST, 0.0, 4, 4, True, GridMatch(0.7, used=True, is_complete=True))
    assert not confirmation.reason
    for k in range(1, 80):  # 8 m in 8 s
        misfit = GridMatch(0.2, contradicts=True)
        confirmation.check(FIRST + k * STEP, 0.1, 4, used, True, misfit)
    assert confirmation.is_lost is is_lost
    assert ('the scan contradicts it' in confirmation.reason) is is_lost


def test_recovery_leaves_a_robot_alone_that_is_not_lost():
    frames, _ = run(observations(ROOM, LOOP[:20], rng=np.random.default_rng(3)))
    recovery = Recovery(Parameters())
    for f in frames:
        recovery.follow(f)
        assert not recovery.is_due(f)
    # and is not due before the robot has been lost for a while
    due = False
    for f in frames:
        unconfirmed = replace(f, unconfirmed=True)
        recovery.follow(unconfirmed)
        due |= recovery.is_due(unconfirmed)
        assert due == (f.stamp - FIRST >= 6 * STEP)


def test_reflectors_that_tell_who_they_are_are_left_to_the_back_end():
    """They were moved, not the robot: the ids say so, and the map has to learn it."""
    moved = replace(ROOM, reflectors=ROOM.reflectors[::-1].copy())
    kw = {'scan': False, 'rng': np.random.default_rng(0)}
    front_end = FrontEnd(Parameters())
    for o in observations(ROOM, LOOP[:40], ids=True, **kw):
        assert not front_end.process(o).unconfirmed
    for ids in (True, False):
        (o,) = observations(moved, [np.array([0.7, 0.9, 2.0])], ids=ids, **kw)
        later = replace(o, stamp=FIRST + (41 - ids) * STEP)
        assert front_end.process(later).unconfirmed is not ids


def levels(steps):
    """Levels of a monitor: (sigma [m], whether the scan holds the pose, whether it maps)."""
    monitor = HealthMonitor(HealthLimits())
    out = []
    for k, (sigma, held, maps) in enumerate(steps):
        scan = ScanEvidence(has_scan=True, used=held, score=0.6)
        cov = np.diag([sigma, sigma, 0.01]) ** 2
        step = HealthInputs(scan, True, None, 0, cov, maps=maps)
        out.append(monitor.evaluate(FIRST + k * STEP, step).level)
    return out


def test_map_that_grows_far_from_its_start_is_no_reason_to_be_lost():
    far = [(0.1 * k, True, True) for k in range(60)]
    assert levels(far)[-1] is Level.DEGRADED
    assert levels([(sigma, held, False) for sigma, held, _ in far])[-1] is Level.LOST


def test_what_odometry_alone_made_uncertain_stays_so_until_the_place_is_found():
    explored = [(0.1 * k, True, True) for k in range(50)]
    gap = [(6.0, False, True), *[(6.0, True, True)] * 40]
    assert levels([*explored, *gap])[-1] is Level.LOST
    assert levels([*explored, *gap, (4.0, True, True), (4.5, True, True)])[-1] is Level.DEGRADED


def levels_far_away(unseen, turn_noise):
    """Levels of a robot 240 m from where its map begins, held for 20 m and not for the next."""
    monitor, out = HealthMonitor(HealthLimits()), []
    x, P = 220.0, np.diag([0.1, 220.0 * 0.08, 0.08]) ** 2
    P[1, 2] = P[2, 1] = 220.0 * 0.08**2
    for k in range(100 + unseen):
        held = k < 100
        P = (J := np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]])) @ P @ J.T
        P = P + np.diag([1e-6, 1e-6, 0.0 if held else turn_noise**2])
        x += 0.2
        scan = ScanEvidence(has_scan=True, used=held, score=0.6)
        at = np.array([x, 0.0])
        step = HealthInputs(scan, True, None, 1, P, maps=True, position=at)
        out.append(monitor.evaluate(FIRST + k * STEP, step).level)
    return out


def test_scans_missed_far_from_the_start_are_no_reason_to_be_lost():
    """The heading of the whole map is uncertain there: each metre turns it by decimetres."""
    assert Level.LOST not in levels_far_away(unseen=10, turn_noise=0.001)


def test_way_that_only_odometry_saw_counts_with_the_heading_that_it_lost():
    assert levels_far_away(unseen=400, turn_noise=0.01)[-1] is Level.LOST


def levels_in_corridor(steps):
    """Levels while a scan holds all but one direction: sigma [m] in the map, and in the submap."""
    monitor, out = HealthMonitor(HealthLimits()), []
    submap = object()
    for k, (sigma, drifted, used) in enumerate(steps):
        cov, own = (np.diag([s, s, 0.01]) ** 2 for s in (sigma, drifted))
        scan = ScanEvidence(
            True, used, score=0.6, open_direction=0.0, submap=submap, cov_submap=own
        )
        step = HealthInputs(scan, True, None, 0, cov, maps=True)
        out.append(monitor.evaluate(FIRST + k * STEP, step).level)
    return out


def test_heading_that_moves_the_end_of_a_corridor_is_no_reason_to_be_lost():
    """The position in the map is uncertain by the way times the heading; not in the submap."""
    assert Level.LOST not in levels_in_corridor([(0.1 * k, 0.02, True) for k in range(60)])


def test_way_along_a_bare_corridor_is_by_odometry_alone():
    assert levels_in_corridor([(0.1 * k, 0.1 * k, True) for k in range(60)])[-1] is Level.LOST


def test_uncertainty_before_a_corridor_stays():
    gap = [(0.1, 0.02, True), (4.0, 4.0, False), (4.0, 4.0, True)]
    assert levels_in_corridor([*gap, *[(4.0, 4.0, True)] * 40])[-1] is Level.LOST


def test_map_that_grows_to_and_fro_is_no_reason_to_be_lost():
    """Near the start, the position is less uncertain; farther away it is what it was there."""
    begin, out = np.linspace(0.1, 0.8, 20), np.linspace(0.8, 3.0, 100)
    sigmas = np.concatenate([begin, out, out[::-1], out, out[::-1], 1.2 * out])
    seen = levels([(float(s), True, True) for s in sigmas])
    assert Level.LOST not in seen


@pytest.mark.parametrize('between', [0, 1])
def test_frames_without_a_scan_hide_no_scan_that_fits_nowhere(between):
    """Detections with stamps of their own, or a second lidar that sees nothing."""
    monitor, out = HealthMonitor(HealthLimits()), []
    for k in range(30):
        scan = ScanEvidence(has_scan=True, used=k < 5, misfit=k >= 5, score=0.6 if k < 5 else 0.1)
        for has_scan in (True, *[False] * between):
            own = scan if has_scan else ScanEvidence()
            step = HealthInputs(own, True, None, 0, 1e-4 * np.eye(3))
            stamp = FIRST + k * STEP + (not has_scan) * STEP // 2
            out.append(monitor.evaluate(stamp, step).level)
    assert Level.LOST in out
    assert Level.LOST not in out[: 10 * (1 + between)]


def test_scans_that_ended_are_no_misfit():
    monitor = HealthMonitor(HealthLimits())
    for k in range(60):
        scan = ScanEvidence(has_scan=k < 5, used=k < 5, score=0.6)
        level = monitor.evaluate(
            FIRST + k * STEP, HealthInputs(scan, True, 3, 3, 1e-4 * np.eye(3))
        )
        assert level.level is Level.OK


def test_reflectors_that_match_between_scans_that_do_not_keep_the_robot():
    """A crowd hides the walls from a lidar; the reflector device has stamps of its own."""
    monitor, out = HealthMonitor(HealthLimits()), []
    for k in range(60):
        bad = ScanEvidence(has_scan=True, used=k < 5, misfit=k >= 5, score=0.6 if k < 5 else 0.1)
        for step in (
            HealthInputs(bad, True, None, 0, 1e-4 * np.eye(3)),
            HealthInputs(ScanEvidence(), True, 4, 4, 1e-4 * np.eye(3)),
        ):
            stamp = FIRST + k * STEP + (step.detections is not None) * STEP // 2
            out.append(monitor.evaluate(stamp, step))
    assert Level.LOST not in [h.level for h in out]
    assert all('score 0.10' in h.reasons[0] for h in out if h.reasons)
    assert out[-1].level is Level.DEGRADED


def test_contradiction_lapses_where_nothing_is_seen_any_more():
    kidnapping = KidnappingDetection(HealthLimits())
    assert kidnapping.check(FIRST, True, False, 0, 0, False)
    assert kidnapping.holds(FIRST + STEP)
    assert kidnapping.since == FIRST
    assert kidnapping.holds(FIRST + 40 * STEP)  # a slow laser misses some
    assert not kidnapping.holds(FIRST + 60 * STEP)
    assert kidnapping.since is None


def test_reflectors_that_replaced_others_long_ago_say_nothing_of_those_in_view():
    kidnapping = KidnappingDetection(HealthLimits())
    assert kidnapping.check(FIRST, False, False, 3, 0, True)
    assert not kidnapping.holds(FIRST + 600 * STEP)
    assert not kidnapping.check(FIRST + 601 * STEP, False, False, 1, 0, True)
    assert kidnapping.since is None
