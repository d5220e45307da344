# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.params import (
    Gyro,
    Laser,
    Markers,
    Simulator,
    SimulatorParameters,
    Transport,
    Wheels,
)
from rlml_slam.simulation.robot import SECOND, RouteFollower
from rlml_slam.simulation.simulation import START, GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world, world_names
from rlml_slam.types import Detections, Imu, Odometry, Scan

SHORT = SimulatorParameters(
    node=Simulator(duration=4.0, still_time=0.5), laser=Laser(beams=180), markers=Markers()
)

# a whole drive with few messages
CALM = SimulatorParameters(
    node=Simulator(truth_rate=5.0), wheels=Wheels(rate=1.0), gyro=Gyro(rate=1.0)
)


def run(parameters=SHORT, world='hall', seed=0):
    return list(Simulation(load_world(world), parameters, seed=seed))


def of(events, kind):
    return [e.message for e in events if isinstance(e.message, kind)]


def same(a, b):
    """Whether two messages are the same bit for bit."""
    if type(a) is not type(b):
        return False
    fields = [f.name for f in dataclasses.fields(a)]
    return all(
        np.array_equal(
            np.asarray(getattr(a, f)),
            np.asarray(getattr(b, f)),
            equal_nan=f not in ('frame_id', 'ids', 'stamp'),
        )
        for f in fields
    )


def all_same(a, b):
    return len(a) == len(b) and all(map(same, a, b))


def test_a_seed_gives_the_same_messages_bit_for_bit():
    a, b = run(), run()
    assert [e.time for e in a] == [e.time for e in b]
    assert all_same([e.message for e in a], [e.message for e in b])
    other = run(seed=1)
    for kind in (Odometry, Imu, Scan, Detections, GroundTruth):
        assert not all_same(of(a, kind), of(other, kind))


def test_stepping_gives_what_iterating_gives():
    simulation = Simulation(load_world('hall'), SHORT, seed=0)
    stepped = []
    while not simulation.done:
        events = simulation.step()
        assert all(e.time <= simulation.time for e in events)
        stepped += events
    whole = run()
    assert all_same([e.message for e in stepped], [e.message for e in whole][: len(stepped)])
    # what is left is the truth and inertia of nothing: no message was on its way
    assert len(whole) == len(stepped)


def test_every_sensor_has_its_rate_and_time_goes_on():
    events = run()
    times = [e.time for e in events]
    assert times == sorted(times)
    for kind, period in [(Odometry, 20), (Imu, 10), (GroundTruth, 20), (Scan, 100)]:
        stamps = np.array([m.stamp for m in of(events, kind)])
        assert stamps[0] == START
        assert (np.diff(stamps) == period * 1_000_000).all()
    assert len(of(events, Scan)) == 40


@pytest.mark.parametrize('rate', [10.0, 40.0, 15.0])
def test_a_scan_arrives_after_its_last_ray_and_its_detections_after_it(rate):
    events = run(dataclasses.replace(SHORT, laser=Laser(beams=360, rate=rate)))
    waiting = None
    for event in events:
        m = event.message
        if isinstance(m, Scan):
            assert event.time >= m.stamp + round(m.time_increment * 359 * SECOND)
            assert waiting is None
            waiting = m.stamp
        elif isinstance(m, Detections):
            assert m.stamp == waiting
            waiting = None
        elif isinstance(m, Odometry | Imu | GroundTruth):
            assert event.time == m.stamp
    assert abs(len(of(events, Scan)) - 4 * rate) <= 1


def test_the_map_begins_at_the_robots_start():
    simulation = Simulation(load_world('hall'), SHORT)
    events = list(simulation)
    truths = of(events, GroundTruth)
    np.testing.assert_allclose(truths[0].T_map_base, 0.0, atol=1e-12)
    for t in truths[::20]:
        np.testing.assert_allclose(
            se2.compose(simulation.T_world_map, t.T_map_base), t.T_world_base, atol=1e-12
        )
    points, ids = simulation.true_reflectors()
    world = simulation.world
    np.testing.assert_allclose(points + world.start[:2], world.reflectors.points)  # start at 0 deg
    assert np.array_equal(ids, world.reflectors.ids)


def test_detections_seen_from_the_truth_are_the_reflectors():
    parameters = dataclasses.replace(
        SHORT, markers=Markers(sigma_range=0.0, sigma_bearing=0.0, ids=True, false_detections=0.0)
    )
    simulation = Simulation(load_world('hall'), parameters)
    seen = of(list(simulation), Detections)
    points, ids = simulation.true_reflectors()
    assert sum(map(len, seen)) > 50
    for d in seen:
        T_map_laser = se2.compose(simulation.truth(d.stamp).T_map_base, [0.2, 0.0, 0.0])
        want = points[np.searchsorted(ids, d.ids)]
        np.testing.assert_allclose(se2.transform(T_map_laser, d.points), want, atol=1e-9)


@pytest.mark.parametrize(
    ('change', 'changed'),
    [
        ({'wheels': Wheels(slip_rate=5.0)}, Odometry),
        ({'wheels': Wheels(speed_scale=1.1)}, Odometry),
        ({'gyro': Gyro(bias=0.05)}, Imu),
        ({'gyro': Gyro(bias_walk=0.01)}, Imu),
        ({'laser': Laser(beams=180, range_sigma=0.05)}, Scan),
        ({'laser': Laser(beams=180, dropout_share=0.1)}, Scan),
        ({'markers': Markers(false_detections=1.0)}, Detections),
        ({'markers': Markers(missed_share=0.5)}, Detections),
        ({'markers': Markers(sigma_range=0.1)}, Detections),
    ],
)
def test_a_fault_of_one_sensor_leaves_all_others_as_they_were(change, changed):
    before, after = run(), run(dataclasses.replace(SHORT, **change))
    for kind in (Odometry, Imu, Scan, Detections, GroundTruth):
        assert all_same(of(before, kind), of(after, kind)) == (kind is not changed), kind


def test_missing_reflectors_leave_the_noise_of_the_others():
    markers = Markers(ids=True, false_detections=0.0, missed_share=0.0)
    full = of(run(dataclasses.replace(SHORT, markers=markers)), Detections)
    markers = dataclasses.replace(markers, missed_share=0.4)
    some = of(run(dataclasses.replace(SHORT, markers=markers)), Detections)
    assert sum(map(len, some)) < 0.75 * sum(map(len, full))
    for a, b in zip(full, some, strict=True):
        assert np.array_equal(a.points[np.isin(a.ids, b.ids)], b.points)


def test_dropped_messages_are_missing_and_nothing_else_changes():
    before = run()
    after = run(dataclasses.replace(SHORT, transport=Transport(lost_share=0.2)))
    for kind in (Odometry, Imu, Scan, Detections):
        a, b = of(before, kind), of(after, kind)
        n = len(a)
        assert abs(len(b) - 0.8 * n) < 4 * math.sqrt(0.16 * n)
        stamps = {m.stamp for m in b}
        assert all_same([m for m in a if m.stamp in stamps], b)
    assert len(of(after, GroundTruth)) == len(of(before, GroundTruth))


def test_late_messages_arrive_later_and_complete():
    before = run()
    after = run(dataclasses.replace(SHORT, transport=Transport(late_share=0.3, late_delay=0.5)))
    times = [e.time for e in after]
    assert times == sorted(times)
    for kind in (Odometry, Imu, Scan, Detections):
        assert all_same(of(before, kind), sorted(of(after, kind), key=lambda m: m.stamp))
    delay = np.array([e.time - e.message.stamp for e in after if isinstance(e.message, Odometry)])
    late = delay[delay > 0]
    assert 0.1 < len(late) / len(delay) < 0.5
    assert 0.4 * SECOND < late.max() <= 0.5 * SECOND


def test_jitter_moves_stamps_by_its_sigma_and_detections_with_their_scan():
    before = run()
    after = run(dataclasses.replace(SHORT, transport=Transport(jitter=0.002)))
    a = np.array([m.stamp for m in of(before, Imu)])
    b = np.array([m.stamp for m in of(after, Imu)])
    assert (b - a).std() / SECOND == pytest.approx(0.002, rel=4 / math.sqrt(2 * len(a)))
    stamps = [m.stamp for m in of(after, Scan)]
    assert stamps == [m.stamp for m in of(after, Detections)]
    assert stamps != [m.stamp for m in of(before, Scan)]


def test_no_detector_is_silence():
    events = run(dataclasses.replace(SHORT, markers=Markers(enabled=False)))
    assert not of(events, Detections)
    assert all_same(of(events, Scan), of(run(), Scan))


def test_nothing_that_moves_comes_near_the_robot():
    for name in ('hall', 'room'):
        world = load_world(name)
        parameters = dataclasses.replace(CALM, laser=Laser(rate=0.5, beams=2))
        truths = of(list(Simulation(world, parameters)), GroundTruth)
        for t in truths:
            for mover in world.movers:
                pose, _ = mover.pose_at((t.stamp - START) / SECOND)
                reach = 0.5 * math.hypot(*mover.size)
                assert np.hypot(*(pose - t.T_world_base)[:2]) > reach + 0.4


def test_the_robot_keeps_clear_of_walls_in_every_world():
    for name in world_names():
        laser = Laser(beams=90, rate=2.0, dropout_share=0.0, range_sigma=0.0)
        scans = of(run(dataclasses.replace(CALM, laser=laser), name), Scan)
        assert min(float(s.ranges.min()) for s in scans) > 0.4


def test_worlds_can_lose_their_reflectors_and_movers():
    world = load_world('hall').without_reflectors().without_movers()
    seen = of(list(Simulation(world, SHORT)), Detections)
    assert seen
    assert sum(map(len, seen)) <= 2  # ghosts


def test_carried_robot_is_elsewhere_on_its_route_and_only_sight_tells():
    world = load_world('room')
    p = SimulatorParameters(node=Simulator(duration=8.0, kidnap_time=6.0, kidnap_distance=5.0))
    q = dataclasses.replace(p, node=dataclasses.replace(p.node, kidnap_time=0.0))
    carried, left = (list(Simulation(world, c, seed=3)) for c in (p, q))
    before = [e for e in carried if e.time < START + 6 * SECOND]
    assert [e.time for e in before] == [e.time for e in left if e.time < START + 6 * SECOND]
    path = {
        e.message.stamp: e.message.T_world_base
        for e in carried
        if isinstance(e.message, GroundTruth)
    }
    steps = {
        t: np.hypot(*(path[t][:2] - path[last][:2]))
        for last, t in zip(list(path), list(path)[1:], strict=False)
    }
    jumps = {t: d for t, d in steps.items() if d > 0.1}
    (stamp,) = jumps
    assert stamp == START + 6 * SECOND
    # the route has corners: the straight way is shorter
    assert 3.0 < jumps[stamp] <= 5.2
    route = RouteFollower(world.route, p.node)
    dense = np.array([route.point(s) for s in np.arange(0.0, route.length, 0.05)])
    assert np.hypot(*(dense - path[stamp][:2]).T).min() < 0.05
    # wheels and gyro feel nothing of it
    rates = [e.message.yaw_rate for e in carried if isinstance(e.message, Imu)]
    assert np.abs(rates).max() < 1.5
    odometry = [e.message.pose for e in carried if isinstance(e.message, Odometry)]
    assert np.hypot(*np.diff(np.array(odometry)[:, :2], axis=0).T).max() < 0.03
