# SPDX-License-Identifier: Apache-2.0
"""Motion, reflector detections, scans and health: the front end and what it shares."""

from __future__ import annotations

from dataclasses import dataclass

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class MotionNoise(Group, prefix='motion.'):
    """Noise of odometry and IMU (eq. 6): sigma_v = a |v| + b, sigma_omega = c |omega| + d.

    a, b, c, d are ``speed_noise``, ``speed_noise_floor``, ``turn_noise``, ``turn_noise_floor``.
    They hold for a control interval of ``noise_interval``; other intervals are scaled so that the
    accumulated covariance does not depend on the rate of the odometry.
    """

    speed_noise: float = param(0.1, 'speed noise per speed, 1 sigma', '', 0.0, 10.0)
    speed_noise_floor: float = param(0.02, 'speed noise at speed 0, 1 sigma', 'm/s', 0.0, 10.0)
    turn_noise: float = param(0.2, 'turn rate noise per turn rate, 1 sigma', '', 0.0, 10.0)
    turn_noise_floor: float = param(
        0.05, 'turn rate noise at turn rate 0, 1 sigma', 'rad/s', 0.0, 10.0
    )
    lateral_noise: float = param(0.05, 'sideways speed noise per speed, 1 sigma', '', 0.0, 10.0)
    imu_turn_noise: float = param(
        0.005, 'turn rate noise of the IMU per turn rate, 1 sigma', '', 0.0, 10.0
    )
    imu_turn_noise_floor: float = param(
        0.003, 'turn rate noise of the IMU at turn rate 0, 1 sigma', 'rad/s', 0.0, 10.0
    )
    imu_bias_sigma: float = param(0.02, 'bias of the IMU at start, 1 sigma', 'rad/s', 0.0, 10.0)
    imu_bias_walk: float = param(
        2e-4, 'random walk of the bias of the IMU', 'rad/s/sqrt(s)', 0.0, 1.0
    )
    scale_error_sigma: tuple[float, ...] = param(
        (0.03, 0.05), 'scale error of speed and turn rate, 1 sigma; 0: not modelled', '', 0.0, 1.0
    )
    scale_error_sigma_without_lidar: tuple[float, ...] = param(
        (0.03, 0.1), 'the same until the first scan; the larger of both holds', '', 0.0, 1.0
    )
    drift_sigma: float = param(
        0.03, 'turn per distance not measured, 1 sigma; 0: not modelled', 'rad/m', 0.0, 1.0
    )
    pivot_sigma: float = param(
        0.05, 'of a lidar: base_frame ahead of where the robot turns, 1 sigma', 'm', 0.0, 10.0
    )
    scale_error_time: float = param(
        600.0, 'correlation time of these errors: load, floor, tyres', 's', 1.0, 1e6
    )
    noise_interval: float = param(
        0.1, 'control interval for which the noises above are given', 's', 1e-3, 10.0
    )
    long_interval_noise: float = param(
        0.2,
        'noise per speed and turn rate added in intervals longer than 2 x noise_interval',
        '',
        0.0,
        10.0,
    )
    max_gap: float = param(
        3.5, 'longest gap of the odometry that is interpolated', 's', 0.01, 60.0
    )
    max_speed: float = param(
        5.0, 'an odometry step faster than this is a jump and is not used', 'm/s', 0.01, 100.0
    )
    max_turn_rate: float = param(
        15.0, 'a turn of odometry or IMU faster than this is not used', 'rad/s', 0.01, 100.0
    )
    constant_velocity_sigma: tuple[float, ...] = param(
        (1.0, 0.1, 2.0),
        'without odometry: forward, sideways and turning speed of the robot, 1 sigma',
        'm/s, m/s, rad/s',
    )
    constant_velocity_time: float = param(
        4.0, 'without odometry: correlation time of these speeds', 's', 0.01, 60.0
    )
    constant_velocity_stamp_sigma: float = param(
        0.02, 'without odometry: error of the stamps of the scans, 1 sigma', 's', 0.0, 1.0
    )

    @property
    def first_scale_errors(self) -> tuple[float, ...]:
        """Sigmas (2,) of the scale errors of speed and turn rate until the first scan."""
        return tuple(map(max, self.scale_error_sigma, self.scale_error_sigma_without_lidar))


@dataclass(frozen=True)
class Reflector(Group):
    """Reflector detections and their association."""

    sigma_range: float = param(
        0.02, 'range noise of a detection without covariance', 'm', 1e-4, 10.0
    )
    sigma_bearing: float = param(
        0.003, 'bearing noise of a detection without covariance', 'rad', 1e-5, 1.0
    )
    sigma_fallback: float = param(
        0.025,
        'noise per axis of a detection at the sensor, where range and bearing are undefined',
        'm',
        1e-4,
        10.0,
    )
    gate: float = param(0.997, 'probability inside the association gate', '', 0.5, 0.999999)
    new_gate: float = param(
        0.99999,
        'a detection inside this gate of a mapped reflector is never a new one',
        '',
        0.5,
        0.9999999,
    )
    separability_sigma: float = param(
        4.0,
        'anonymous reflectors closer than this many sigmas of a detection are merged',
        '',
        0.0,
        100.0,
    )
    unmapped_density: float = param(
        0.02,
        'expected density of unmapped reflectors: the alternative to a match',
        '1/m²',
        1e-6,
        10.0,
    )
    match_probability: float = param(
        0.99,
        'an anonymous detection is used at once if its match is at least this probable',
        '',
        0.5,
        1.0,
    )
    track_timeout: float = param(
        3.0, 'a reflector seen within this time keeps its association', 's', 0.0, 60.0
    )
    min_separation: float = param(
        0.25, 'anonymous reflectors closer than this are not distinguished', 'm', 0.0, 10.0
    )
    min_sightings: int = param(
        3, 'detections before a candidate becomes a reflector of the map', '', 1, 100
    )
    candidate_timeout: float = param(
        20.0, 'a candidate without a detection for this long is dropped', 's', 0.1, 1e4
    )
    persistence_threshold: float = param(
        1e-3,
        'a reflector leaves the map when the probability that it still exists is below; 0: never',
        '',
        0.0,
        0.1,
    )
    muted_sectors: tuple[float, ...] = param(
        (0.0, 0.0),
        'bearings in which the detector is muted or sees the robot itself, pairs of begin and end '
        'counter-clockwise, axes of base_frame: a reflector that is not seen there is not missing',
        'rad',
        -6.3,
        6.3,
    )
    robust_scale: float = param(
        3.0, 'Cauchy scale of the reflector residual, in sigmas', '', 0.5, 100.0
    )
    correlated_share: float = param(
        0.05,
        'share of the variance of a detection that all detections of a keyframe have in common',
        '',
        0.0,
        1.0,
    )
    max_range: float = param(40.0, 'farther detections are not used', 'm', 0.5, 1000.0)


@dataclass(frozen=True)
class Submap(Group):
    """Occupancy grids of several scans, against which scans are matched."""

    resolution: float = param(0.05, 'cell size', 'm', 0.01, 1.0)
    max_laser_range: float = param(30.0, 'longer beams are not used', 'm', 0.5, 300.0)
    max_points: int = param(
        500, 'largest number of end points of a scan that is inserted', '', 20, 100000
    )
    p_hit: float = param(0.7, 'occupancy probability of a cell after one hit', '', 0.51, 0.99)
    p_miss: float = param(0.46, 'occupancy probability of a cell after one miss', '', 0.01, 0.49)
    bias_variance: tuple[float, ...] = param(
        (1e-4, 1e-4, 1.6e-5),
        'variance of the error of a submap, common to all scans matched against it',
        'm², m², rad²',
        0.0,
        100.0,
    )
    heading_drift: float = param(
        0.002, 'drift of the heading along the way that scans do not show', 'rad/sqrt(m)', 0.0, 1.0
    )
    grid_bias_variance: tuple[float, ...] = param(
        (4e-4, 4e-4, 9e-6),
        'variance of the error of the grid of a saved map, common to all beams of a scan',
        'm², m², rad²',
        0.0,
        100.0,
    )
    insertions: int = param(90, 'number of scans that complete a submap', '', 2, 10000)
    min_travel: float = param(0.1, 'travel between two inserted scans', 'm', 0.0, 10.0)
    min_turn: float = param(0.08, 'turn between two inserted scans', 'rad', 0.0, 3.2)


@dataclass(frozen=True)
class ScanMatch(Group):
    """Scan matching: correlative search and Gauss-Newton refinement."""

    voxel_size: float = param(
        0.05, 'voxel filter: one end point per cell of this size', 'm', 0.0, 1.0
    )
    max_points: int = param(400, 'largest number of end points of a match', '', 20, 10000)
    sigma: float = param(
        0.2,
        'sigma_s of the occupancy residual of an end point (eq. 2), calibrated by NEES',
        '',
        1e-3,
        100.0,
    )
    sigma_point: float = param(
        0.03,
        'error of an end point normal to its surface, neighbour correlation included',
        'm',
        1e-3,
        10.0,
    )
    min_points: int = param(20, 'scans with fewer end points are not matched', '', 3, 10000)
    variance_floor: tuple[float, ...] = param(
        (1e-6, 1e-6, 1e-7),
        'smallest variance of a match, however many beams it has',
        'm², m², rad²',
        0.0,
        100.0,
    )
    min_score: float = param(
        0.3, 'a match with a smaller mean hit probability is not used', '', 0.0, 1.0
    )
    search_threshold: float = param(
        0.55, 'mean hit probability below which the correlative search is made', '', 0.0, 1.0
    )
    search_window: float = param(0.1, 'half width of the search in position', 'm', 0.0, 10.0)
    search_angle: float = param(0.35, 'half width of the search in heading', 'rad', 0.0, 3.2)
    wide_search_threshold: float = param(
        0.58, 'mean hit probability below which the wide search is made', '', 0.0, 1.0
    )
    wide_window: float = param(0.6, 'half width of the wide search in position', 'm', 0.0, 10.0)
    wide_angle: float = param(0.5, 'half width of the wide search in heading', 'rad', 0.0, 3.2)
    search_prior_weight: float = param(
        0.05,
        'search: score lost by a component of the pose that is far from the prior',
        '',
        0.0,
        1.0,
    )
    max_iterations: int = param(20, 'largest number of Gauss-Newton iterations', '', 1, 200)
    prior_robust_scale: float = param(
        3.0, 'Geman-McClure scale of the odometry prior, in sigmas', '', 0.5, 100.0
    )


@dataclass(frozen=True)
class HealthLimits(Group, prefix='health.'):
    """When the estimate counts as DEGRADED or LOST."""

    input_timeout: float = param(
        1.0, 'DEGRADED when an input is missing for longer', 's', 0.0, 60.0, live=True
    )
    confirmation_time: float = param(
        5.0, 'LOST when the start pose in a saved map has no match for this long', 's', 0.0, 600.0
    )
    confirmation_distance: float = param(
        5.0, 'DEGRADED after this much travel without a match with the saved map', 'm', 0.0, 1e4
    )
    degeneracy_sigma: float = param(
        0.15,
        'a direction with a larger sigma is not observed by the scan (a corridor)',
        'm',
        1e-3,
        10.0,
    )
    sigma_degraded: float = param(
        0.5, 'DEGRADED beyond this position sigma', 'm', 1e-3, 100.0, live=True
    )
    heading_sigma_degraded: float = param(
        0.1, 'DEGRADED beyond this heading sigma', 'rad', 1e-4, 10.0, live=True
    )
    sigma_lost: float = param(2.0, 'LOST beyond this position sigma', 'm', 1e-3, 1000.0, live=True)
    contradiction_ratio: float = param(
        0.6,
        'a scan whose score is below this share of the usual score contradicts the map',
        '',
        0.0,
        1.0,
    )
    lost_time: float = param(
        0.6, 'LOST when scans or reflectors contradict the map for this long', 's', 0.0, 60.0
    )
    new_session_time: float = param(
        5.0, 'mapping: contradicted for this long, new submaps start', 's', 0.0, 1e6
    )
