# SPDX-License-Identifier: Apache-2.0
"""The simulated world, robot, sensors and transport."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class Simulator(Group, prefix=''):
    """The simulated world, the robot and the clock; the same seed gives the same run."""

    world: str = param('hall', 'name of a world of this package, or path of a world file')
    seed: int = param(0, 'seed of all noise', '', 0, 2**31 - 1)
    rate: float = param(1.0, 'real-time factor: simulated seconds per second', '', 0.01, 1000.0)
    drive: str = param(
        'route',
        'follow the route of the world, or the cmd_vel topic',
        choices=('route', 'cmd_vel'),
    )
    repeat: bool = param(
        False, 'repeat the route without end; one that is not closed is driven back each time'
    )
    duration: float = param(0.0, 'duration of the run; 0: until the route is done', 's', 0, 1e6)
    exit_at_end: bool = param(True, 'the node exits with code 0 when the run is done')
    wait_for_subscribers: int = param(
        0, 'the run starts when the scan topic has this many subscribers', '', 0, 100
    )
    still_time: float = param(1.0, 'standstill before and after the route', 's', 0.0, 600.0)
    speed: float = param(1.0, 'highest speed', 'm/s', 0.01, 10.0)
    acceleration: float = param(0.8, 'highest acceleration', 'm/s^2', 0.01, 20.0)
    turn_rate: float = param(1.0, 'highest turn rate', 'rad/s', 0.01, 10.0)
    turn_acceleration: float = param(3.0, 'highest turn acceleration', 'rad/s^2', 0.01, 50.0)
    lookahead: float = param(
        0.7, 'pure pursuit: distance to the target point on the route', 'm', 0.1, 10.0
    )
    command_timeout: float = param(0.5, 'the robot stops when cmd_vel is older', 's', 0.01, 60.0)
    kidnap_time: float = param(
        0.0, 'time at which the robot is kidnapped; 0: never', 's', 0.0, 1e6
    )
    kidnap_distance: float = param(
        -10.0, 'kidnapping: distance along the route, negative: backwards', 'm', -1e4, 1e4
    )
    truth_rate: float = param(50.0, 'rate of the ground truth', 'Hz', 0.1, 1000.0)
    laser_pose: tuple[float, ...] = param(
        (0.2, 0.0, 0.0), 'pose of the laser in base_frame', 'm, m, rad'
    )
    map_frame: str = param('map', 'frame of the ground truth: the base at start')
    odom_frame: str = param('odom', 'frame of the odometry')
    base_frame: str = param('base_link', 'frame of the robot')
    laser_frame: str = param('laser', 'frame of scans and reflector detections')


@dataclass(frozen=True)
class Wheels(Group):
    """Wheel odometry of the simulator; the noise model is that of ``motion``."""

    rate: float = param(50.0, 'rate of odometry', 'Hz', 1.0, 1000.0)
    speed_noise: float = param(0.05, 'speed noise per speed, 1 sigma', '', 0.0, 10.0)
    speed_noise_floor: float = param(
        0.01, 'speed noise floor while the robot moves, 1 sigma', 'm/s', 0.0, 10.0
    )
    turn_noise: float = param(0.05, 'turn rate noise per turn rate, 1 sigma', '', 0.0, 10.0)
    turn_noise_floor: float = param(
        0.01, 'turn rate noise floor while the robot moves, 1 sigma', 'rad/s', 0.0, 10.0
    )
    lateral_noise: float = param(
        0.02, 'true sideways motion per speed, not measured by the wheels, 1 sigma', '', 0.0, 10.0
    )
    noise_interval: float = param(
        0.1, 'control interval for which the noise is given', 's', 1e-3, 10.0
    )
    speed_scale: float = param(1.0, 'reported speed per true speed', '', 0.1, 10.0)
    turn_scale: float = param(1.0, 'reported turn rate per true turn rate', '', 0.1, 10.0)
    slip_rate: float = param(0.0, 'wheel slips per second of motion', '1/s', 0.0, 100.0)
    slip_duration: float = param(0.5, 'duration of a slip', 's', 0.01, 60.0)
    slip_speed: float = param(
        0.5, 'largest share by which a slip overstates the speed', '', 0.0, 10.0
    )
    slip_turn: float = param(0.3, 'sigma of the false turn rate of a slip', 'rad/s', 0.0, 10.0)


@dataclass(frozen=True)
class Gyro(Group):
    """IMU of the simulator; the noise model is that of the IMU in ``motion``."""

    rate: float = param(100.0, 'rate of the IMU', 'Hz', 1.0, 2000.0)
    turn_noise: float = param(0.005, 'turn rate noise per turn rate, 1 sigma', '', 0.0, 10.0)
    turn_noise_floor: float = param(
        0.003, 'turn rate noise at turn rate 0, 1 sigma', 'rad/s', 0.0, 10.0
    )
    noise_interval: float = param(
        0.1, 'control interval for which the noise is given', 's', 1e-3, 10.0
    )
    bias: float = param(0.005, 'bias at start', 'rad/s', -1.0, 1.0)
    bias_walk: float = param(5e-5, 'random walk of the bias', 'rad/s/sqrt(s)', 0.0, 1.0)


@dataclass(frozen=True)
class Laser(Group):
    """Laser of the simulator; a white wall at 1 m and normal incidence has intensity 1000."""

    rate: float = param(10.0, 'scans per second', 'Hz', 0.5, 100.0)
    beams: int = param(1440, 'beams per scan', '', 2, 20000)
    field_of_view: float = param(2 * math.pi, 'field of view', 'rad', 0.1, 2 * math.pi)
    range_min: float = param(0.1, 'shorter ranges are reported as -Inf', 'm', 0.0, 10.0)
    range_max: float = param(30.0, 'longer ranges are reported as +Inf', 'm', 1.0, 500.0)
    ray_times: bool = param(True, 'each ray is cast at its own time; false: all rays at the stamp')
    range_sigma: float = param(0.01, 'range noise', 'm', 0.0, 1.0)
    divergence: float = param(0.003, 'divergence of a beam: full angle', 'rad', 0.0, 0.1)
    dropout_share: float = param(
        0.002, 'share of beams without a range, reported as NaN', '', 0.0, 1.0
    )
    retro_gain: float = param(
        30.0, 'intensity of a reflector relative to a white wall', '', 1.0, 1e4
    )
    gain_range: float = param(10.0, 'range at which half of the power is received', 'm', 0.1, 1e3)
    intensity_noise: float = param(0.03, 'intensity noise per intensity, 1 sigma', '', 0.0, 1.0)
    min_intensity: float = param(1.0, 'weaker echoes are no return', '', 0.0, 1e6)


@dataclass(frozen=True)
class Markers(Group):
    """Reflector detections of the simulator, one message per scan."""

    enabled: bool = param(True, 'detect reflectors')
    sigma_range: float = param(0.02, 'range noise', 'm', 0.0, 10.0)
    sigma_bearing: float = param(0.003, 'bearing noise', 'rad', 0.0, 1.0)
    max_range: float = param(25.0, 'farther reflectors are not detected', 'm', 0.5, 500.0)
    max_incidence: float = param(
        1.0, 'largest angle of incidence at which a flat reflector is detected', 'rad', 0.1, 1.57
    )
    ids: bool = param(False, 'detections have the id of their reflector')
    missed_share: float = param(0.02, 'share of reflectors in view that are missed', '', 0.0, 1.0)
    false_detections: float = param(
        0.01, 'mean number of false detections per scan', '', 0.0, 100.0
    )


@dataclass(frozen=True)
class Transport(Group):
    """Transport faults between sensor and robot, drawn independently per message."""

    jitter: float = param(0.0, 'error of a stamp, 1 sigma', 's', 0.0, 1.0)
    late_share: float = param(0.0, 'share of delayed messages', '', 0.0, 1.0)
    late_delay: float = param(0.3, 'longest delay of a message', 's', 0.0, 60.0)
    lost_share: float = param(0.0, 'share of lost messages', '', 0.0, 1.0)


@dataclass(frozen=True)
class SimulatorParameters:
    """Parameters of simulator; fields of ``node`` have plain ROS names."""

    node: Simulator = field(default_factory=Simulator)
    wheels: Wheels = field(default_factory=Wheels)
    gyro: Gyro = field(default_factory=Gyro)
    laser: Laser = field(default_factory=Laser)
    markers: Markers = field(default_factory=Markers)
    transport: Transport = field(default_factory=Transport)
