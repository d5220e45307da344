# SPDX-License-Identifier: Apache-2.0
"""Every parameter, declared once: default, unit, bounds and meaning.

A group is a frozen dataclass of param() fields; Parameters holds one of each. The ROS
declaration (``ros/declare.py``), ``config/*.yaml`` and the tables of docs are derived from
here and tested against it. A wrong value raises ParameterError that names parameter, value and
meaning. An unknown name is refused by the commands, and told in the log by the nodes.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import yaml

from rlml_slam.errors import FileFormatError, ParameterError

INF = math.inf


def param(
    default: Any,
    meaning: str,
    unit: str = '',
    low: float = -INF,
    high: float = INF,
    choices: tuple[str, ...] = (),
) -> Any:
    """A dataclass field that carries its own documentation and bounds (inclusive)."""
    return field(
        default=default,
        metadata={
            'meaning': meaning, 'unit': unit, 'low': low, 'high': high, 'choices': choices
        },
    )  # fmt: skip


@dataclass(frozen=True)
class Group:
    """A set of parameters; construction checks every value.

    ``prefix`` is what their names begin with, of the class's name where nothing else is said.
    """

    _prefix: ClassVar[str]

    def __init_subclass__(cls, prefix: str | None = None) -> None:
        """Keep the prefix, for errors that name a parameter as its user does."""
        of_class = re.sub('(?<=[a-z])(?=[A-Z])', '_', cls.__name__).lower() + '.'
        cls._prefix = of_class if prefix is None else prefix

    def __post_init__(self) -> None:
        """Check each field against its declared type, bounds and choices."""
        for f in dataclasses.fields(self):
            object.__setattr__(self, f.name, _checked(self._prefix, f, getattr(self, f.name)))


def _checked(prefix: str, f: dataclasses.Field[Any], value: Any) -> Any:
    """The value in the type of the field's default, or a ParameterError."""
    m = f.metadata

    def refuse(why: str) -> ParameterError:
        return ParameterError(f'{prefix}{f.name} = {value!r} {why} ({m["meaning"]})')

    if isinstance(f.default, bool):
        if not isinstance(value, bool):
            raise refuse('is not true or false')
        return value
    if isinstance(f.default, str):
        if not isinstance(value, str):
            raise refuse('is not a string')
        if m['choices'] and value not in m['choices']:
            raise refuse(f'is none of {", ".join(m["choices"])}')
        return value
    if isinstance(f.default, tuple):
        if isinstance(value, str) or not isinstance(value, list | tuple):
            raise refuse('is not a list')
        if f.default and isinstance(f.default[0], str):
            if not all(isinstance(v, str) for v in value):
                raise refuse('is not a list of strings')
            return tuple(value)
        if not all(_is_number(v) and math.isfinite(v) for v in value):
            raise refuse('is not a list of finite numbers')
        if len(value) != len(f.default):
            raise refuse(f'is not a list of {len(f.default)} numbers')
        if not all(m['low'] <= v <= m['high'] for v in value):
            raise refuse(f'has a number outside [{m["low"]:g}, {m["high"]:g}]')
        return tuple(float(v) for v in value)
    if not _is_number(value) or not math.isfinite(value):
        raise refuse('is not a finite number')
    if isinstance(f.default, int):
        if int(value) != value:
            raise refuse('is not a whole number')
        value = int(value)
    else:
        value = float(value)
    if not m['low'] <= value <= m['high']:
        raise refuse(f'is outside [{m["low"]:g}, {m["high"]:g}]')
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True)
class Node(Group, prefix=''):
    """Frames, topics and files; the names are slam_toolbox's where the thing is the same."""

    map_frame: str = param('map', 'frame of the map')
    odom_frame: str = param('odom', 'frame of the raw odometry')
    base_frame: str = param('base_link', 'frame of the robot; all estimates are of this frame')
    local_frame: str = param('rlml_local', "the front end's continuous frame")
    scan_topic: str = param('scan', 'LaserScan topic')
    scan_topics: tuple[str, ...] = param(
        ('',), 'LaserScan topics of several lidars, in the place of scan_topic'
    )
    odom_topic: str = param('odom', 'Odometry topic')
    imu_topic: str = param('imu', 'Imu topic')
    reflectors_topic: str = param('reflectors', 'PointCloud2 topic of reflector detections')
    reflector_poses_topic: str = param(
        'reflector_poses', 'PoseArray topic of reflector detections'
    )
    use_odom: bool = param(True, 'use odometry; false runs on scans and reflectors alone')
    use_imu: bool = param(True, 'use the yaw rate of the IMU where there is one')
    steady_stamps: bool = param(
        True, 'take the jitter out of the stamps of sensors that measure at a steady rate'
    )
    use_scan: bool = param(True, 'match scans against the submap')
    use_reflectors: bool = param(True, 'use reflector detections')
    mode: str = param(
        'mapping', 'mapping, or localization in a saved map', choices=('mapping', 'localization')
    )
    map_directory: str = param('maps', 'the only folder that maps are saved to and loaded from')
    map_file_name: str = param('map', 'name of the saved map inside map_directory, no suffix')
    continue_map: bool = param(
        False,
        'while mapping, go on with map_file_name.rlml where it is there',
    )
    map_start_pose: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), 'start pose in the map', 'm, m, rad'
    )
    restore_pose: bool = param(
        True, 'start in a saved map where the robot was last, if what it sees fits there'
    )
    laser_pose: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), 'pose of the laser in base_frame where no /tf_static tells', 'm, m, rad'
    )
    laser_upside_down: bool = param(
        False, 'the laser hangs upside down, its x axis at laser_pose, where no /tf_static tells'
    )
    transform_publish_period: float = param(
        0.02, 'shortest time between two of map to odom on /tf, one for each new frame', 's',
        0.001, 10.0,
    )  # fmt: skip
    transform_timeout: float = param(
        0.2, 'longest wait of a scan for the odometry at its stamp', 's', 0.0, 10.0
    )
    map_update_interval: float = param(
        2.0, 'period of map, graph and trajectory', 's', 0.05, 600.0
    )
    tf_buffer_duration: float = param(
        30.0, 'memory of odometry and of waiting inputs', 's', 1.0, 600.0
    )


@dataclass(frozen=True)
class MotionNoise(Group, prefix='motion.'):
    """Noise of odometry and IMU (eq. 6): sigma_v = a |v| + b, sigma_omega = c |omega| + d.

    The figures hold for a control interval of ``interval``; other intervals are scaled so that
    the accumulated covariance does not depend on the odometry's rate.
    """

    a: float = param(0.1, 'speed noise per speed', '', 0.0, 10.0)
    b: float = param(0.02, 'speed noise floor', 'm/s', 0.0, 10.0)
    c: float = param(0.2, 'turn rate noise per turn rate', '', 0.0, 10.0)
    d: float = param(0.05, 'turn rate noise floor', 'rad/s', 0.0, 10.0)
    lateral: float = param(0.05, 'sideways slip per speed', '', 0.0, 10.0)
    imu_c: float = param(0.005, "the IMU's turn rate noise per turn rate", '', 0.0, 10.0)
    imu_d: float = param(0.003, "the IMU's turn rate noise floor", 'rad/s', 0.0, 10.0)
    imu_bias_sigma: float = param(0.02, "the IMU's bias at start, 1 sigma", 'rad/s', 0.0, 10.0)
    imu_bias_walk: float = param(2e-4, "random walk of the IMU's bias", 'rad/s/sqrt(s)', 0.0, 1.0)
    scale_error_sigma: tuple[float, ...] = param(
        (0.03, 0.05),
        'share by which odometry errs in speed and in turn for a long time, 1 sigma; 0: never',
        '',
        0.0,
        1.0,
    )
    scale_error_time: float = param(
        600.0, 'correlation time of that error: load, floor, tyres', 's', 1.0, 1e6
    )
    interval: float = param(0.1, 'control interval that a, b, c, d are given for', 's', 1e-3, 10.0)
    long_interval_noise: float = param(
        0.2,
        'noise per speed and turn rate added inside an interval over two times `interval`',
        '',
        0.0,
        10.0,
    )
    max_gap: float = param(3.5, 'longest interval bridged by interpolation', 's', 0.01, 60.0)
    max_speed: float = param(
        5.0, 'a faster odometry step is a jump and is not used', 'm/s', 0.01, 100.0
    )
    max_turn_rate: float = param(15.0, 'a faster odometry turn is a jump', 'rad/s', 0.01, 100.0)
    constant_velocity_sigma: tuple[float, ...] = param(
        (1.0, 0.1, 2.0),
        'speed forward, sideways and of turning of a robot without odometry, 1 sigma',
        'm/s, m/s, rad/s',
    )
    constant_velocity_time: float = param(4.0, 'correlation time of these speeds', 's', 0.01, 60.0)
    constant_velocity_stamp_sigma: float = param(
        0.02, 'error of the stamps that it is told by', 's', 0.0, 1.0
    )


@dataclass(frozen=True)
class Reflector(Group):
    """Reflector detections and their association."""

    sigma_range: float = param(
        0.02, 'range noise of a detection that states none', 'm', 1e-4, 10.0
    )
    sigma_bearing: float = param(
        0.003, 'bearing noise of a detection that states none', 'rad', 1e-5, 1.0
    )
    sigma_fallback: float = param(
        0.025, 'noise per axis where range and bearing mean nothing', 'm', 1e-4, 10.0
    )
    gate: float = param(0.997, 'probability inside the association gate', '', 0.5, 0.999999)
    new_gate: float = param(
        0.99999,
        'a detection inside this gate of a known reflector never starts a new one',
        '',
        0.5,
        0.9999999,
    )
    separability_sigma: float = param(
        4.0, 'anonymous reflectors within this many sigmas of a detection are one', '', 0.0, 100.0
    )
    unmapped_density: float = param(
        0.02, 'reflectors per area that may stand unmapped: what a match competes with', '1/m²',
        1e-6, 10.0,
    )  # fmt: skip
    match_probability: float = param(
        0.99, 'probability of a match of an anonymous reflector to be used at once', '', 0.5, 1.0
    )
    track_timeout: float = param(
        3.0, 'a reflector seen within this time is the same one without a doubt', 's', 0.0, 60.0
    )
    min_separation: float = param(
        0.25, 'reflectors closer than this cannot be told apart', 'm', 0.0, 10.0
    )
    min_sightings: int = param(
        3, 'sightings before a candidate becomes a reflector of the map', '', 1, 100
    )
    candidate_timeout: float = param(
        20.0, 'a candidate not seen again for this long is dropped', 's', 0.1, 1e4
    )
    persistence_threshold: float = param(
        1e-3, 'probability of still being there below which a reflector leaves the map; 0: never',
        '', 0.0, 0.1,
    )  # fmt: skip
    robust_scale: float = param(
        3.0, 'Cauchy scale of the reflector residual, in sigmas', '', 0.5, 100.0
    )
    correlated_share: float = param(
        0.05, "share of a detection's variance that those of one keyframe have in common", '', 0.0,
        1.0,
    )  # fmt: skip
    max_range: float = param(40.0, 'detections farther away are not used', 'm', 0.5, 1000.0)


@dataclass(frozen=True)
class Submap(Group):
    """Probability grids that scans are matched against."""

    resolution: float = param(0.05, 'cell size', 'm', 0.01, 1.0)
    max_laser_range: float = param(30.0, 'beams longer than this are not used', 'm', 0.5, 300.0)
    max_points: int = param(500, 'most end points of one scan that are inserted', '', 20, 100000)
    p_hit: float = param(0.7, 'occupancy probability that one hit adds', '', 0.5, 0.99)
    p_miss: float = param(0.46, 'occupancy probability that one miss leaves', '', 0.01, 0.5)
    bias_variance: tuple[float, ...] = param(
        (1e-4, 1e-4, 2.25e-6),
        "variance of a submap's own error, common to its scans",
        'm², m², rad²',
        0.0,
        100.0,
    )
    grid_bias_variance: tuple[float, ...] = param(
        (4e-4, 4e-4, 9e-6),
        'variance of a fix in the grid of a saved map, common to its beams',
        'm², m², rad²',
        0.0,
        100.0,
    )
    insertions: int = param(90, 'insertions that complete a submap', '', 2, 10000)
    min_travel: float = param(0.1, 'travel between two insertions', 'm', 0.0, 10.0)
    min_turn: float = param(0.08, 'turn between two insertions', 'rad', 0.0, 3.2)


@dataclass(frozen=True)
class ScanMatch(Group):
    """Search and refinement of the scan term."""

    voxel: float = param(
        0.05, 'end points are thinned to one per cell of this size', 'm', 0.0, 1.0
    )
    max_points: int = param(400, 'most end points used by one match', '', 20, 10000)
    sigma: float = param(
        0.2, 'sigma_s of one end point (eq. 2), calibrated by NEES', '', 1e-3, 100.0
    )
    sigma_point: float = param(
        0.03, 'error of an end point across its surface, correlation included', 'm', 1e-3, 10.0
    )
    min_points: int = param(20, 'scans with fewer end points are not used', '', 3, 10000)
    variance_floor: tuple[float, ...] = param(
        (1e-6, 1e-6, 1e-7), 'variance of a match that more beams do not lower', 'm², m², rad²',
        0.0, 100.0,
    )  # fmt: skip
    min_score: float = param(
        0.3, 'mean hit probability below which a match is not used', '', 0.0, 1.0
    )
    search_score: float = param(
        0.55, 'mean hit probability below which the start is searched for', '', 0.0, 1.0
    )
    search_window: float = param(0.1, 'half width of the search', 'm', 0.0, 10.0)
    search_angle: float = param(0.35, 'half width of the search', 'rad', 0.0, 3.2)
    wide_search_score: float = param(
        0.58, 'mean hit probability below which the wide search is made', '', 0.0, 1.0
    )
    wide_window: float = param(0.6, 'half width of the wide search', 'm', 0.0, 10.0)
    wide_angle: float = param(0.5, 'half width of the wide search', 'rad', 0.0, 3.2)
    search_prior_weight: float = param(
        0.05, 'share of the hits that a component far from the prior costs in the search', '',
        0.0, 1.0,
    )  # fmt: skip
    max_iterations: int = param(20, 'Gauss-Newton iterations at most', '', 1, 200)
    prior_scale: float = param(
        3.0,
        'odometry prior is truncated beyond this many sigmas when the scan disagrees',
        '',
        0.5,
        100.0,
    )


@dataclass(frozen=True)
class HealthLimits(Group, prefix='health.'):
    """When the estimate counts as DEGRADED or LOST."""

    input_timeout: float = param(1.0, 'an input may fail for this long', 's', 0.0, 60.0)
    confirm_time: float = param(
        5.0, 'LOST when nothing matches the saved map for this long', 's', 0.0, 600.0
    )
    confirm_distance: float = param(
        5.0, 'DEGRADED when the saved map has not confirmed the pose for this far', 'm', 0.0, 1e4
    )
    degenerate_sigma: float = param(
        0.15, 'a scan that holds a direction worse leaves it open', 'm', 1e-3, 10.0
    )
    sigma_degraded: float = param(0.5, 'DEGRADED beyond this position sigma', 'm', 1e-3, 100.0)
    sigma_lost: float = param(2.0, 'LOST beyond this position sigma', 'm', 1e-3, 1000.0)
    contradiction_ratio: float = param(
        0.6, 'a scan that fits less than this share of the usual contradicts the map', '', 0.0, 1.0
    )
    lost_time: float = param(
        0.6, 'LOST when what is seen contradicts the map for this long', 's', 0.0, 60.0
    )
    new_place_time: float = param(
        5.0, 'while mapping, a place that is not found for this long is taken for a new one', 's',
        0.0, 1e6,
    )  # fmt: skip


@dataclass(frozen=True)
class BackEnd(Group):
    """Keyframes and the graph."""

    minimum_travel_distance: float = param(0.3, 'travel between two keyframes', 'm', 0.0, 100.0)
    minimum_travel_heading: float = param(0.25, 'turn between two keyframes', 'rad', 0.0, 3.2)
    minimum_time: float = param(
        10.0, 'a keyframe is taken after this long if the robot moved at all', 's', 0.0, 1e4
    )
    edge_covariance: str = param(
        'relative', 'covariance of an edge: of the relative motion, or eq. 14 literally',
        choices=('relative', 'sum'),
    )  # fmt: skip
    edge_variance_floor: tuple[float, ...] = param(
        (1e-6, 1e-6, 1e-7), 'variance added to every odometry edge', 'm², m², rad²', 0.0, 100.0
    )
    scan_edge_variance_floor: tuple[float, ...] = param(
        (1e-4, 1e-4, 4e-6),
        'variance added to a scan edge: of what the keyframes of one submap have in common',
        'm², m², rad²',
        0.0,
        100.0,
    )
    submap_size: int = param(40, 'keyframes that complete a submap', '', 2, 1000)
    match_sigma: tuple[float, ...] = param(
        (0.05, 0.05, 0.02),
        "prior of a keyframe's place in its submap, from the front end",
        'm, m, rad',
        1e-4,
        10.0,
    )
    scan_robust_scale: float = param(3.0, 'Cauchy scale of scan edges, in sigmas', '', 0.5, 1e3)
    optimize_every: int = param(
        5, 'keyframes between two optimisations without a closure', '', 1, 1000
    )
    odometry_robust_scale: float = param(
        3.0, 'Cauchy scale of odometry edges, in sigmas', '', 0.5, 1e3
    )
    closure_robust_scale: float = param(
        2.0, 'Huber scale of loop closures, in sigmas', '', 0.5, 1e3
    )
    resolution: float = param(0.05, 'cell size of the published map', 'm', 0.01, 1.0)
    keyframes_per_place: int = param(
        6, 'keyframes that one place keeps: older ones take over what more of them tell; 0: all',
        '', 0, 10000,
    )  # fmt: skip
    place_distance: float = param(0.5, 'keyframes nearer than this are of one place', 'm', 0.01,
                                  100.0)  # fmt: skip
    place_heading: float = param(0.6, 'and turned by less than this', 'rad', 0.01, 3.2)
    correction_speed: float = param(
        0.0, 'a correction moves the robot in map to odom no faster than this; 0: at once', 'm/s',
        0.0, 100.0,
    )  # fmt: skip
    correction_turn_rate: float = param(
        0.1, 'and turns it no faster than this', 'rad/s', 0.001, 100.0
    )
    jump_distance: float = param(
        0.05, 'a correction that moves the robot by more is told on jumps', 'm', 0.0, 100.0
    )
    survey: str = param(
        '',
        'survey of reflectors (.csv, .json, SICK .imk) in map_directory; the map gets its frame',
    )  # fmt: skip
    survey_sigma: float = param(
        0.02, 'error of a surveyed place per axis; 0.001 holds reflectors where surveyed', 'm',
        0.001, 1.0,
    )  # fmt: skip
    max_trajectory_frames: int = param(
        1_000_000, 'frames of which the path is kept; beyond, every second one is let go', '',
        1000, 100_000_000,
    )  # fmt: skip


@dataclass(frozen=True)
class LoopClosure(Group):
    """Candidates and their verification by scan match."""

    enabled: bool = param(True, 'look for loop closures')
    max_distance: float = param(
        8.0, 'candidates nearer than this are tried; farther ones as the pose is uncertain', 'm',
        0.1, 100.0,
    )  # fmt: skip
    min_score: float = param(0.55, 'mean hit probability that a closure must reach', '', 0.1, 1.0)
    keyframe_interval: int = param(3, 'try every n-th keyframe', '', 1, 1000)
    variance_floor: tuple[float, ...] = param(
        (1e-4, 1e-4, 1e-5), 'variance of a closure that more beams do not lower', 'm², m², rad²',
        0.0, 100.0,
    )  # fmt: skip
    max_candidates: int = param(3, 'submaps tried per keyframe, nearest first', '', 1, 100)
    ambiguity_ratio: float = param(
        0.95, 'score of the second place relative to the best', '', 0.1, 1.0
    )
    search_window: float = param(3.0, 'least half width of the search', 'm', 0.1, 100.0)
    search_angle: float = param(0.5, 'least half width of the search', 'rad', 0.01, 3.2)
    max_search_window: float = param(
        12.0, 'the search is as wide as the pose is uncertain, but no wider', 'm', 0.1, 100.0
    )
    max_search_angle: float = param(
        1.5, 'the search turns as far as the pose is uncertain, but no farther', 'rad', 0.01, 3.2
    )

    @property
    def searched(self) -> float:
        """Area [m²] of the least search, were it made at all headings."""
        return (2.0 * self.search_window) ** 2 * self.search_angle / math.pi


@dataclass(frozen=True)
class Relocalization(Group):
    """Where in a map of reflectors anonymous detections were made, without any idea before."""

    gate: float = param(
        0.999, 'probability inside the gate of a detection and a reflector', '', 0.5, 0.999999
    )
    false_positive_probability: float = param(
        1e-4, 'probability that a verdict of unique may be wrong', '', 1e-12, 0.5
    )
    sigma_floor: float = param(
        0.01, 'error of a detection besides the noise that it states', 'm', 1e-4, 1.0
    )
    missing: float = param(0.3, 'share of reflectors in range that are not seen', '', 0.01, 0.99)
    ghosts: float = param(0.3, 'share of detections that are of no reflector', '', 0.01, 0.99)
    max_range: float = param(
        0.0, 'a reflector nearer than this should be seen; 0: unseen ones tell nothing', 'm',
        0.0, 1000.0,
    )  # fmt: skip
    max_sigma: float = param(
        0.2, 'a pose is not unique while its position is held worse', 'm', 1e-3, 100.0
    )


@dataclass(frozen=True)
class Solver(Group):
    """Sparse least squares."""

    max_iterations: int = param(50, 'iterations at most', '', 1, 10000)
    relative_tolerance: float = param(
        1e-5, 'stop when the cost falls by less than this share', '', 0.0, 1.0
    )
    method: str = param(
        'auto', 'how a step is chosen; auto is Gauss-Newton, and dog-leg where that fails',
        choices=('auto', 'gauss_newton', 'levenberg_marquardt', 'dog_leg'),
    )  # fmt: skip
    initialization: str = param(
        'auto', 'start of a solve: the estimate at hand, or one computed from the edges; auto '
        'computes one only where the estimate fits badly',
        choices=('none', 'auto', 'odometry', 'spanning_tree', 'chordal'),
    )  # fmt: skip


@dataclass(frozen=True)
class Deformable(Group):
    """The sliding window over the robot and the features of a moving, deforming carrier."""

    window: int = param(15, 'steps that are estimated together; older ones are marginalised', '',
                        2, 200)  # fmt: skip
    drift: float = param(
        0.05, "random walk of each feature against the carrier's nominal motion", 'm/sqrt(s)',
        1e-4, 10.0,
    )  # fmt: skip
    common_drift: float = param(
        0.05, 'random walk of the whole carrier against its nominal motion', 'm/sqrt(s)', 0.0, 10.0
    )
    feature_timeout: float = param(
        5.0, 'a feature not seen for this long is dropped', 's', 0.1, 1e4
    )
    candidate_timeout: float = param(
        1.0, 'a feature with few sightings is dropped sooner', 's', 0.05, 1e4
    )
    start_sigma: tuple[float, ...] = param(
        (1e-3, 1e-3, 1e-4), 'uncertainty of the first pose', 'm, m, rad', 0.0, 100.0
    )
    max_iterations: int = param(5, 'Gauss-Newton iterations per update at most', '', 1, 100)
    tolerance: float = param(
        1e-4, 'iterations stop when no state moves by more than this', 'm or rad', 1e-12, 1.0
    )
    motion_floor: float = param(
        2e-4, "noise added to the odometry's, so that a standing robot's is not zero",
        'm/sqrt(s), rad/sqrt(s)', 1e-6, 1.0,
    )  # fmt: skip
    velocity_timeout: float = param(
        1.0, 'an older velocity of the carrier is still used, but DEGRADED', 's', 0.01, 1e4
    )
    suggest: str = param(
        'off', 'publish on cmd_vel_suggested how to see the features best, for either drive',
        choices=('off', 'omnidirectional', 'differential'),
    )  # fmt: skip
    plan_step: float = param(1.0, 'length of each of the 6 steps of a plan', 's', 0.05, 60.0)
    plan_offset: float = param(
        0.5, "largest offset of a suggestion from the carrier's velocity", 'm/s', 0.01, 10.0
    )


@dataclass(frozen=True)
class Ekf(Group):
    """EKF-SLAM, the second system: what it takes for landmarks and how it holds them."""

    extractor: str = param(
        'reflectors', 'landmarks are reflector detections, or come out of the scan',
        choices=('reflectors', 'spikes', 'lines'),
    )  # fmt: skip
    association: str = param(
        'auto', 'the nearest in Mahalanobis distance, joint compatibility, or that and, in doubt, '
        'what is seen later; auto: deferred for reflectors, nearest for spikes',
        choices=('auto', 'nearest', 'joint', 'deferred'),
    )  # fmt: skip
    gate: float = param(0.997, 'probability inside the validation gate', '', 0.5, 0.999999)
    new_gate: float = param(
        0.99999, 'a detection inside this gate of a landmark never starts a candidate', '',
        0.5, 0.9999999,
    )  # fmt: skip
    min_separation: float = param(
        0.25, 'a detection this near to a landmark never starts a candidate', 'm', 0.0, 20.0
    )
    min_sightings: int = param(3, 'sightings before a candidate enters the state', '', 1, 1000)
    candidate_timeout: float = param(
        5.0, 'a candidate not seen again for this long is dropped', 's', 0.01, 1e4
    )
    candidate_sigma: float = param(
        0.5, 'a candidate whose place relative to the robot is less sure is dropped', 'm',
        1e-3, 100.0,
    )  # fmt: skip
    range_noise: float = param(0.0, 'range noise per range, added to the detection', '', 0.0, 1.0)
    landmark_sigma: float = param(
        0.0, 'extent of what is held as one landmark, 1 sigma, added to the detection', 'm',
        0.0, 10.0,
    )  # fmt: skip
    update: str = param(
        'compressed', 'full update of all landmarks each time, or postponed for far ones',
        choices=('plain', 'compressed'),
    )  # fmt: skip
    local_radius: float = param(
        10.0,
        'landmarks nearer than this, or than the sensor reaches, are updated at once',
        'm',
        0.5,
        1e4,
    )
    local_margin: float = param(
        5.0, 'travel after which the local region is chosen anew', 'm', 0.1, 1e4
    )
    error: str = param(
        'invariant',
        "the note's error of each coordinate, or one that turns with the heading and stays "
        'consistent',
        choices=('additive', 'invariant'),
    )
    line_origin: tuple[float, ...] = param(
        (0.0, 0.0), 'fixed point of the map; a line is its point nearest to this', 'm, m'
    )
    smooth: bool = param(
        True, 'replay: path and map are smoothed in the end, by what was measured later as well'
    )  # fmt: skip


@dataclass(frozen=True)
class Spikes(Group):
    """Spike landmarks of a scan."""

    test: str = param(
        'jump', 'jump between neighbours on both sides, or sum of both differences',
        choices=('jump', 'sum'),
    )  # fmt: skip
    threshold: float = param(0.5, 'range difference that makes a spike', 'm', 1e-3, 100.0)
    reach: int = param(1, 'sum test: neighbours are this many valid beams away', '', 1, 100)
    min_beams: int = param(1, 'fewer beams are no spike', '', 1, 1000)
    max_width: float = param(
        0.3, 'wider objects are no landmarks; a person is wider', 'm', 1e-3, 10.0
    )
    max_range: float = param(25.0, 'farther spikes are not used', 'm', 0.1, 1000.0)
    round: bool = param(
        True, 'spikes are cylinders: the centre is pi/8 of the width behind the mean of its ranges'
    )  # fmt: skip
    offset: float = param(
        0.0, "added to a spike's range, against an error that the laser makes on such objects",
        'm', -1.0, 1.0,
    )  # fmt: skip
    sigma_range: float = param(0.03, 'range noise of a spike', 'm', 1e-4, 10.0)
    sigma_bearing: float = param(0.005, 'bearing noise of a spike', 'rad', 1e-5, 1.0)


@dataclass(frozen=True)
class Ransac(Group):
    """RANSAC lines of a scan; the five parameters of the note are named in brackets."""

    seed: int = param(0, 'seed of the samples; one scan always gives the same lines', '', 0, 2**31)
    max_trials: int = param(100, 'trials at most (N)', '', 1, 100000)
    samples: int = param(5, 'readings sampled besides the first one (S)', '', 1, 100)
    sample_angle: float = param(
        0.17, 'samples lie within this of the first reading (D)', 'rad', 1e-3, 3.2
    )
    tolerance: float = param(0.04, 'readings this near to a line belong to it (X)', 'm', 1e-4, 10)
    consensus: int = param(60, 'readings that make a line (C)', '', 3, 100000)
    min_length: float = param(1.0, 'shorter lines are not used', 'm', 0.0, 100.0)
    max_gap: float = param(0.5, 'a line ends where its readings leave a gap', 'm', 1e-3, 100.0)
    sigma: float = param(0.01, 'noise of a reading across its line', 'm', 1e-4, 10.0)
    sigma_floor: tuple[float, ...] = param(
        (0.01, 0.004), "error of a line's distance and direction that more readings do not lower",
        'm, rad', 0.0, 10.0,
    )  # fmt: skip


@dataclass(frozen=True)
class Detector(Group):
    """Reflectors in the intensities of a scan: what is bright enough, and of the right shape."""

    threshold: str = param(
        'automatic', 'how bright a reflector is: brighter than all else in the same scan, above '
        'a exp(-k r) + floor, or marked by the vendor (intensity 65534 and more)',
        choices=('automatic', 'curve', 'bit'),
    )  # fmt: skip
    contrast: float = param(
        5.0, 'automatic: intensity of a reflector per that of bright other surfaces as far away',
        '', 1.1, 1000.0,
    )  # fmt: skip
    a: float = param(1000.0, 'curve: fading part of the threshold, at range 0', '', 0.0, 1e9)
    k: float = param(0.1, 'curve: loss of the fading part with range', '1/m', 0.0, 100.0)
    floor: float = param(
        0.0, 'curve and automatic: what is less bright is no reflector', '', 0.0, 1e9
    )
    diameter: float = param(0.08, 'diameter of cylinders; 0 is none', 'm', 0.0, 2.0)
    flat_width: float = param(0.0, 'width of flat reflectors; 0 is none', 'm', 0.0, 2.0)
    size_tolerance: float = param(
        0.025, 'what is narrower or wider by more is something else', 'm', 0.0, 1.0
    )
    divergence: float = param(
        0.003, 'angle of a beam between its halves of power', 'rad', 0.0, 0.1
    )
    edge: float = param(
        0.4, 'share of its brightness by which a reflector ends at once on either side; the '
        'glare of a glossy wall fades',
        '', 0.0, 1.0,
    )  # fmt: skip
    separation: float = param(
        0.2, 'bright spots nearer to each other are parts of something larger', 'm', 0.0, 10.0
    )
    min_beams: int = param(1, 'fewer beams are no reflector', '', 1, 1000)
    min_range: float = param(0.2, 'nearer ones are not used', 'm', 0.0, 100.0)
    max_range: float = param(40.0, 'farther ones are not used', 'm', 0.5, 1000.0)
    sigma_range: float = param(0.01, 'range noise of one beam', 'm', 1e-4, 1.0)
    sigma_bearing: float = param(0.0005, 'error of a bearing that more beams do not lower', 'rad',
                                 1e-6, 0.1)  # fmt: skip
    sigma_floor: float = param(
        0.003, 'error of a range that more beams do not lower', 'm', 1e-5, 1.0
    )


@dataclass(frozen=True)
class Parameters:
    """One of every group. Fields of ``node`` have plain ROS names, all others ``group.field``."""

    node: Node = Node()
    motion: MotionNoise = MotionNoise()
    reflector: Reflector = Reflector()
    submap: Submap = Submap()
    scan_match: ScanMatch = ScanMatch()
    health: HealthLimits = HealthLimits()
    back_end: BackEnd = BackEnd()
    loop_closure: LoopClosure = LoopClosure()
    relocalization: Relocalization = Relocalization()
    solver: Solver = Solver()


@dataclass(frozen=True)
class EkfParameters(Parameters):
    """Parameters of the EKF system: its own groups, and those that both systems share."""

    ekf: Ekf = Ekf()
    spikes: Spikes = Spikes()
    ransac: Ransac = Ransac()


@dataclass(frozen=True)
class DeformableParameters:
    """Parameters of deformable_slam: its own group, and those that it shares."""

    node: Node = Node()
    motion: MotionNoise = MotionNoise()
    reflector: Reflector = Reflector()
    deformable: Deformable = Deformable()


@dataclass(frozen=True)
class DetectorParameters:
    """Parameters of reflector_detector: its own group, and those that it shares."""

    node: Node = Node()
    motion: MotionNoise = MotionNoise()
    detector: Detector = Detector()


@dataclass(frozen=True)
class Simulator(Group, prefix=''):
    """The synthetic world, the robot in it and how it runs; a seed fixes all of it."""

    world: str = param('hall', 'name of a world of the package, or path of a world file')
    seed: int = param(0, 'seed of all noise', '', 0, 2**31 - 1)
    rate: float = param(1.0, 'simulated seconds per second', '', 0.01, 1000.0)
    drive: str = param(
        'route', "follow the world's route, or the cmd_vel topic", choices=('route', 'cmd_vel')
    )
    repeat: bool = param(False, 'drive the route again and again')
    duration: float = param(0.0, 'stop after this long; 0 is when the route is done', 's', 0, 1e6)
    exit_at_end: bool = param(True, 'the node ends, with exit code 0, when the drive is done')
    wait_for_subscribers: int = param(
        0, 'time begins when the scan has this many subscribers', '', 0, 100
    )
    still_time: float = param(1.0, 'stands still before and after the route', 's', 0.0, 600.0)
    speed: float = param(1.0, 'highest speed', 'm/s', 0.01, 10.0)
    acceleration: float = param(0.8, 'highest acceleration', 'm/s^2', 0.01, 20.0)
    turn_rate: float = param(1.0, 'highest turn rate', 'rad/s', 0.01, 10.0)
    turn_acceleration: float = param(3.0, 'highest turn acceleration', 'rad/s^2', 0.01, 50.0)
    lookahead: float = param(0.7, 'distance of the point on the route steered at', 'm', 0.1, 10.0)
    command_timeout: float = param(0.5, 'stops when cmd_vel is older than this', 's', 0.01, 60.0)
    kidnap_time: float = param(
        0.0, 'the robot is carried away after this long; 0 is never', 's', 0.0, 1e6
    )
    kidnap_distance: float = param(
        -10.0, 'how far it is carried along its route, backwards if negative', 'm', -1e4, 1e4
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
    """Wheel odometry of the simulator; a to d, lateral and interval as in MotionNoise."""

    rate: float = param(50.0, 'rate of odometry', 'Hz', 1.0, 1000.0)
    a: float = param(0.05, 'speed noise per speed', '', 0.0, 10.0)
    b: float = param(0.01, 'speed noise floor of a moving robot', 'm/s', 0.0, 10.0)
    c: float = param(0.05, 'turn rate noise per turn rate', '', 0.0, 10.0)
    d: float = param(0.01, 'turn rate noise floor of a moving robot', 'rad/s', 0.0, 10.0)
    lateral: float = param(
        0.02, 'true sideways motion per speed, which the wheels do not see', '', 0.0, 10.0
    )
    interval: float = param(0.1, 'control interval that the noise is given for', 's', 1e-3, 10.0)
    speed_scale: float = param(1.0, 'reported per true speed', '', 0.1, 10.0)
    turn_scale: float = param(1.0, 'reported per true turn rate', '', 0.1, 10.0)
    slip_rate: float = param(0.0, 'slip bursts per second of motion', '1/s', 0.0, 100.0)
    slip_duration: float = param(0.5, 'length of a burst', 's', 0.01, 60.0)
    slip_speed: float = param(0.5, 'speed overstated by up to this share', '', 0.0, 10.0)
    slip_turn: float = param(0.3, 'sigma of the false turn rate of a burst', 'rad/s', 0.0, 10.0)


@dataclass(frozen=True)
class Gyro(Group):
    """IMU of the simulator; c, d and interval as imu_c, imu_d and interval in MotionNoise."""

    rate: float = param(100.0, 'rate of the IMU', 'Hz', 1.0, 2000.0)
    c: float = param(0.005, 'turn rate noise per turn rate', '', 0.0, 10.0)
    d: float = param(0.003, 'turn rate noise floor', 'rad/s', 0.0, 10.0)
    interval: float = param(0.1, 'control interval that the noise is given for', 's', 1e-3, 10.0)
    bias: float = param(0.005, 'bias at start', 'rad/s', -1.0, 1.0)
    bias_walk: float = param(5e-5, 'random walk of the bias', 'rad/s/sqrt(s)', 0.0, 1.0)


@dataclass(frozen=True)
class Laser(Group):
    """Laser of the simulator. Intensities are 1000 for a white wall met head on at 1 m."""

    rate: float = param(10.0, 'scans per second', 'Hz', 0.5, 100.0)
    beams: int = param(1440, 'beams per scan', '', 2, 20000)
    field_of_view: float = param(2 * math.pi, 'angle swept', 'rad', 0.1, 2 * math.pi)
    range_min: float = param(0.1, 'nearer is reported as -Inf', 'm', 0.0, 10.0)
    range_max: float = param(30.0, 'farther is reported as +Inf', 'm', 1.0, 500.0)
    ray_times: bool = param(True, 'each ray is cast at its own time; false: all at the stamp')
    range_sigma: float = param(0.01, 'range noise', 'm', 0.0, 1.0)
    divergence: float = param(0.003, 'full angle of a beam', 'rad', 0.0, 0.1)
    dropped: float = param(0.002, 'share of beams lost, reported as NaN', '', 0.0, 1.0)
    retro_gain: float = param(30.0, 'brightness of a reflector per white wall', '', 1.0, 1e4)
    gain_range: float = param(10.0, 'range where the received power has halved', 'm', 0.1, 1e3)
    intensity_noise: float = param(0.03, 'intensity noise per intensity', '', 0.0, 1.0)
    min_intensity: float = param(1.0, 'a weaker echo is no return', '', 0.0, 1e6)


@dataclass(frozen=True)
class Markers(Group):
    """Reflector detections of the simulator, one message per scan."""

    enabled: bool = param(True, 'detect reflectors')
    sigma_range: float = param(0.02, 'range noise', 'm', 0.0, 10.0)
    sigma_bearing: float = param(0.003, 'bearing noise', 'rad', 0.0, 1.0)
    max_range: float = param(25.0, 'farther reflectors are not detected', 'm', 0.5, 500.0)
    max_incidence: float = param(
        1.0, 'flat reflectors are not detected at a wider angle to their normal', 'rad', 0.1, 1.57
    )
    ids: bool = param(False, 'detections tell which reflector they are of')
    missing: float = param(0.02, 'share of detections that fail to appear', '', 0.0, 1.0)
    ghosts: float = param(0.01, 'mean number of false detections per scan', '', 0.0, 100.0)


@dataclass(frozen=True)
class Transport(Group):
    """Faults of the simulator between sensor and robot, for every message on its own."""

    jitter: float = param(0.0, 'sigma of the error of a stamp', 's', 0.0, 1.0)
    late: float = param(0.0, 'share of messages that are late', '', 0.0, 1.0)
    late_delay: float = param(0.3, 'longest delay of a late message', 's', 0.0, 60.0)
    dropped: float = param(0.0, 'share of messages that never arrive', '', 0.0, 1.0)


@dataclass(frozen=True)
class SimulatorParameters:
    """All of the simulator. Fields of ``node`` have plain ROS names, others ``group.field``."""

    node: Simulator = Simulator()
    wheels: Wheels = Wheels()
    gyro: Gyro = Gyro()
    laser: Laser = Laser()
    markers: Markers = Markers()
    transport: Transport = Transport()


@dataclass(frozen=True)
class CarrierRun(Group, prefix=''):
    """How carrier_simulator runs; a seed fixes all of it."""

    seed: int = param(0, 'seed of all noise', '', 0, 2**31 - 1)
    rate: float = param(1.0, 'simulated seconds per second', '', 0.01, 1000.0)
    duration: float = param(0.0, 'stop after this long; 0 is never', 's', 0.0, 1e6)
    exit_at_end: bool = param(True, 'the node ends, with exit code 0, after the duration')
    wait_for_subscribers: int = param(
        0, 'time begins when the reflectors have this many subscribers', '', 0, 100
    )
    map_frame: str = param('map', 'frame of the ground truth: the base at start')
    odom_frame: str = param('odom', 'frame of the odometry')
    base_frame: str = param('base_link', 'frame of the robot and of its detections')


@dataclass(frozen=True)
class Carrier(Group):
    """The carrier, the robot beside it and its sensors; the noise is what it says."""

    kind: str = param(
        'train', 'its features stay together and turn, or pass by and are replaced',
        choices=('train', 'conveyor'),
    )  # fmt: skip
    features: int = param(6, 'features at one time', '', 1, 100)
    rate: float = param(10.0, 'detections and odometry per second', 'Hz', 0.1, 1000.0)
    speed: float = param(1.0, 'mean nominal speed', 'm/s', 0.0, 10.0)
    turn_rate: float = param(0.1, "amplitude of the train's swaying turn", 'rad/s', 0.0, 3.0)
    drift: float = param(0.05, 'random walk of each feature', 'm/sqrt(s)', 0.0, 10.0)
    common_drift: float = param(0.05, 'random walk of the whole carrier', 'm/sqrt(s)', 0.0, 10.0)
    odometry_sigma: tuple[float, ...] = param(
        (0.01, 0.01, 0.004), 'odometry noise along, across per speed, and of the heading',
        'm/sqrt(s), sqrt(s), rad/sqrt(s)', 0.0, 10.0,
    )  # fmt: skip
    sigma: float = param(0.02, 'noise of a detection per axis', 'm', 1e-9, 10.0)
    max_range: float = param(8.0, 'farther features are not detected', 'm', 0.5, 500.0)
    missing: float = param(0.1, 'share of detections that fail to appear', '', 0.0, 1.0)
    ghosts: float = param(0.0, 'mean number of false detections per step', '', 0.0, 100.0)
    ids: bool = param(True, 'detections tell which feature they are of')


@dataclass(frozen=True)
class CarrierParameters:
    """Parameters of carrier_simulator."""

    node: CarrierRun = CarrierRun()
    carrier: Carrier = Carrier()


@dataclass(frozen=True)
class Player(Group, prefix=''):
    """The bag that bag_player publishes, and how."""

    bag: str = param('', 'rosbag2 folder (sqlite3 or mcap), .mcap, .db3 or ROS 1 .bag')
    rate: float = param(1.0, 'seconds of the recording per second', '', 0.01, 1000.0)
    clock_rate: float = param(100.0, 'rate of /clock in time of the recording', 'Hz', 1.0, 1e4)
    wait_for_subscribers: int = param(
        0, 'time begins when some topic has this many subscribers', '', 0, 100
    )
    start_delay: float = param(1.0, 'pause before time begins, for discovery', 's', 0.0, 600.0)


@dataclass(frozen=True)
class PlayerParameters:
    """Parameters of bag_player."""

    node: Player = Player()


# names of the nodes that each is for
NODES: Mapping[type[Any], tuple[str, ...]] = {
    Parameters: ('front_end', 'back_end'),
    EkfParameters: ('ekf_slam',),
    DeformableParameters: ('deformable_slam',),
    DetectorParameters: ('reflector_detector',),
    SimulatorParameters: ('simulator',),
    CarrierParameters: ('carrier_simulator',),
    PlayerParameters: ('bag_player',),
}
# parameters that every node of ROS has
ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


@dataclass(frozen=True)
class Declaration:
    """One parameter as the outside world sees it; ``name`` is its ROS name."""

    name: str
    group: str
    field: str
    default: Any
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]
    meaning: str


def declarations(of: type = Parameters) -> Iterator[Declaration]:
    """Every parameter of the groups in ``of``, in order."""
    for g in dataclasses.fields(of):
        prefix = '' if g.name == 'node' else f'{g.name}.'
        group: Any = type(g.default)
        for f in dataclasses.fields(group):
            yield Declaration(
                prefix + f.name, g.name, f.name, f.default,
                *(f.metadata[k] for k in ('unit', 'low', 'high', 'choices', 'meaning')),
            )  # fmt: skip


def from_mapping(values: Mapping[str, Any], of: type[Any] = Parameters) -> Any:
    """Parameters with ``values`` (ROS names, flat) instead of the defaults.

    Raises ParameterError for an unknown name or a value that its field refuses.
    """
    known = {d.name: d for d in declarations(of)}
    groups: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name not in known:
            raise ParameterError(f'unknown parameter {name!r}; known are {_nearest(name, known)}')
        groups.setdefault(known[name].group, {})[known[name].field] = value
    default = of()
    return dataclasses.replace(
        default,
        **{g: dataclasses.replace(getattr(default, g), **v) for g, v in groups.items()},
    )


def _nearest(name: str, known: Mapping[str, Any]) -> str:
    import difflib

    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return ', '.join(near) if near else 'listed in docs/parameters.md'


def flatten(tree: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Nested mappings as one with dotted names, as ROS does."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f'{prefix}{key}.'))
        else:
            flat[f'{prefix}{key}'] = value
    return flat


def read_yaml(path: str | Path, of: type[Any] = Parameters) -> dict[str, Any]:
    """The flat parameters for the nodes of ``of`` in a ROS parameter file, which others may share.

    Sections are those of a node (``front_end: ros__parameters: ...``), in whatever namespace, or
    of all nodes (``/**``). What another node of this package knows is left to that one. Raises
    FileFormatError for another kind of file, ParameterError for a name that no node knows.
    """
    try:
        tree = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except OSError as e:
        raise FileFormatError(f'{path}: cannot be read: {e.strerror}') from e
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        raise FileFormatError(f'{path}: not YAML: {str(e).splitlines()[0]}') from e
    if not isinstance(tree, Mapping):
        raise FileFormatError(f'{path}: no parameters in it')
    ours = ('**', '*', *NODES[of])
    sections = [flat for name, flat in _sections(tree, str(path)) if name in ours]
    if not sections:
        raise FileFormatError(f'{path}: no section of {" or ".join(NODES[of])}, nor of /**')
    known = {d.name for d in declarations(of)}
    foreign = {d.name for other in NODES for d in declarations(other)} - known
    return {
        name: value
        for section in sections
        for name, value in section.items()
        if name not in foreign and not name.startswith(ROS_OWN)
    }


def _sections(tree: Mapping[str, Any], path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name of the node, without its namespace, and flat parameters of each section of a file."""
    for key, body in tree.items():
        if not isinstance(body, Mapping):
            raise FileFormatError(f'{path}: {key!r} has no ros__parameters')
        parameters = body.get('ros__parameters')
        if isinstance(parameters, Mapping):
            yield str(key).rsplit('/')[-1], flatten(parameters)
        else:
            yield from _sections(body, path)
