# SPDX-License-Identifier: Apache-2.0
import math
from itertools import pairwise

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.motion import MotionBuffer
from rlml_slam.params import Gyro, Laser, Markers, MotionNoise, SimulatorParameters, Wheels
from rlml_slam.simulation.robot import SECOND, Track
from rlml_slam.simulation.sensors import (
    GyroSensor,
    LaserSensor,
    MarkerSensor,
    WheelSensor,
)
from rlml_slam.simulation.simulation import START, STEP, Simulation
from rlml_slam.simulation.world_file import load_world, parse_world
from rlml_slam.types import ANONYMOUS, Imu, Odometry

ROOM = """
start: [0, 0, 0]
route: [[0, 0]]
walls: [{points: [[-4, -3], [6, -3], [6, 3], [-4, 3]], closed: true}]
"""
EXACT = Laser(
    range_sigma=0.0,
    divergence=0.0,
    dropout_share=0.0,
    intensity_noise=0.0,
    min_intensity=0.0,
    beams=720,
)


def generators(seed):
    return lambda name: np.random.default_rng([seed, len(name), ord(name[0])])


def straight(seconds, v=1.0, omega=0.0, pose=(0.0, 0.0, 0.0)):
    track = Track(START, np.array(pose))
    track.set_twist(v, 0.0, omega)
    for _ in range(round(seconds * 100)):
        track.advance()
    return track


def odometry(wheels, track, seed=0):
    sensor = WheelSensor(wheels, generators(seed))
    period = round(SECOND / wheels.rate)
    return [sensor.measure(track, t) for t in range(START, track.stamp + 1, period)]


def scan_in(text, laser=EXACT, pose=(0.0, 0.0, 0.0), twist=(0.0, 0.0), seed=0, mount=(0, 0, 0)):
    """A scan, and the room, the track and the sensor it was taken with."""
    world = parse_world(text, 'room')
    track = straight(1.0, *twist, pose=pose)
    sensor = LaserSensor(laser, np.array(mount, dtype=float), 'laser', generators(seed))
    geometry = world.geometry(0.0)
    moment = START + sensor.sweep // 2
    return sensor.measure(track, START, geometry, moment), world, track, sensor


# wheels and gyro


@pytest.mark.parametrize('rate', [20.0, 50.0])
def test_odometry_noise_is_that_of_the_motion_model_at_any_rate(rate):
    wheels = Wheels(
        rate=rate,
        speed_noise=0.08,
        speed_noise_floor=0.02,
        turn_noise=0.1,
        turn_noise_floor=0.03,
        noise_interval=0.2,
    )
    track = straight(200.0, v=0.8, omega=0.5)
    samples = odometry(wheels, track)
    steps = np.array([se2.log(se2.between(a.pose, b.pose)) for a, b in pairwise(samples)])
    dt = 1.0 / rate
    spread = math.sqrt(0.2 * dt)
    # the sigma of n samples is known to 1 / sqrt(2 n); 4 sigmas of that
    tolerance = 4.0 / math.sqrt(2 * len(steps))
    assert steps[:, 0].std() == pytest.approx((0.08 * 0.8 + 0.02) * spread, rel=tolerance)
    assert steps[:, 2].std() == pytest.approx((0.1 * 0.5 + 0.03) * spread, rel=tolerance)
    assert steps[:, 0].mean() == pytest.approx(
        0.8 * dt, abs=4 * steps[:, 0].std() * len(steps) ** -0.5
    )
    assert np.abs(steps[:, 1]).max() < 1e-12


def test_the_errors_of_wheels_and_gyro_are_consistent_with_the_motion_models_covariance():
    """NEES of 1 s dead reckoning in the hall, against the estimator's own motion model."""
    parameters = SimulatorParameters(
        gyro=Gyro(bias=0.0, bias_walk=0.0), laser=Laser(rate=0.5, beams=2)
    )
    w, g = parameters.wheels, parameters.gyro
    noise = MotionNoise(
        speed_noise=w.speed_noise,
        speed_noise_floor=w.speed_noise_floor,
        turn_noise=w.turn_noise,
        turn_noise_floor=w.turn_noise_floor,
        lateral_noise=w.lateral_noise,
        noise_interval=w.noise_interval,
        imu_turn_noise=g.turn_noise,
        imu_turn_noise_floor=g.turn_noise_floor,
    )
    values = {False: [], True: []}
    for use_imu in (False, True):
        simulation = Simulation(load_world('hall'), parameters, seed=3)
        buffer = MotionBuffer(noise, memory=1000.0)
        for event in simulation:
            if isinstance(event.message, Odometry):
                buffer.add_odometry(event.message)
            elif isinstance(event.message, Imu) and use_imu:
                buffer.add_imu(event.message)
        for start in range(START + 3 * SECOND, simulation.time - 3 * SECOND, SECOND):
            motion = buffer.motion(start, start + SECOND)
            truth = se2.between(
                simulation.truth(start).T_world_base, simulation.truth(start + SECOND).T_world_base
            )
            error = motion.delta - truth
            error[2] = se2.wrap(error[2])
            values[use_imu].append(error @ np.linalg.solve(motion.cov, error))
    for use_imu, nees in values.items():
        n = len(nees)
        assert n > 90
        # chi-squared with 3 n degrees of freedom has the mean 3 n and sigma sqrt(6 n); 4 sigmas
        assert abs(np.sum(nees) - 3 * n) < 4 * math.sqrt(6 * n), (use_imu, np.mean(nees))


def test_wheels_that_stand_report_nothing():
    samples = odometry(Wheels(slip_rate=100.0), straight(2.0, v=0.0))
    assert all(not s.pose.any() for s in samples)


def test_scale_errors_are_what_they_say():
    quiet = {
        'speed_noise': 0.0,
        'speed_noise_floor': 0.0,
        'turn_noise': 0.0,
        'turn_noise_floor': 0.0,
    }
    track = straight(2.0, v=0.5, omega=0.3)
    last = odometry(Wheels(speed_scale=1.1, turn_scale=0.9, **quiet), track)[-1].pose
    want = se2.exp(np.array([0.5 * 1.1, 0.0, 0.3 * 0.9]) * 2.0)
    np.testing.assert_allclose(last, want, atol=1e-9)


def test_without_noise_odometry_is_the_truth():
    wheels = Wheels(speed_noise=0.0, speed_noise_floor=0.0, turn_noise=0.0, turn_noise_floor=0.0)
    track = straight(5.0, v=0.7, omega=-0.8, pose=(1.0, 2.0, 3.0))
    last = odometry(wheels, track)[-1]
    want = se2.between(track.pose_at(START), track.pose_at(last.stamp))
    np.testing.assert_allclose(last.pose, want, atol=1e-9)


def test_a_slip_burst_overstates_speed_for_its_duration():
    quiet = {
        'speed_noise': 0.0,
        'speed_noise_floor': 0.0,
        'turn_noise': 0.0,
        'turn_noise_floor': 0.0,
    }
    wheels = Wheels(slip_rate=0.5, slip_duration=0.4, slip_speed=0.5, slip_turn=0.2, **quiet)
    samples = odometry(wheels, straight(60.0))
    steps = np.array([se2.log(se2.between(a.pose, b.pose)) for a, b in pairwise(samples)]) * 50
    slipping = np.abs(steps[:, 2]) > 1e-9
    assert np.allclose(steps[~slipping, 0], 1.0)
    assert (steps[slipping, 0] >= 1.0 - 1e-9).all()
    assert steps[slipping, 0].max() <= 1.5
    starts = np.flatnonzero(np.diff(slipping.astype(int)) == 1)
    # 0.5 / s that can begin while none is on: 30 s / (1 + 0.5 * 0.4), Poisson to 4 sigmas
    assert abs(len(starts) - 25) < 20
    lengths = [np.argmin(slipping[k + 1 :]) for k in starts[:-1]]
    assert set(lengths) <= {20, 40, 60}


def test_gyro_noise_and_bias_are_what_they_say():
    gyro = Gyro(
        turn_noise=0.02, turn_noise_floor=0.004, noise_interval=0.1, bias=0.01, bias_walk=0.0
    )
    sensor = GyroSensor(gyro, generators(0))
    track = straight(60.0, omega=0.5)
    stamps = range(START, track.stamp, STEP)
    rates = np.array([sensor.measure(track, t).yaw_rate for t in stamps])
    sigma = (0.02 * 0.5 + 0.004) * math.sqrt(0.1 * 100.0)
    assert rates.std() == pytest.approx(sigma, rel=4 / math.sqrt(2 * len(rates)))
    assert rates.mean() == pytest.approx(0.51, abs=4 * sigma / math.sqrt(len(rates)))


def test_gyro_bias_walks_as_it_says():
    ends = []
    track = straight(4.0)
    for seed in range(200):
        sensor = GyroSensor(Gyro(bias_walk=0.01, rate=10.0), generators(seed))
        for t in range(START, track.stamp, SECOND // 10):
            sensor.measure(track, t)
        ends.append(sensor.bias - 0.005)
    # after 4 s: 0.01 sqrt(4)
    assert np.std(ends) == pytest.approx(0.02, rel=4 / math.sqrt(2 * 200))


def test_the_trapezoids_through_a_noiseless_gyro_add_up_to_the_heading():
    parameters = SimulatorParameters(
        gyro=Gyro(turn_noise=0.0, turn_noise_floor=0.0, bias=0.0, bias_walk=0.0),
        laser=Laser(rate=0.5, beams=2),
    )
    simulation = Simulation(load_world('symmetric'), parameters)
    samples = [e.message for e in simulation if isinstance(e.message, Imu)]
    rates = np.array([s.yaw_rate for s in samples])
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * 0.01)])
    true = np.array([simulation.truth(s.stamp).T_map_base[2] for s in samples])
    # the ends of a ramp of 3 rad/s^2 leave a quarter of a step: 3 * 0.01 * 0.01 / 4
    assert np.abs(se2.wrap(turned - true)).max() < 2e-4


# laser


def test_ranges_in_a_box_are_exact():
    scan, *_ = scan_in(ROOM, pose=(0.5, 0.2, 0.7), mount=(0.2, 0.1, 0.3))
    x, y, theta = se2.compose([0.5, 0.2, 0.7], [0.2, 0.1, 0.3])
    angles = theta + scan.angle_min + np.arange(720) * scan.angle_increment
    c, s = np.cos(angles), np.sin(angles)
    with np.errstate(divide='ignore'):
        tx = np.where(c > 0, (6 - x) / c, (-4 - x) / c)
        ty = np.where(s > 0, (3 - y) / s, (-3 - y) / s)
    np.testing.assert_allclose(scan.ranges, np.minimum(tx, ty), rtol=1e-6)  # float32
    assert scan.ranges.dtype == scan.intensities.dtype == np.float32
    assert scan.angle_min + 720 * scan.angle_increment == pytest.approx(math.pi)
    assert scan.frame_id == 'laser'


def test_a_partial_field_of_view_reaches_both_its_ends():
    scan, *_ = scan_in(ROOM, Laser(field_of_view=1.5 * math.pi, beams=271))
    assert scan.angle_min == pytest.approx(-0.75 * math.pi)
    assert scan.angle_min + 270 * scan.angle_increment == pytest.approx(0.75 * math.pi)
    # three quarters of a turn of the mirror
    assert scan.time_increment * 270 == pytest.approx(0.075)


def test_every_ray_is_cast_from_where_the_laser_is_at_its_time():
    v, omega = 1.0, 0.8
    scan, _, track, sensor = scan_in(ROOM, twist=(v, omega), mount=(0.2, 0, 0))
    k = np.arange(720)
    stamps = START + np.rint(k * scan.time_increment * SECOND).astype(np.int64)
    poses = sensor.poses(track, stamps)
    assert np.hypot(*(poses[-1] - poses[0])[:2]) > 0.09
    angles = scan.angle_min + k * scan.angle_increment
    r = scan.ranges.astype(float)
    ends = se2.transform(poses, np.stack([r * np.cos(angles), r * np.sin(angles)], -1)[:, None])
    x, y = ends[:, 0].T
    off = np.minimum.reduce([abs(x - 6), abs(x + 4), abs(y - 3), abs(y + 3)])
    assert off.max() < 1e-5  # float32 of a range of 6 m
    still, *_ = scan_in(
        ROOM,
        Laser(**{**EXACT.__dict__, 'ray_times': False}),
        twist=(v, omega),
    )
    at_start, *_ = scan_in(ROOM)
    assert still.time_increment == 0.0
    np.testing.assert_array_equal(still.ranges, at_start.ranges)


def test_what_moves_is_met_where_it_is_at_the_time_of_the_ray():
    text = (
        'start: [0, 0, 0]\nroute: [[0, 0]]\n'
        'movers: [{diameter: 1, speed: 2, route: [[3, -1], [3, 1]]}]'
    )
    laser = Laser(**{**EXACT.__dict__, 'rate': 5.0})
    world = parse_world(text, 'w')
    track = straight(1.0, v=0.0)
    sensor = LaserSensor(laser, np.zeros(3), 'laser', generators(0))
    moment = START + sensor.sweep // 2
    scan = sensor.measure(track, START, world.geometry(0.1), moment)
    k = np.flatnonzero(np.isfinite(scan.ranges))
    y = -1.0 + 2.0 * k * scan.time_increment
    angles = scan.angle_min + k * scan.angle_increment
    r = scan.ranges[k]
    distance = np.hypot(r * np.cos(angles) - 3.0, r * np.sin(angles) - y)
    np.testing.assert_allclose(distance, 0.5, atol=1e-5)


def test_range_noise_and_dropped_beams_are_what_they_say():
    noisy = Laser(**{**EXACT.__dict__, 'range_sigma': 0.03, 'dropout_share': 0.1, 'beams': 20000})
    scan, *_ = scan_in(ROOM, noisy)
    exact, *_ = scan_in(ROOM, Laser(**{**EXACT.__dict__, 'beams': 20000}))
    lost = np.isnan(scan.ranges)
    assert lost.mean() == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / 20000))
    assert (scan.intensities[lost] == 0.0).all()
    error = (scan.ranges - exact.ranges)[~lost]
    assert error.std() == pytest.approx(0.03, rel=4 / math.sqrt(2 * len(error)))
    assert abs(error.mean()) < 4 * 0.03 / math.sqrt(len(error))


def test_too_near_is_minus_infinity_and_too_far_is_infinity():
    scan, *_ = scan_in(ROOM, Laser(**{**EXACT.__dict__, 'range_min': 3.5, 'range_max': 5.0}))
    ahead, left = scan.ranges[360], scan.ranges[540]
    assert ahead == np.inf  # 6 m
    assert left == -np.inf  # 3 m
    assert scan.ranges[0] == pytest.approx(4.0)


def test_a_beam_across_an_edge_sees_a_mixed_range():
    edge = ROOM + 'boxes: [{at: [2.6, 1.5], size: [0.4, 3.0]}, {at: [3.0, -1], size: [0.4, 2]}]'
    laser = Laser(**{**EXACT.__dict__, 'divergence': 0.01, 'beams': 20000})
    scan, *_ = scan_in(edge, laser)
    sharp, *_ = scan_in(edge, Laser(**{**EXACT.__dict__, 'beams': 20000}))
    k = np.flatnonzero(np.abs(np.arange(20000) - 10000) < 10)  # around y = 0: 2.4 m and 2.8 m
    mixed = (scan.ranges[k] > 2.45) & (scan.ranges[k] < 2.75)
    assert mixed.any()
    assert not ((sharp.ranges[k] > 2.45) & (sharp.ranges[k] < 2.75)).any()
    # far from edges a diverging beam measures what a thin one does, to second order
    assert np.median(np.abs(scan.ranges - sharp.ranges)) < 1e-4


def test_reflectors_are_bright_at_any_range_and_walls_fade_with_range_and_angle():
    text = ROOM.replace('6', '26') + (
        'reflectors: [{at: [2, 0], diameter: 0.2}, {at: [0, -2], width: 0.2, normal: [0, 1]},'
        '{at: [0, 2], width: 0.2, normal: [0, 1]}]'
    )
    scan, *_ = scan_in(text)
    ahead, right, left, back = (scan.intensities[k] for k in (360, 180, 540, 0))
    assert scan.ranges[360] == pytest.approx(1.9, abs=1e-3)
    gain = lambda r: 1.0 / (1.0 + (r / 10.0) ** 2)  # noqa: E731
    assert ahead == pytest.approx(30000 * gain(1.9), rel=1e-3)
    assert right == pytest.approx(30000 * gain(2.0), rel=1e-3)
    assert left == pytest.approx(500 * gain(2.0), rel=1e-3)  # its back is turned to the laser
    assert back == pytest.approx(600 * gain(4.0), rel=1e-3)
    # a wall at 45 degrees gives back cos 45 of it
    k = 540 + 90
    expected = 600 * math.cos(math.pi / 4) * gain(3.0 * math.sqrt(2))
    assert scan.intensities[k] == pytest.approx(expected, rel=1e-3)


def test_a_glossy_wall_blinds_head_on_and_vanishes_at_a_slant():
    text = (
        'start: [0, 0, 0]\nroute: [[0, 0]]\n'
        'walls: [{points: [[3, -20], [3, 20]], reflectance: 0.05, glossy: true}]'
    )
    scan, *_ = scan_in(text, Laser(**{**EXACT.__dict__, 'min_intensity': 1.0}))
    assert scan.intensities[360] > 10000
    assert scan.intensities[400] < 50
    assert np.isinf(scan.ranges[360 + 165])  # 82 degrees


# reflector detections


def detections(text, markers, twist=(0.0, 0.0), laser=EXACT, seeds=1, mount=(0.2, 0.0, 0.0)):
    world = parse_world(text, 'w')
    track = straight(1.0, *twist)
    sensor = LaserSensor(laser, np.array(mount), 'laser', generators(0))
    found = []
    for seed in range(seeds):
        marker = MarkerSensor(markers, world.reflectors, generators(seed))
        moment = START + sensor.sweep // 2
        found.append(marker.measure(track, sensor, START, world.geometry(0.0), moment))
    return found


CLEAN = Markers(sigma_range=0.0, sigma_bearing=0.0, missed_share=0.0, false_detections=0.0)
POSTS = 'reflectors: [{at: [3, 1], diameter: 0.1, id: 7}, {at: [-2, -2], diameter: 0.3, id: 9}]'


def test_a_detection_is_the_centre_in_the_laser_frame_at_the_scans_stamp():
    for twist in [(0.0, 0.0), (1.0, 1.0)]:
        found = detections(ROOM + POSTS, CLEAN, twist)[0]
        np.testing.assert_allclose(found.points, [[2.8, 1.0], [-2.2, -2.0]], atol=1e-9)
        np.testing.assert_allclose(found.diameters, [0.1, 0.3])
        assert found.stamp == START
        assert found.frame_id == 'laser'
        assert (found.ids == ANONYMOUS).all()


def test_ids_are_told_only_when_asked():
    markers = Markers(**{**CLEAN.__dict__, 'ids': True})
    assert list(detections(ROOM + POSTS, markers)[0].ids) == [7, 9]


def test_noise_has_no_bias_and_the_covariance_that_is_stated():
    markers = Markers(sigma_range=0.05, sigma_bearing=0.01, missed_share=0.0, false_detections=0.0)
    found = detections(ROOM + POSTS, markers, seeds=800)
    for k, true in enumerate([[2.8, 1.0], [-2.2, -2.0]]):
        error = np.array([d.points[k] for d in found]) - true
        cov = found[0].cov[k]
        nees = np.einsum('ni,ij,nj->n', error, np.linalg.inv(cov), error)
        # chi-squared with 2 n degrees of freedom: mean 2 n, sigma sqrt(4 n); 4 sigmas
        assert abs(nees.sum() - 2 * 800) < 4 * math.sqrt(4 * 800)
        assert (np.abs(error.mean(0)) < 4 * np.sqrt(np.diag(cov) / 800)).all()


def test_what_stands_between_hides_a_reflector():
    hidden = ROOM + POSTS + '\nboxes: [{at: [1.5, 0.5], size: [0.3, 0.6]}]'
    found = detections(hidden, CLEAN)[0]
    np.testing.assert_allclose(found.points, [[-2.2, -2.0]], atol=1e-9)


def test_far_and_outside_the_field_of_view_is_not_detected():
    near = Markers(**{**CLEAN.__dict__, 'max_range': 2.99})
    assert len(detections(ROOM + POSTS, near)[0]) == 2
    near = Markers(**{**CLEAN.__dict__, 'max_range': 2.9})
    assert len(detections(ROOM + POSTS, near)[0]) == 0
    narrow = Laser(**{**EXACT.__dict__, 'field_of_view': 4.0, 'beams': 721})
    np.testing.assert_allclose(
        detections(ROOM + POSTS, CLEAN, laser=narrow)[0].points, [[2.8, 1.0]], atol=1e-9
    )


def test_a_flat_reflector_is_detected_from_its_front_only():
    flat = ROOM + (
        'reflectors: [{at: [3, 0], width: 0.1, normal: [-1, 0]},'
        '{at: [-3, 0.5], width: 0.1, normal: [-1, 0]}, {at: [0.3, 2], width: 0.1, normal: [1, 0]}]'
    )
    found = detections(flat, CLEAN)[0]
    np.testing.assert_allclose(found.points, [[2.8, 0.0]], atol=1e-9)
    assert np.isnan(found.diameters).all()


def test_missing_and_ghosts_come_as_often_as_they_say():
    markers = Markers(**{**CLEAN.__dict__, 'missed_share': 0.3, 'false_detections': 0.0})
    count = sum(len(d) for d in detections(ROOM + POSTS, markers, seeds=800))
    assert abs(count - 0.7 * 1600) < 4 * math.sqrt(1600 * 0.21)
    markers = Markers(**{**CLEAN.__dict__, 'missed_share': 1.0, 'false_detections': 2.0})
    found = detections(ROOM + POSTS, markers, seeds=800)
    assert abs(sum(map(len, found)) - 1600) < 4 * math.sqrt(1600)
    points = np.concatenate([d.points for d in found])
    assert np.hypot(*points.T).max() <= markers.max_range
    assert abs(np.mean(points[:, 1] > 0) - 0.5) < 4 * math.sqrt(0.25 / len(points))


def test_no_reflectors_is_an_empty_message_not_silence():
    found = detections(ROOM, CLEAN)[0]
    assert len(found) == 0
    assert found.points.shape == (0, 2)
    assert found.cov.shape == (0, 2, 2)
