# SPDX-License-Identifier: Apache-2.0
"""Keyframes, loop closures, global localization and the solver of the graph."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class BackEnd(Group):
    """Keyframes and the graph."""

    minimum_travel_distance: float = param(0.3, 'travel between two keyframes', 'm', 0.0, 100.0)
    minimum_travel_heading: float = param(0.25, 'turn between two keyframes', 'rad', 0.0, 3.2)
    minimum_time: float = param(
        10.0, 'longest time between two keyframes of a moving robot', 's', 0.0, 1e4
    )
    edge_covariance: str = param(
        'relative',
        'covariance of an edge: of the relative motion, or the sum of eq. 14',
        choices=('relative', 'sum'),
    )
    edge_variance_floor: tuple[float, ...] = param(
        (1e-6, 1e-6, 1e-7), 'variance added to every odometry edge', 'm², m², rad²', 0.0, 100.0
    )
    scan_edge_variance_floor: tuple[float, ...] = param(
        (1e-4, 1e-4, 4e-6),
        'variance that keyframes of a submap share; times submap_size / 2 without reflectors',
        'm², m², rad²',
        0.0,
        100.0,
    )
    submap_size: int = param(40, 'number of keyframes that complete a submap', '', 2, 1000)
    match_sigma: tuple[float, ...] = param(
        (0.05, 0.05, 0.02),
        'prior of the pose of a keyframe in its submap, from the front end, 1 sigma',
        'm, m, rad',
        1e-4,
        10.0,
    )
    scan_robust_scale: float = param(3.0, 'Cauchy scale of scan edges, in sigmas', '', 0.5, 1e3)
    optimize_every: int = param(
        5, 'keyframes between two optimizations when there is no closure', '', 1, 1000
    )
    odometry_robust_scale: float = param(
        3.0, 'Huber scale of odometry edges, in sigmas', '', 0.5, 1e3
    )
    closure_robust_scale: float = param(
        2.0, 'Huber scale of loop closures, in sigmas', '', 0.5, 1e3
    )
    resolution: float = param(0.05, 'cell size of the published map', 'm', 0.01, 1.0)
    keyframes_per_place: int = param(
        6, 'keyframes kept per place; others are marginalized; 0: all are kept', '', 0, 10000
    )
    place_distance: float = param(
        0.5, 'keyframes closer than this belong to one place', 'm', 0.01, 100.0
    )
    place_heading: float = param(0.6, 'and with headings closer than this', 'rad', 0.01, 3.2)
    correction_speed: float = param(
        0.0, 'rate limit of corrections of map to odom; 0: none', 'm/s', 0.0, 100.0, live=True
    )
    correction_turn_rate: float = param(
        0.1,
        'rate limit of corrections of the heading, if correction_speed is not 0',
        'rad/s',
        0.001,
        100.0,
        live=True,
    )
    jump_distance: float = param(
        0.05,
        'a correction that moves the robot by more is published on jumps',
        'm',
        0.0,
        100.0,
        live=True,
    )
    survey: str = param(
        '', 'survey of reflectors (.csv, .json, SICK .imk) in map_directory; defines the map frame'
    )
    survey_sigma: float = param(
        0.02, 'error of a surveyed position per axis, 1 sigma', 'm', 0.001, 1.0
    )
    max_trajectory_frames: int = param(
        1_000_000,
        'frames kept in the trajectory; beyond, every second one is dropped',
        '',
        1000,
        100_000_000,
    )


@dataclass(frozen=True)
class LoopClosure(Group):
    """Loop closure candidates and their verification by scan matching."""

    enabled: bool = param(True, 'search for loop closures')
    max_distance: float = param(
        8.0,
        'candidates closer than this are tried; the pose uncertainty extends it',
        'm',
        0.1,
        100.0,
    )
    min_score: float = param(0.55, 'smallest mean hit probability of a closure', '', 0.1, 1.0)
    keyframe_interval: int = param(3, 'every n-th keyframe is tried', '', 1, 1000)
    variance_floor: tuple[float, ...] = param(
        (1e-4, 1e-4, 1e-5),
        'smallest variance of a closure, however many beams it has',
        'm², m², rad²',
        0.0,
        100.0,
    )
    max_candidates: int = param(3, 'submaps tried per keyframe, nearest first', '', 1, 100)
    ambiguity_ratio: float = param(
        0.95, 'a closure is ambiguous if another pose has this share of its score', '', 0.1, 1.0
    )
    search_window: float = param(
        3.0, 'smallest half width of the search in position', 'm', 0.1, 100.0
    )
    search_angle: float = param(
        0.5, 'smallest half width of the search in heading', 'rad', 0.01, 3.2
    )
    max_search_window: float = param(
        20.0,
        'largest half width of the search in position, which grows with the pose uncertainty',
        'm',
        0.1,
        100.0,
    )
    max_search_angle: float = param(
        1.5,
        'largest half width of the search in heading, which grows with the pose uncertainty',
        'rad',
        0.01,
        3.2,
    )

    @property
    def searched(self) -> float:
        """Area [m²] of the smallest search, scaled by its share of all headings."""
        return (2.0 * self.search_window) ** 2 * self.search_angle / math.pi


@dataclass(frozen=True)
class Relocalization(Group):
    """Global localization by the constellation of anonymous reflectors, without a prior pose."""

    gate: float = param(
        0.999, 'probability inside the gate between a detection and a reflector', '', 0.5, 0.999999
    )
    false_positive_probability: float = param(
        1e-4, 'largest probability that a pose reported as unique is wrong', '', 1e-12, 0.5
    )
    sigma_floor: float = param(
        0.01, 'error of a detection in addition to its own covariance', 'm', 1e-4, 1.0
    )
    missed_share: float = param(
        0.3, 'expected share of reflectors in range that are not detected', '', 0.01, 0.99
    )
    false_share: float = param(0.3, 'expected share of false detections', '', 0.01, 0.99)
    max_range: float = param(
        0.0,
        'a visible reflector closer than this should be detected; 0: missing ones are no evidence',
        'm',
        0.0,
        1000.0,
    )
    max_sigma: float = param(
        0.2, 'a pose with a larger position sigma is not unique', 'm', 1e-3, 100.0
    )
    max_lookups: int = param(
        250_000_000,
        'end points that one search looks up in the map, about a second of work; beyond, the '
        'verdict is: not searched',
        '',
        1000,
        1_000_000_000_000,
    )


@dataclass(frozen=True)
class Solver(Group):
    """Sparse nonlinear least squares."""

    max_iterations: int = param(50, 'largest number of iterations', '', 1, 10000)
    relative_tolerance: float = param(
        1e-5, 'stops when the cost decreases by less than this share', '', 0.0, 1.0
    )
    initialization: str = param(
        'auto',
        'start: the current estimate (none), or one computed from the edges; auto computes one '
        'only if the current estimate fits badly',
        choices=('none', 'auto', 'chordal'),
    )
