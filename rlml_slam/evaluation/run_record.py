# SPDX-License-Identifier: Apache-2.0
"""The record of one run of the system: of a replay, a study or a live drive.

Everything that is written and drawn is made from a Run.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.ate import interpolate
from rlml_slam.evaluation.scan_log import ScanLog
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.planning.audit.sightings import SightingLog
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.reflector_states import ReflectorState
from rlml_slam.types import Frame, Health, Level, Reflectors, Status
from rlml_slam.version import __version__

MIN_MOTION = 1e-6  # [m], [rad] below which the robot has not moved since the truth began


@dataclass(frozen=True)
class Truth:
    """Ground truth. ``is_map``: it is in the run's own map frame, else it has to be aligned.

    ``reflector_ids`` (m,) and ``reflectors`` (m, 2) [m] are in the same frame.
    """

    trajectory: Trajectory
    is_map: bool
    reflector_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    reflectors: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def in_map_of(self, log: FrameLog) -> Truth:
        """The truth in the map of a run, which may begin later than the truth.

        A map has its origin at the first pose. Where the scans before it were lost, the robot has
        moved since the recording began. Aligned where nobody knows how far.
        """
        if not self.is_map or not log.poses or np.any(log.poses[0]) or np.any(log.covs[0]):
            return self  # of a map that was there before
        if log.stamps[0] <= self.trajectory.stamps[0]:
            return self
        at, known = interpolate(self.trajectory, np.array(log.stamps[:1]))
        if np.nanmax(np.abs(at)) < MIN_MOTION:
            return self
        if not known[0] or not np.isfinite(at).all():
            return replace(self, is_map=False)
        T = se2.inverse(at[0])
        path = Trajectory(self.trajectory.stamps, se2.compose(T, self.trajectory.poses))
        return replace(self, trajectory=path, reflectors=se2.transform(T, self.reflectors))


@dataclass
class FrameLog:
    """The frames of the front end, one entry each; of the scans, a thinned selection."""

    stamps: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covs: list[Array] = field(default_factory=list)
    levels: list[int] = field(default_factory=list)
    reasons: list[tuple[str, ...]] = field(default_factory=list)
    wall_ms: list[float] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    used: list[int] = field(default_factory=list)
    sightings: SightingLog = field(default_factory=SightingLog)
    scans: ScanLog = field(default_factory=ScanLog)

    def add(self, frames: Iterable[Frame]) -> None:
        """Note the poses as published live, their health and their cost."""
        for f in frames:
            self.add_pose(f.stamp, f.T_map_base, f.cov_map, f.health)
            self.wall_ms.append(f.wall_ms)
            self.sightings.add(f)
            if f.observation.points is not None:
                self.scans.add(f.stamp, f.observation.points)
            self.seen.append(len(f.statuses))
            used = f.statuses == Status.USED
            self.used.append(int(used.sum()) if len(used) else 0)

    def add_pose(self, stamp: int, pose: Array, cov: Array, health: Health | None = None) -> None:
        """Note one published pose (3,) with covariance (3, 3)."""
        self.stamps.append(stamp)
        self.poses.append(pose)
        self.covs.append(cov)
        health = health or Health()
        self.levels.append(int(health.level))
        self.reasons.append(health.reasons)

    def trajectory(self) -> Trajectory:
        """The poses as published live."""
        return Trajectory(
            np.array(self.stamps, dtype=np.int64), np.array(self.poses).reshape(-1, 3)
        )


@dataclass(frozen=True)
class Origin:
    """What a run was made by: the command line, and by name the parameters that it changed.

    ``source`` says what it was made from, such as the SHA-256 of a bag. Each is empty, or None, if
    unknown. ``system`` estimated it.
    """

    command: str = ''
    parameters: Mapping[str, Any] | None = None
    source: str = ''
    system: str = 'rlml'

    def figures(self) -> dict[str, Any]:
        """What can be compared with another run."""
        out: dict[str, Any] = {'version': __version__, 'system': self.system}
        return out if self.parameters is None else {**out, 'parameters': dict(self.parameters)}


@dataclass
class Run:
    """Inputs, estimates, products and cost of one run.

    ``trajectory`` is the optimised one; ``keyframes`` (k, 3) are poses in the map and
    ``closures`` (c, 2, 2) the ends of the accepted loop closures there, and
    ``closure_table`` has a row for each candidate, empty where there was none. ``back_end_ms``
    (k,) has the cost per keyframe, ``reflector_states`` the state of each reflector. ``inputs``
    counts used, late and invalid messages by stream, ``topics`` has the topic of each.
    ``problem`` says in one line what ended the run early or what of it is missing, empty without
    either. ``stored`` is the whole map. ``extra`` is added to metrics.json.
    """

    name: str
    frames: FrameLog
    trajectory: Trajectory
    reflectors: Reflectors
    grid: OccupancyGrid | None = None
    keyframes: Array = field(default_factory=lambda: np.zeros((0, 3)))
    closures: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    rejected: int = 0
    back_end_ms: Array = field(default_factory=lambda: np.zeros(0))
    inputs: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    truth: Truth | None = None
    wall_s: float = 0.0
    problem: str = ''
    stored: Content | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    closure_table: str = ''
    reflector_states: tuple[ReflectorState, ...] = ()
    topics: dict[str, str] = field(default_factory=dict)
    origin: Origin = field(default_factory=Origin)

    @property
    def duration_s(self) -> float:
        """Time between the first and the last frame."""
        stamps = self.frames.stamps
        return (stamps[-1] - stamps[0]) * 1e-9 if stamps else 0.0

    def health_share(self) -> dict[str, float]:
        """Share of the frames at each level."""
        levels = np.array(self.frames.levels)
        return {
            level.name: float(np.mean(levels == level)) if len(levels) else 0.0 for level in Level
        }

    def health_reasons(self, most: int = 3) -> list[tuple[str, float]]:
        """The reasons that most frames have, each with their share.

        Those that differ in numbers alone are one, in the words of the last of them.
        """
        counts, words = Counter[str](), dict[str, str]()
        for reasons in self.frames.reasons:
            for reason in reasons:
                kind = re.sub(r'\d+(\.\d+)?', '#', reason)
                counts[kind] += 1
                words[kind] = reason
        return [(words[k], n / len(self.frames.reasons)) for k, n in counts.most_common(most)]
