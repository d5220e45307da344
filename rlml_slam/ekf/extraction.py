# SPDX-License-Identifier: Apache-2.0
"""Extraction of measurements from an observation: reflectors, spikes or lines."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.landmark_models import to_polar
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.deskew import base_at, sweep_time
from rlml_slam.sensing.features import lines, spikes
from rlml_slam.types import ANONYMOUS, Detections, Observation


@dataclass(frozen=True)
class Measured:
    """``z`` (k, 2) with ``R`` (k, 2, 2) from the robot, and the ``detections`` (k) they are of."""

    z: Array
    R: Array
    detections: Detections


def measure(observation: Observation, params: EkfParameters) -> Measured | None:
    """The measurements by the extractor that ``params`` name; None without data.

    Points are measured as range and bearing, lines as distance and direction.
    """
    extractor = params.ekf.extractor
    if extractor == 'lines':
        return _lines(observation, params)
    detections = observation.detections
    if extractor == 'spikes':
        detections = _spikes(observation, params)
    if detections is None:
        return None
    if params.ekf.landmark_sigma > 0.0:
        cov = detections.cov + params.ekf.landmark_sigma**2 * np.eye(2)
        detections = dataclasses.replace(detections, cov=cov)
    z, R = to_polar(detections.points, detections.cov)
    R[:, 0, 0] += (params.ekf.range_noise * z[:, 0]) ** 2
    return Measured(z, R, detections)


def _spikes(observation: Observation, params: EkfParameters) -> Detections | None:
    """Spikes of the sweep in the base frame at its stamp, each moved back from its beam's time."""
    scan, T_base_laser = observation.scan, observation.T_base_laser
    if scan is None or T_base_laser is None:
        return None
    found = spikes.extract(scan, params.spikes)
    beams = max(len(scan.ranges), 1)
    sweep = np.zeros((1, 3)) if observation.sweep is None else observation.sweep
    share = found.beams / beams if sweep_time(scan) != 0.0 else np.zeros(len(found.beams))
    T = se2.compose(base_at(sweep, share), T_base_laser)
    R = se2.rotation(T[:, 2])
    points = se2.transform(T, found.points[:, None])[:, 0]
    return _anonymous(observation, params, points, R @ found.cov @ R.transpose(0, 2, 1))


def _lines(observation: Observation, params: EkfParameters) -> Measured | None:
    if observation.points is None or observation.origin is None:
        return None
    found = lines.extract(observation.points, observation.origin, params.ransac)
    n = np.stack([np.cos(found.lines[:, 1]), np.sin(found.lines[:, 1])], -1)
    shown = _anonymous(observation, params, found.lines[:, :1] * n, found.cov)
    return Measured(found.lines, found.cov, shown)


def _anonymous(
    observation: Observation, params: EkfParameters, points: Array, cov: Array
) -> Detections:
    """Detections in the base frame, without ids and diameters."""
    k = len(points)
    ids, none = np.full(k, ANONYMOUS, dtype=np.int64), np.full(k, np.nan)
    return Detections(observation.stamp, params.node.base_frame, points, cov, ids, none)
