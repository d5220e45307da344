# SPDX-License-Identifier: Apache-2.0
"""Keyframes, and the measurements that are collected between two of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.motion import STILL, compose_motion
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Frame, Motion

# [m, m, rad] of the edge over a jump, from before a relocalization to after it: it keeps the graph
# connected, and reflectors and submaps seen at both ends determine the relative pose
JUMP_SIGMA = np.array([0.5, 0.5, 0.2])
SIGHTING_GATE = 9.2  # 99 % of a chi-square with 2 degrees of freedom


@dataclass(eq=False)
class Keyframe:
    """Pose of the graph; ``points`` (n, 2) and ``origin`` (2,) are its scan in base, or None.

    ``index`` changes when keyframes before it are removed, ``number`` does not: both are in order,
    which stamps are not where a clock was set back. ``points`` may be replaced by a later scan of
    the same place; ``scan_stamp`` is that of the scan, and never before that of an earlier one.
    ``detector_ran`` near it, with or without reflectors. ``jumped``: it follows a relocalization,
    and no motion leads to it.
    """

    index: int
    stamp: int
    T_local: Array
    cov_local: Array
    points: NDArray[np.float32] | None
    origin: Array | None
    scan_stamp: int
    detector_ran: bool = False
    jumped: bool = False
    number: int = field(init=False)

    def __post_init__(self) -> None:
        self.number = self.index

    def take_scan(self, other: Keyframe, T: Array) -> None:
        """Replace the scan by that of another keyframe at the relative pose ``T`` (3,)."""
        if other.points is not None and other.origin is not None:
            self.points = se2.transform(T, other.points).astype(np.float32)
            self.origin = se2.transform(T, other.origin[None])[0]
            self.scan_stamp = other.scan_stamp


@dataclass(frozen=True)
class FoundPose:
    """A search of ``area`` [m²] has found that ``T_local`` (3,) is at ``T_map`` (3,)."""

    T_local: Array
    T_map: Array
    area: float


@dataclass
class Sighting:
    """Detections of one reflector near one keyframe, fused in information form."""

    information: Array = field(default_factory=lambda: np.zeros((2, 2)))
    weighted: Array = field(default_factory=lambda: np.zeros(2))
    count: int = 0

    def add(self, z: Array, cov: Array) -> None:
        """Fuse z (2,) with covariance (2, 2), in the keyframe's frame."""
        W = np.linalg.inv(cov)
        self.information = self.information + W
        weighted: Array = self.weighted + W @ z
        self.weighted = weighted
        self.count += 1

    def agrees(self, z: Array, cov: Array) -> bool:
        """Whether a detection z (2,) with cov (2, 2) passes the gate; outliers are not fused."""
        d = z - self.z
        S = cov + np.linalg.inv(self.information)
        return bool(d @ np.linalg.solve(S, d) < SIGHTING_GATE)

    @property
    def z(self) -> Array:
        """The fused position (2,)."""
        return np.asarray(np.linalg.solve(self.information, self.weighted), dtype=np.float64)


class Interval:
    """Motion and reflector detections since the last keyframe, in its frame."""

    def __init__(self, T_local: Array) -> None:
        self._T_local = T_local
        self.motion = STILL
        self.scanned = False
        self.sightings: dict[int, list[Sighting]] = {}
        self.ids: dict[int, int] = {}
        self.diameters: dict[int, float] = {}
        self.detector_ran = False
        self.first_stamp = self.last_stamp = 0  # of detections [ns]
        self.detected: list[tuple[int, Array]] = []  # key or -1, position (2,) of each detection

    def add_motion(self, frame: Frame) -> None:
        """Compose with the odometry of one more frame."""
        self.motion = compose_motion(self.motion, frame.observation.motion)
        self.scanned |= bool(np.isfinite(frame.scan_score))

    def jump(self, frame: Frame) -> None:
        """The frame was relocalized: replace the motion by its pose, with a wide covariance."""
        delta = se2.between(self._T_local, frame.T_local_base)
        self.motion = Motion(delta, np.diag(JUMP_SIGMA**2), known=False)

    def add_detections(self, frame: Frame) -> None:
        """Transform the frame's detections to the keyframe and fuse those of one reflector.

        The relative pose is the front end's; the covariance of the odometry, an upper bound of
        its error, is added to that of the detection.
        """
        d = frame.observation.detections
        if d is None:
            return
        T = se2.between(self._T_local, frame.T_local_base)
        z = se2.transform(T, d.points)
        R = se2.rotation(T[2])
        self.detector_ran, self.last_stamp = True, frame.stamp
        self.first_stamp = self.first_stamp or frame.stamp
        self.detected += zip(frame.landmarks.tolist(), z, strict=True)
        for k in np.flatnonzero(frame.landmarks >= 0):
            self._set_identity(int(frame.landmarks[k]), int(d.ids[k]), float(d.diameters[k]))
            J = np.array([[1.0, 0.0, -(z[k, 1] - T[1])], [0.0, 1.0, z[k, 0] - T[0]]])
            cov = R @ d.cov[k] @ R.T + J @ self.motion.cov @ J.T
            groups = self.sightings.setdefault(int(frame.landmarks[k]), [])
            group = next((g for g in groups if g.agrees(z[k], cov)), None)
            if group is None:
                group = Sighting()
                groups.append(group)
            group.add(z[k], cov)

    def _set_identity(self, key: int, id_: int, diameter: float) -> None:
        """Id and diameter of a reflector, where the detection has them."""
        if id_ != ANONYMOUS:
            self.ids[key] = id_
        if math.isfinite(diameter):
            self.diameters[key] = diameter
