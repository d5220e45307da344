# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.errors import InputError
from rlml_slam.params import Simulator, SimulatorParameters, Wheels
from rlml_slam.simulation.robot import SECOND, RouteFollower, Track
from rlml_slam.simulation.simulation import START, STEP, GroundTruth, Simulation
from rlml_slam.simulation.world_file import load_world, parse_world, world_names

QUIET = SimulatorParameters(wheels=Wheels(lateral_noise=0.0))


def truths(simulation):
    return [e.message for e in simulation if isinstance(e.message, GroundTruth)]


def test_between_knots_the_track_is_the_exact_arc():
    track = Track(0, np.array([1.0, 2.0, 3.0]), SECOND)
    track.set_twist(0.8, 0.1, -0.9)
    track.advance()
    track.set_twist(0.5, 0.0, 0.0)
    track.advance()
    for stamp, twist, start, dt in [
        (400_000_000, [0.8, 0.1, -0.9], [1.0, 2.0, 3.0], 0.4),
        (1_700_000_000, [0.5, 0.0, 0.0], track.pose_at(SECOND), 0.7),
    ]:
        want = se2.compose(start, se2.exp(np.array(twist) * dt))
        np.testing.assert_allclose(track.pose_at(stamp), want, atol=1e-12)
    assert track.wheel_motion(0, 2 * SECOND) == pytest.approx((0.8 + 0.5, -0.9))
    with pytest.raises(InputError, match='does not reach back'):
        track.pose_at(-1)


def test_a_long_track_forgets_its_beginning_and_nothing_else():
    track = Track(0, np.zeros(3))
    track.set_twist(1.0, 0.0, 0.1)
    for _ in range(Track.CAPACITY + 10):
        track.advance()
    assert track.stamp == (Track.CAPACITY + 10) * STEP
    old = track.stamp - 300 * SECOND
    want = se2.exp(np.array([1.0, 0.0, 0.1]) * old / SECOND)
    np.testing.assert_allclose(track.pose_at(old), want, atol=1e-6)
    with pytest.raises(InputError, match='does not reach back'):
        track.pose_at(0)


def test_the_route_is_followed_closely_and_ends_at_its_end():
    for name in world_names():
        world = load_world(name)
        simulation = Simulation(world, dataclasses.replace(QUIET), seed=0)
        route = RouteFollower(world.route, Simulator())
        dense = np.array([route.point(s) for s in np.arange(0.0, route.length, 0.05)])
        while not simulation.done:
            simulation._track.advance()  # without the sensors
            simulation._steer()
            if simulation.time % SECOND == 0:
                p = simulation.truth(simulation.time).T_world_base[:2]
                # corners are cut by less than the look-ahead
                assert np.hypot(*(dense - p).T).min() < 0.5
        end = simulation.truth(simulation.time)
        assert np.hypot(*(end.T_world_base[:2] - world.route[-1])) < 0.1
        assert not end.twist.any()
        assert simulation.progress > 0.999


def test_the_hall_takes_about_a_hundred_seconds():
    simulation = Simulation(load_world('hall'))
    while not simulation.done:
        simulation._track.advance()  # without the sensors
        simulation._steer()
    assert 90.0 < (simulation.time - START) / SECOND < 112.0


def test_speeds_and_accelerations_stay_in_their_bounds():
    n = Simulator(speed=0.8, acceleration=0.5, turn_rate=0.7, turn_acceleration=1.5)
    parameters = dataclasses.replace(QUIET, node=n)
    simulation = Simulation(load_world('symmetric'), parameters)
    twists = []
    while not simulation.done:
        simulation._track.advance()
        simulation._steer()
        twists.append(simulation._track.twist)
    twists = np.array(twists)
    dt = STEP / SECOND
    assert np.abs(twists[:, 0]).max() == pytest.approx(0.8, abs=1e-6)
    assert np.abs(twists[:, 2]).max() <= 0.7 + 1e-9
    assert np.abs(np.diff(twists[:, 0])).max() <= 0.5 * dt + 1e-9
    assert np.abs(np.diff(twists[:, 2])).max() <= 1.5 * dt + 1e-9


def test_sideways_motion_is_that_of_the_parameter():
    parameters = SimulatorParameters(wheels=Wheels(lateral_noise=0.05, noise_interval=0.2))
    simulation = Simulation(load_world('corridor'), parameters)
    sides = []
    while not simulation.done:
        simulation._track.advance()
        simulation._steer()
        v, side, _ = simulation._track.twist
        if v == 1.0:
            sides.append(side * STEP / SECOND)
    # variance (lateral |v|)^2 interval dt per step; 5600 steps: sigma to 1 / sqrt(2 n), 4 sigma
    want = 0.05 * math.sqrt(0.2 * STEP / SECOND)
    assert np.std(sides) == pytest.approx(want, rel=4 / math.sqrt(2 * len(sides)))


def test_a_command_is_obeyed_until_it_is_too_old():
    node = Simulator(drive='cmd_vel', command_timeout=0.5, duration=4.0)
    simulation = Simulation(load_world('yard'), SimulatorParameters(node=node))
    simulation.command(0.6, -0.4)
    while simulation.time < START + SECOND:
        if simulation.time <= START + SECOND // 2:
            simulation.command(0.6, -0.4)
        simulation.step()
    assert simulation._track.twist[0] == pytest.approx(0.6)
    assert simulation._track.twist[2] == pytest.approx(-0.4)
    while not simulation.done:
        simulation.step()
    assert simulation._track.twist == (0.0, 0.0, 0.0)
    assert simulation.time == START + 4 * SECOND
    simulation.command(99.0, -99.0)
    for _ in range(50):
        simulation.step()
    assert abs(simulation._track.twist[2]) <= 1.0


def test_a_route_of_one_point_is_a_robot_that_stands():
    world = parse_world('start: [1, 2, 0.5]\nroute: [[1, 2]]', 'w')
    simulation = Simulation(world)
    last = truths(simulation)[-1]
    np.testing.assert_allclose(last.T_world_base, [1.0, 2.0, 0.5])
    np.testing.assert_allclose(last.T_map_base, 0.0, atol=1e-12)


def test_a_repeated_route_that_is_not_closed_is_driven_back():
    """Not straight to its beginning, where something may stand in between."""
    world = parse_world('start: [0, 0, 0]\nroute: [[0, 0], [3, 0], [3, 2]]', 'w')
    simulation = Simulation(world, SimulatorParameters(node=Simulator(repeat=True)))
    path = []
    for _ in range(6000):
        simulation._track.advance()
        simulation._steer()
        path.append(simulation._track.pose[:2])
    path = np.array(path)
    off = np.minimum(np.abs(path[:, 1]), np.abs(path[:, 0] - 3.0))
    assert off.max() < 0.4  # it cuts the corner
    ends = np.hypot(*(path - [3.0, 2.0]).T) < 0.6, np.hypot(*path.T) < 0.6
    arrivals = [int((np.diff(end.astype(int)) == 1).sum()) for end in ends]
    assert min(arrivals) >= 2


def test_a_repeated_route_has_no_end():
    world = parse_world('start: [0, 0, 0]\nroute: [[0, 0], [1, 0], [1, 1], [0, 0]]', 'w')
    node = Simulator(repeat=True, still_time=0.0)
    simulation = Simulation(world, SimulatorParameters(node=node))
    for _ in range(3000):
        simulation._track.advance()
        simulation._steer()
    assert not simulation.done
    assert simulation._track.wheel_motion(START, simulation.time)[0] > 10.0
