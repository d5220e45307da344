# SPDX-License-Identifier: Apache-2.0
import itertools
from dataclasses import replace

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.motion import SECOND, MotionBuffer
from rlml_slam.params import Node, Parameters
from rlml_slam.sensing.deskew import sweep_time
from rlml_slam.sensing.detection_frames import SIGMA
from rlml_slam.sensing.synchronization.stamp_check import PERSISTENT
from rlml_slam.sensing.synchronization.synchronizer import Synchronizer
from rlml_slam.sensing.synchronization.waiting_queue import PAIRING
from rlml_slam.types import Detections, Imu, Odometry, Scan

MS = SECOND // 1000
T0 = 10 * SECOND
SPEED, TURN = 0.8, 0.3


def pose_at(stamp):
    t = (stamp - T0) / SECOND
    return se2.exp(np.array([SPEED * t, 0.0, TURN * t]))


def odometry(stamp):
    return Odometry(stamp, pose_at(stamp))


def scan(stamp, ranges=(2.0, 3.0, np.nan, 4.0), frame='laser', time_increment=0.0):
    return Scan(
        stamp, frame, -1.0, min(0.5, 6.0 / max(len(ranges), 1)), time_increment, 0.1, 20.0,
        np.array(ranges, dtype=np.float32), np.zeros(0, dtype=np.float32),
    )  # fmt: skip


def detections(stamp, points=((2.0, 1.0),), frame='laser'):
    p = np.array(points, dtype=np.float64).reshape(-1, 2)
    n = len(p)
    cov = np.tile(np.diag([4e-4, 1e-4]), (n, 1, 1))
    return Detections(stamp, frame, p, cov, np.full(n, -1), np.full(n, np.nan))


def add(synchronizer, message):
    if isinstance(message, Odometry):
        return synchronizer.add_odometry(message)
    if isinstance(message, Imu):
        return synchronizer.add_imu(message)
    if isinstance(message, Scan):
        return synchronizer.add_scan(message)
    return synchronizer.add_detections(message)


def feed(synchronizer, inputs):
    return [o for m in inputs for o in add(synchronizer, m)]


def running(until=T0 + 3 * SECOND, **node):
    """A sequencer with 50 Hz of odometry, which is past its first second."""
    synchronizer = Synchronizer(Parameters(node=Node(**node)))
    feed(synchronizer, [odometry(t) for t in range(T0, until + 1, 20 * MS)])
    return synchronizer, until


def drive_inputs(seconds=3.0, imu=False):
    """Odometry at 50 Hz, pairs of scan and detections at 10 Hz, in order of stamps."""
    out = []
    for k in range(round(seconds * 50)):
        stamp = T0 + 20 * MS * k
        out.append(odometry(stamp))
        if imu:
            out.append(Imu(stamp, TURN))
        if k % 5 == 0:
            out += [scan(stamp), detections(stamp)]
    return out


# --- order and pairing -------------------------------------------------------------------------


def test_observations_come_in_order_of_stamps_once_each():
    synchronizer = Synchronizer(Parameters())
    out = feed(synchronizer, drive_inputs()) + synchronizer.flush()
    stamps = [o.stamp for o in out]
    assert stamps == list(range(T0, T0 + 3 * SECOND, 100 * MS))
    for o in out:
        assert o.points is not None
        assert len(o.detections) == 1
    assert synchronizer.inputs.totals()['scan'] == {'used': 30}


def test_order_of_arrival_does_not_matter_within_the_timeout():
    rng = np.random.default_rng(0)
    inputs = drive_inputs()
    odom = [m for m in inputs if isinstance(m, Odometry)]
    others = [m for m in inputs if not isinstance(m, Odometry)]
    # odometry in time; the rest up to 80 ms late, in an order of its own
    late = [(m.stamp + rng.uniform(0, 80 * MS), 1, k, m) for k, m in enumerate(others)]
    merged = sorted([(m.stamp, 0, k, m) for k, m in enumerate(odom)] + late)
    a, b = Synchronizer(Parameters()), Synchronizer(Parameters())
    x = feed(a, inputs) + a.flush()
    y = feed(b, [m for *_, m in merged]) + b.flush()
    assert [o.stamp for o in x] == [o.stamp for o in y]
    for p, q in zip(x, y, strict=True):
        np.testing.assert_array_equal(p.motion.delta, q.motion.delta)
        np.testing.assert_array_equal(p.points, q.points)
        np.testing.assert_array_equal(p.detections.points, q.detections.points)


def test_motion_is_that_between_the_stamps():
    synchronizer = Synchronizer(Parameters())
    out = feed(synchronizer, drive_inputs()) + synchronizer.flush()
    np.testing.assert_array_equal(out[0].motion.delta, 0.0)
    for a, b in itertools.pairwise(out[:-1]):
        # midpoint chords of 20 ms: (w dt)^2 = 4e-5 of 8 cm
        expected = se2.between(pose_at(a.stamp), pose_at(b.stamp))
        np.testing.assert_allclose(b.motion.delta, expected, atol=1e-6)
        assert b.motion.known
        np.testing.assert_allclose(b.odom_pose, pose_at(b.stamp), atol=1e-12)


@pytest.mark.parametrize('apart', [0, PAIRING])
def test_scan_and_detections_of_one_instant_are_one_observation(apart):
    synchronizer, t = running()
    t += 10 * MS
    out = feed(synchronizer, [scan(t), detections(t + apart), odometry(t + 20 * MS)])
    (o,) = out
    assert o.stamp == t
    assert o.points is not None
    assert o.detections is not None


def test_stamps_farther_apart_are_two_observations():
    synchronizer, t = running()
    inputs = [scan(t), detections(t + PAIRING + 1)]
    inputs += [odometry(t + k * 20 * MS) for k in range(1, 30)]
    a, b = feed(synchronizer, inputs)
    assert a.detections is None
    assert b.points is None
    assert b.stamp - a.stamp == PAIRING + 1


def test_scan_waits_for_odometry_that_covers_its_last_ray():
    synchronizer, t = running()
    sweep = 50 * MS
    s = scan(t, ranges=np.full(100, 3.0), time_increment=sweep / 100 / SECOND)
    assert (
        feed(synchronizer, [s, detections(t), odometry(t + 20 * MS), odometry(t + 40 * MS)]) == []
    )
    (o,) = add(synchronizer, odometry(t + 60 * MS))
    ends = [t + sweep * k // 3 for k in (1, 2, 3)]
    path = [se2.between(pose_at(t), pose_at(end)) for end in ends]
    np.testing.assert_allclose(o.sweep, path, atol=1e-6)


def test_lone_scan_waits_for_its_detections_only_if_they_use_to_come():
    synchronizer, t = running()
    # never paired so far: scan by scan without delay
    assert len(feed(synchronizer, [scan(t), odometry(t + 20 * MS)])) == 1
    t += 20 * MS
    assert len(feed(synchronizer, [scan(t), detections(t), odometry(t + 20 * MS)])) == 1
    t += 20 * MS
    # now they come in pairs: it waits, but not for ever
    assert feed(synchronizer, [scan(t), odometry(t + 20 * MS)]) == []
    released = feed(synchronizer, [odometry(t + k * 20 * MS) for k in range(2, 12)])
    assert [o.stamp for o in released] == [t]


def test_nothing_waits_longer_than_the_timeout():
    synchronizer, t = running(odom_timeout=0.2)
    # odometry has stopped; only scans arrive
    out = feed(synchronizer, [scan(t + k * 100 * MS) for k in range(1, 8)])
    assert [o.stamp for o in out] == [t + k * 100 * MS for k in range(1, 5)]
    assert synchronizer.inputs.counts['scan']['waited_out'] == 4
    assert not out[-1].motion.known
    assert len(synchronizer.flush()) == 3


def test_without_odometry_scans_alone_go_through_after_a_second():
    synchronizer = Synchronizer(Parameters())
    inputs = [scan(T0 + k * 100 * MS) for k in range(30)]
    out = feed(synchronizer, inputs) + synchronizer.flush()
    assert len(out) == 30
    assert all(not o.motion.known and o.odom_pose is None for o in out[1:])
    synchronizer = Synchronizer(Parameters(node=Node(use_odom=False)))
    out = feed(synchronizer, [odometry(T0), *inputs]) + synchronizer.flush()
    assert len(out) == 30
    assert 'odom' not in synchronizer.inputs.counts


def test_switched_off_inputs_are_not_used():
    node = Node(use_imu=False, use_reflectors=False, use_scan=False)
    synchronizer = Synchronizer(Parameters(node=node))
    out = feed(synchronizer, drive_inputs(imu=True)) + synchronizer.flush()
    assert len(out) == 30
    assert all(o.points is None and o.scan is None and o.detections is None for o in out)
    assert set(synchronizer.inputs.counts) == {'odom', 'scan'}


# --- bad input ---------------------------------------------------------------------------------


def test_late_and_duplicate_inputs_are_counted_and_left_out():
    synchronizer, t = running()
    t += 10 * MS
    feed(synchronizer, [scan(t), detections(t), odometry(t + 20 * MS)])
    before = synchronizer.buffer.newest
    assert feed(synchronizer, [scan(t), scan(t - 50 * MS), detections(t - 50 * MS)]) == []
    assert feed(synchronizer, [odometry(t + 20 * MS), odometry(t)]) == []
    counts = synchronizer.inputs.totals()
    assert counts['scan'] == {'duplicate': 1, 'late': 1, 'used': 1}
    assert counts['reflectors'] == {'late': 1, 'used': 1}
    assert counts['odom']['duplicate'] == counts['odom']['late'] == 1
    assert synchronizer.buffer.newest == before


def test_scan_in_millimetres_is_named_and_codes_for_no_return_are_not():
    synchronizer, t = running()
    in_mm = replace(scan(t, (400.0, 2100.0, 9000.0, 30000.0)), range_max=30000.0)
    assert add(synchronizer, in_mm) == []
    assert 'are they in millimetres?' in synchronizer.inputs.last_error
    assert add(synchronizer, replace(in_mm, ranges=np.array([0, 0, 0, 4e3, 9e3], 'f4'))) == []
    assert synchronizer.inputs.counts['scan']['invalid'] == 2
    coded = replace(scan(t, (4.0, 65535.0, 65535.0, 65535.0)), range_max=65535.0)
    assert len(feed(synchronizer, [coded, odometry(t + 20 * MS)])) == 1


@pytest.mark.parametrize(
    ('stream', 'bad'),
    [
        ('odom', Odometry(T0 + 4 * SECOND, np.array([np.nan, 0.0, 0.0]))),
        ('odom', Odometry(T0 + 4 * SECOND, np.array([0.0, 0.0]))),
        ('odom', Odometry(-5, np.zeros(3))),
        ('imu', Imu(T0 + 4 * SECOND, float('inf'))),
        ('imu', Imu(0, 0.1)),
        ('scan', scan(T0 + 4 * SECOND, ranges=())),
        ('scan', replace(scan(T0 + 4 * SECOND), angle_min=float('nan'))),
        ('scan', replace(scan(T0 + 4 * SECOND), angle_increment=0.0)),
        ('scan', replace(scan(T0 + 4 * SECOND), angle_increment=3.0)),
        ('scan', replace(scan(T0 + 4 * SECOND), angle_increment=1e-9)),
        ('scan', replace(scan(T0 + 4 * SECOND), angle_min=-25.0)),
        ('scan', replace(scan(T0 + 4 * SECOND), time_increment=float('inf'))),
        ('scan', replace(scan(T0 + 4 * SECOND, (4e2, 2e3, np.nan, 9e3, 3e4)), range_max=3e4)),
        ('reflectors', detections(T0 + 4 * SECOND, ((np.nan, 1.0),))),
        (
            'reflectors',
            replace(detections(T0 + 4 * SECOND), cov=np.full((1, 2, 2), np.inf)),
        ),
    ],
)
def test_invalid_input_is_counted_and_costs_nothing(stream, bad):
    synchronizer, t = running()
    assert add(synchronizer, bad) == []
    assert synchronizer.inputs.counts[stream]['invalid'] == 1
    assert stream in synchronizer.inputs.last_error
    assert synchronizer.flush() == []
    (o,) = feed(synchronizer, [scan(t), detections(t), odometry(t + 20 * MS)])
    assert o.motion.known


@pytest.mark.parametrize(
    'change', [{'time_increment': 0.0}, {'angle_increment': 0.02}, {'angle_min': -0.5}]
)
def test_single_scan_of_another_sweep_is_left_out(change):
    synchronizer, _ = running(until=T0)
    for k in range(60):
        sweep = scan(T0 + k * 100 * MS, np.full(100, 3.0) + 0.1 * k, time_increment=5e-4)
        add(synchronizer, replace(sweep, **change) if k == 50 else sweep)
    assert synchronizer.inputs.counts['scan']['invalid'] == 1
    assert 'of another sensor' in synchronizer.inputs.last_error


def test_scans_that_are_cut_off_are_used():
    """Packets were lost, or the driver trims: the beams that are there are where they were."""
    synchronizer, rng = running(until=T0)[0], np.random.default_rng(0)
    for k in range(200):
        n = 100 if k % 5 else int(rng.integers(20, 100))
        sweep = scan(T0 + k * 100 * MS, np.full(n, 3.0) + 0.01 * k, time_increment=5e-4)
        add(synchronizer, replace(sweep, angle_increment=0.06))
    assert 'invalid' not in synchronizer.inputs.counts['scan']


def test_scan_without_a_single_return_is_an_observation_without_points():
    synchronizer, t = running()
    (o,) = feed(
        synchronizer, [scan(t, ranges=[np.nan, np.inf, -np.inf, 50.0]), detections(t),
                    odometry(t + 20 * MS)],
    )  # fmt: skip
    assert o.points.shape == (0, 2)


def test_unknown_frame_is_refused_and_named():
    synchronizer, t = running()
    # the first frame gets the parameter's pose, another one has none
    assert len(feed(synchronizer, [scan(t), odometry(t + 20 * MS)])) == 1
    assert feed(synchronizer, [scan(t + 20 * MS, frame='attic')]) == []
    assert synchronizer.inputs.counts['scan']['invalid'] == 1
    assert "'attic'" in synchronizer.inputs.last_error
    synchronizer.set_sensor_pose('attic', np.zeros(3))
    assert len(feed(synchronizer, [scan(t + 20 * MS, frame='attic'), odometry(t + 40 * MS)])) == 1


def test_detections_are_moved_from_their_sensor_to_the_base():
    synchronizer, t = running(use_scan=False)
    T = np.array([0.5, 0.2, np.pi / 2])
    synchronizer.set_sensor_pose('mast', T)
    # one is too far, and one in the sensor itself: some drivers report an empty scan this way
    seen = ((2.0, 1.0), (300.0, 0.0), (0.0, 0.0))
    (o,) = feed(synchronizer, [detections(t, seen, frame='mast')])
    np.testing.assert_allclose(o.detections.points, [[-0.5, 2.2]], atol=1e-12)
    np.testing.assert_allclose(o.detections.cov[0], np.diag([1e-4, 4e-4]), atol=1e-15)
    assert o.detections.frame_id == 'base_link'
    assert synchronizer.inputs.counts['reflectors']['points_out_of_range'] == 1


def test_single_stamps_far_ahead_are_left_out():
    synchronizer, t = running()
    assert feed(synchronizer, [odometry(t + 100 * SECOND), scan(t + 100 * SECOND)]) == []
    more = [odometry(t + k * 20 * MS) for k in range(1, 5)]
    (o,) = feed(synchronizer, [scan(t), detections(t), *more])
    assert o.motion.known
    assert synchronizer.inputs.counts['odom']['future'] == 1
    assert synchronizer.inputs.counts['scan']['future'] == 1


def test_clock_that_stays_ahead_is_followed():
    synchronizer, t = running()
    ahead = t + 100 * SECOND
    feed(synchronizer, [odometry(ahead + k * 20 * MS) for k in range(100)])
    s = ahead + 50 * 20 * MS
    out = feed(synchronizer, [scan(s), detections(s), odometry(ahead + 2 * SECOND)])
    assert [o.stamp for o in out] == [s]
    assert 'future' not in synchronizer.inputs.counts['odom']


@pytest.mark.parametrize('pause', [1.5, 8.0, 60.0])
@pytest.mark.parametrize('odometry_too', [True, False])
def test_nothing_is_lost_across_a_pause_of_everything(pause, odometry_too):
    later = int(pause * SECOND)
    inputs = [m for m in drive_inputs() if odometry_too or not isinstance(m, Odometry)]
    again = [replace(m, stamp=m.stamp + 3 * SECOND + later) for m in inputs]
    # the last of them begin a second pause: the end of the data is no reason to lose them
    last = [replace(m, stamp=m.stamp + 10 * SECOND + 2 * later) for m in inputs[:2]]
    synchronizer = Synchronizer(Parameters())
    out = feed(synchronizer, [*inputs, *again, *last]) + synchronizer.flush()
    assert len(out) == 61
    assert synchronizer.inputs.counts['scan']['used'] == 61
    if odometry_too:
        assert synchronizer.inputs.counts['odom'] == {'used': 301}
    assert all('future' not in c for c in synchronizer.inputs.counts.values())


@pytest.mark.parametrize('ahead', [5, 12, 25])
@pytest.mark.parametrize('stream', ['odom', 'imu', 'scan', 'reflectors'])
def test_one_stamp_ahead_costs_no_observation(ahead, stream):
    inputs = drive_inputs(imu=True)
    late = T0 + SECOND + ahead * SECOND
    bad = {
        'odom': odometry(late), 'imu': Imu(late, 0.0), 'scan': scan(late),
        'reflectors': detections(late),
    }[stream]  # fmt: skip
    for at in (0, len(inputs) // 2):
        synchronizer = Synchronizer(Parameters())
        out = feed(synchronizer, [*inputs[:at], bad, *inputs[at:]]) + synchronizer.flush()
        assert synchronizer.inputs.counts[stream]['future'] == 1
        known = [o for o in out if o.motion.known and o.odom_pose is not None]
        # nothing else shows that the first message is wrong
        assert len(known) >= 30 - (0 if at else 3)
        assert max(o.stamp for o in out) < late


@pytest.mark.parametrize('stream', ['odom', 'imu', 'scan'])
def test_stamp_less_than_a_second_ahead_costs_no_later_message(stream):
    inputs, late = drive_inputs(imu=True), T0 + 2 * SECOND + 711 * MS
    bad = {'odom': Odometry(late, pose_at(T0)), 'imu': Imu(late, 9.0), 'scan': scan(late)}[stream]
    clean, synchronizer = Synchronizer(Parameters()), Synchronizer(Parameters())
    feed(clean, inputs)
    at = 2 * len(inputs) // 3
    out = feed(synchronizer, [*inputs[:at], bad, *inputs[at:]])
    counts, before = synchronizer.inputs.counts[stream], clean.inputs.counts[stream]
    assert counts['future'] == 1
    assert counts['used'] == before['used']
    assert counts['late'] == (stream != 'scan')  # the first of the two that show it
    assert late not in [o.stamp for o in out]


def test_late_odometry_costs_no_newer_one():
    inputs = drive_inputs()
    old = [odometry(T0 + k * MS) for k in (3, 4, 1503, 1504)]
    synchronizer = Synchronizer(Parameters())
    feed(synchronizer, [*inputs[:150], *old, *inputs[150:]])
    assert synchronizer.inputs.counts['odom'] == {'used': 150, 'late': 4}


def test_turn_rate_of_no_robot_and_jump_of_odometry_are_counted():
    synchronizer, now = running()
    synchronizer.add_imu(Imu(now, 50.0))
    synchronizer.add_odometry(Odometry(now + 10 * MS, np.array([1e4, 0.0, 0.0])))
    synchronizer.add_odometry(odometry(now + 20 * MS))
    assert synchronizer.inputs.counts['imu'] == {'invalid': 1}
    assert '50 rad/s' in synchronizer.inputs.first_errors['imu']
    assert synchronizer.inputs.counts['odom'] == {'used': 152, 'jump': 1}


@pytest.mark.parametrize('wrong', [{'frame_id': 'base_link'}, {'angle_min': 0.0}])
def test_single_scans_of_another_sensor_are_refused_and_named(wrong):
    inputs = drive_inputs(seconds=12.0)
    at = [k for k, m in enumerate(inputs) if isinstance(m, Scan)][30::25]
    for k in at:
        inputs[k] = replace(inputs[k], stamp=inputs[k].stamp + MS, **wrong)
    bad = [inputs[k] for k in at]
    synchronizer = Synchronizer(Parameters())
    used = {o.stamp for o in feed(synchronizer, inputs) if o.scan is not None}
    assert len(bad) > 2
    assert not used & {m.stamp for m in bad}
    assert synchronizer.inputs.counts['scan']['invalid'] == len(bad)


def test_first_stamp_of_another_clock_is_found_out():
    """A message stamped by the wall clock before simulated time."""
    synchronizer = Synchronizer(Parameters())
    inputs = [Imu(T0 + 10**9 * SECOND, 0.0), *drive_inputs()]
    out = feed(synchronizer, inputs) + synchronizer.flush()
    assert len(out) >= 28
    assert all(o.motion.known for o in out[3:])
    assert synchronizer.inputs.counts['imu']['future'] == 1


def test_clock_that_stays_back_is_an_error():
    synchronizer, t = running(until=T0 + 60 * SECOND)
    feed(synchronizer, [scan(t), odometry(t + 20 * MS)])
    start = T0 + 20 * SECOND
    for k in range(PERSISTENT - 1):
        assert add(synchronizer, odometry(start + k * 20 * MS)) == []
    with pytest.raises(InputError, match=r'clock of odom jumped back by \d+'):
        add(synchronizer, odometry(start + SECOND))


# --- long times without observations, and the end of odometry ----------------------------------


@pytest.mark.parametrize('gap', [5.0, 31.0])
def test_motion_carried_over_a_long_time_is_the_direct_motion(gap):
    params = Parameters()
    synchronizer = Synchronizer(params)
    direct = MotionBuffer(params.motion, 1000.0)
    first, last = T0 + 2 * SECOND, T0 + 2 * SECOND + round(gap * SECOND)
    out = []
    for stamp in range(T0, last + 100 * MS, 20 * MS):
        direct.add_odometry(odometry(stamp))
        out += add(synchronizer, odometry(stamp))
        if stamp in (first, last):
            out += feed(synchronizer, [scan(stamp), detections(stamp)])
    _, b = out + synchronizer.flush()
    expected = direct.motion(first, last)
    assert b.stamp == last
    assert b.motion.known
    np.testing.assert_allclose(b.motion.delta, expected.delta, atol=1e-6)
    np.testing.assert_allclose(b.motion.cov, expected.cov, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize('gap', [4.0, 10.0, 31.0])
def test_odometry_after_a_gap_of_everything_tells_the_motion_in_it(gap):
    """The last scan before the gap waits for odometry until after it; the next comes at once."""
    synchronizer, t = running()
    out = feed(synchronizer, [scan(t + 50 * MS)])
    after = t + round(gap * SECOND)
    for k in range(6):
        out += add(synchronizer, odometry(after + k * 20 * MS))
        if k == 2:
            out += feed(synchronizer, [scan(after + 50 * MS)])
    seen = {o.stamp: o for o in out + synchronizer.flush()}
    first = seen[after + 50 * MS]
    assert first.motion.known
    moved = se2.between(pose_at(t + 50 * MS), pose_at(after + 50 * MS))
    np.testing.assert_allclose(first.motion.delta, moved, atol=0.2)
    assert (np.sqrt(np.diag(first.motion.cov)) < 0.1 * gap + 0.5).all()


def stalled(imu=False):
    """Observations every 100 ms while odometry stalls, and the first one after it goes on."""
    synchronizer, t = running()
    out = feed(synchronizer, [scan(t), detections(t), odometry(t + 20 * MS)])
    stamps = [t + k * 100 * MS for k in range(1, 12)]
    for s in stamps:
        if imu:
            rates = [Imu(r, TURN) for r in range(s - 100 * MS, s + 20 * MS, 10 * MS)]
            out += feed(synchronizer, rates)
        out += feed(synchronizer, [scan(s), detections(s)])
    out += feed(synchronizer, [odometry(t + k * 20 * MS) for k in range(52, 60)])
    assert [o.stamp for o in out] == [t, *stamps]
    return t, out[1:]


def test_motion_after_a_stall_is_that_since_the_last_observation():
    """What is seen during a stall says where the robot is: nothing of it is to be made good."""
    _, out = stalled()
    known = [o.motion.known for o in out]
    assert known == sorted(known)
    assert 2 <= sum(known) <= len(known) - 3
    for before, o in itertools.pairwise(out):
        moved = se2.between(pose_at(before.stamp), pose_at(o.stamp))
        if o.motion.known:
            np.testing.assert_allclose(o.motion.delta, moved, atol=1e-3)
        else:
            assert 0.0 <= o.motion.delta[0] < 1.01 * moved[0]


def test_uncertainty_of_a_stall_grows_with_its_length_alone():
    """One unknown speed: the deviation grows with time, in however many parts it is counted."""
    t, out = stalled()
    parts = [o.motion for o in out if not o.motion.known]
    total = np.sum([m.cov[:2, :2] for m in parts], axis=0)
    whole = running()[0].buffer
    whole = whole.extrapolate(t, t + len(parts) * 100 * MS).cov[:2, :2]
    np.testing.assert_allclose(np.trace(total), np.trace(whole), rtol=0.1)


def test_imu_tells_the_turn_while_odometry_stalls():
    _, without = stalled()
    _, out = stalled(imu=True)
    stall = [o.motion for o in out if not o.motion.known][2:]
    for m in stall:
        assert m.delta[2] == pytest.approx(0.1 * TURN, rel=1e-6)
        assert m.bias_gain[2] == pytest.approx(-0.1)
        assert m.cov[2, 2] < 0.01 * without[4].motion.cov[2, 2]


def test_imu_refines_the_motion_between_observations():
    synchronizer = Synchronizer(Parameters())
    out = feed(synchronizer, drive_inputs(imu=True)) + synchronizer.flush()
    m = out[15].motion
    assert m.bias_gain[2] == pytest.approx(-0.1)
    assert m.bias == pytest.approx(0.0, abs=1e-9)
    assert np.isfinite(m.bias_var)


# --- several lidars ----------------------------------------------------------------------------


def two_lidars(offset, delay, seconds=3.0):
    """Odometry at 50 Hz and two lidars at 10 Hz; the rear one's scans are ``offset`` later.

    The front one's arrive ``delay`` after their stamps, the others at once.
    """
    rows = []
    for k in range(round(seconds * 50)):
        stamp = T0 + 20 * MS * k
        rows.append((stamp, 0, odometry(stamp)))
        if k % 5 == 0:
            rows.append((stamp + delay, 1, scan(stamp, frame='front')))
            rows.append((stamp + offset, 2, scan(stamp + offset, (5.0, 6.0), frame='rear')))
    return [m for *_, m in sorted(rows, key=lambda r: r[:2])]


def two_lidar_sequencer():
    synchronizer = Synchronizer(Parameters())
    synchronizer.set_sensor_pose('front', np.array([0.3, 0.0, 0.0]))
    synchronizer.set_sensor_pose('rear', np.array([-0.3, 0.0, np.pi]))
    return synchronizer


# at once, at the same instant within drivers' rounding, and in between
@pytest.mark.parametrize('offset', [0, MS, 30 * MS])
@pytest.mark.parametrize('delay', [0, 90 * MS])
def test_each_scan_of_two_lidars_is_used_from_its_own_place(offset, delay):
    synchronizer = two_lidar_sequencer()
    out = feed(synchronizer, two_lidars(offset, delay)) + synchronizer.flush()
    # the first period is not known yet: by then the rear lidar's first scan may have been used
    lost = 1 if delay > offset else 0
    assert synchronizer.inputs.totals()['scan'].get('late', 0) <= lost
    stamps = [o.stamp for o in out]
    assert stamps == sorted(set(stamps))
    for frame, x, n in (('front', 0.3, 4), ('rear', -0.3, 2)):
        own = [o for o in out if o.scan.frame_id == frame]
        assert 30 - lost <= len(own) <= 30
        assert all(abs(o.stamp - o.scan.stamp) <= 1 for o in own)
        assert all(o.origin[0] == x and len(o.scan.ranges) == n for o in own)


def test_silent_lidar_is_not_waited_for():
    synchronizer = two_lidar_sequencer()
    inputs = two_lidars(30 * MS, 0)
    half = T0 + SECOND
    silent = [
        m for m in inputs if not isinstance(m, Scan) or m.frame_id == 'rear' or m.stamp < half
    ]
    out = feed(synchronizer, silent) + synchronizer.flush()
    assert [o.scan.frame_id for o in out].count('rear') == 30
    # while it may still come, the other waits as long as for anything else
    assert synchronizer.inputs.totals()['scan']['waited_out'] <= 10


@pytest.mark.parametrize('increment', [1.0, -1e-4, 1e6])
def test_sweep_of_impossible_length_is_cut_and_holds_nothing_up(increment):
    synchronizer = Synchronizer(Parameters())
    out = []
    for k in range(1, 40):
        stamp = k * 100_000_000
        out += synchronizer.add_odometry(Odometry(stamp, np.array([0.01 * k, 0.0, 0.0])))
        out += synchronizer.add_scan(scan(stamp, time_increment=0.0 if k % 2 else increment))
    assert synchronizer.inputs.totals()['scan'] == {'used': len(out), 'sweep_time': 19}
    assert 'time_increment' in synchronizer.inputs.last_error
    assert len(out) >= 37
    assert all(0.0 <= sweep_time(o.scan) <= 0.11 for o in out)


@pytest.mark.parametrize('sigma', [1e-8, 1e5, 1e19])
def test_sigma_that_nobody_can_mean_is_bounded_and_counted(sigma):
    synchronizer = Synchronizer(Parameters())
    d = detections(200_000_000)
    d = replace(d, cov=np.broadcast_to(sigma**2 * np.eye(2), d.cov.shape))
    synchronizer.add_odometry(Odometry(100_000_000, np.zeros(3)))
    synchronizer.add_detections(d)
    (observation,) = synchronizer.flush()
    values = np.sqrt(np.linalg.eigvalsh(observation.detections.cov))
    assert 0.99 * SIGMA[0] <= values.min() <= values.max() <= 1.01 * SIGMA[1]
    assert synchronizer.inputs.totals()['reflectors']['sigma_bounded'] == 1


def test_scan_that_is_sent_again_while_the_robot_drives_is_left_out():
    ranges = np.random.default_rng(0).uniform(1.0, 9.0, 100)
    synchronizer, _ = running(until=T0)
    stamps = [T0 + k * 100 * MS for k in range(8)]
    inputs = []
    for k, stamp in enumerate(stamps):
        sent = ranges if k < 5 else ranges + 0.01 * k  # then the driver is well again
        inputs += [scan(stamp, sent), detections(stamp)]
        inputs += [odometry(stamp + j * 20 * MS) for j in range(1, 6)]
    out = feed(synchronizer, inputs) + synchronizer.flush()
    assert [o.stamp for o in out] == stamps
    # 8 cm in each interval
    assert [o.points is not None for o in out] == [True, *[False] * 4, True, True, True]
    assert [o.detections is not None for o in out] == [o.points is not None for o in out]
    assert synchronizer.inputs.counts['scan']['repeated'] == 4
    moved = se2.between(pose_at(stamps[0]), pose_at(stamps[5]))
    way = np.zeros(3)
    for o in out[1:6]:
        way = se2.compose(way, o.motion.delta)
    np.testing.assert_allclose(way, moved, atol=1e-6)


def test_scan_between_a_gap_of_all_messages_and_the_first_odometry_is_left_out():
    """Where it was is not known; where the next one is, the odometry says across the gap."""
    synchronizer, t = running()
    assert len(feed(synchronizer, [scan(t)])) == 1
    back = t + 30 * SECOND
    early, later = scan(back - 500 * MS), scan(back + 100 * MS)
    after = [odometry(back + k * 20 * MS) for k in range(20)]
    out = feed(synchronizer, [early, *after[:8], later, *after[8:]])
    assert [o.stamp for o in out] == [later.stamp]
    assert synchronizer.inputs.totals()['scan']['in_gap'] == 1
    assert out[0].motion.known
    np.testing.assert_allclose(
        out[0].motion.delta[:2], se2.between(pose_at(t), pose_at(later.stamp))[:2], atol=0.01
    )
