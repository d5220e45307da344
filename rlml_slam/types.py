# SPDX-License-Identifier: Apache-2.0
"""Value types that modules exchange. SI units, radians; stamps are integer nanoseconds; no ROS."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from rlml_slam.se2 import Array

ANONYMOUS = -1


@dataclass(frozen=True)
class Odometry:
    """Wheel odometry: ``pose`` (3,) of base in the odom frame; only its increments are used."""

    stamp: int
    pose: Array


@dataclass(frozen=True)
class Imu:
    """Yaw rate [rad/s] about the base z axis (counter-clockwise positive)."""

    stamp: int
    yaw_rate: float


@dataclass(frozen=True)
class Scan:
    """One sweep of a 2D laser; the stamp is that of the first ray (REP-117 values are legal).

    ``ranges`` (n,) [m], NaN/Inf/out of [range_min, range_max] where there is no return;
    ``intensities`` (n,) or (0,). Ray k was measured at stamp + k * time_increment [s] at
    angle_min + k * angle_increment [rad] in the frame ``frame_id``.
    """

    stamp: int
    frame_id: str
    angle_min: float
    angle_increment: float
    time_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32]


@dataclass(frozen=True)
class Detections:
    """Reflector detections of one instant; n = 0 means that there was no reflector in view.

    ``points`` (n, 2) [m] and ``cov`` (n, 2, 2) [m^2] in ``frame_id``; ``ids`` (n,) int64,
    ANONYMOUS for a reflector without an id; ``diameters`` (n,) [m], NaN if unknown.
    """

    stamp: int
    frame_id: str
    points: Array
    cov: Array
    ids: NDArray[np.int64]
    diameters: Array

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Motion:
    """Relative motion ``delta`` (3,) of base with covariance ``cov`` (3, 3), in the start frame.

    ``known``: odometry covered the whole interval; else ``delta`` is extrapolated and ``cov``
    wide. If the turn rate is that of the IMU, ``bias_gain`` (3,) is d delta / d bias, and
    ``delta`` that of a bias of zero; ``bias`` [rad/s] is the bias measured by comparing IMU and
    wheels, with variance ``bias_var``, infinite without an IMU.

    Wheel odometry has slowly varying scale errors of speed and turn, and a turn per distance
    that it does not measure (of unequal wheels, or of a steering that is off its zero). ``delta``
    does not include them. If the turn is that of the wheels, ``turn_gain`` (3,) and ``drift_gain``
    (3,) are d delta / d (scale error of turn, turn per distance). If it is that of the IMU, the
    bias is ``bias`` plus ``bias_turn`` [rad/s] and ``bias_way`` [m/s] times these errors. The
    scale error of speed needs no gain: its derivative is (x, y) of ``delta``.
    """

    delta: Array
    cov: Array
    known: bool = True
    bias_gain: Array = field(default_factory=lambda: np.zeros(3))
    bias: float = 0.0
    bias_var: float = np.inf
    turn_gain: Array = field(default_factory=lambda: np.zeros(3))
    bias_turn: float = 0.0
    drift_gain: Array = field(default_factory=lambda: np.zeros(3))
    bias_way: float = 0.0


@dataclass(frozen=True)
class Observation:
    """All measurements of one stamp, in the base frame at that stamp.

    ``motion`` is the odometry/IMU motion since the previous observation. ``points`` (n, 2) are
    the deskewed end points of the valid beams, ``origin`` (2,) the position of the laser; both
    None without a scan. ``scan`` is the sweep, NaN where a beam sees the robot. ``odom_pose`` (3,)
    is the raw odometry at the stamp, None without odometry. ``points`` were computed with
    ``T_base_laser`` (3,) and ``sweep`` (a, 3), the motions of base from its first ray to the end
    of each arc, all of equal time; ``sweep_cov`` (3, 3) is the covariance of the last, None where
    odometry does not cover it. The estimate of a pose corrects ``points`` as well.
    ``stamp_sigma`` [s] is the error of the stamp, if the stamps have jitter.
    """

    stamp: int
    motion: Motion
    points: Array | None = None
    origin: Array | None = None
    detections: Detections | None = None
    scan: Scan | None = None
    odom_pose: Array | None = None
    T_base_laser: Array | None = None
    sweep: Array | None = None
    stamp_sigma: float = 0.0
    sweep_cov: Array | None = None

    def with_noise(self, cov: Array) -> Observation:
        """The same after a motion whose covariance is larger by ``cov`` (3, 3)."""
        return replace(self, motion=replace(self.motion, cov=self.motion.cov + cov))


class Status(IntEnum):
    """Result of the association of one detection.

    USED: matched, and updated the estimate. GATED: outside the gate of all reflectors, but too
    close to one to be another. NEW: starts a candidate. GHOST: no reflector of a fixed map.
    AMBIGUOUS: inside the gate of several. DEFERRED: matches, but the pose is too uncertain to
    use it; it starts a candidate, which the back end merges later (delayed association).
    """

    USED = 0
    GATED = 1
    NEW = 2
    GHOST = 3
    AMBIGUOUS = 4
    DEFERRED = 5


class Level(IntEnum):
    """Level of health; values as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    DEGRADED = 1
    LOST = 2


@dataclass(frozen=True)
class Health:
    """Health of the estimate: its level, and the reasons in words."""

    level: Level = Level.OK
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Frame:
    """Estimate of the front end for one observation.

    ``T_local_base`` (3,) and ``cov_local`` (3, 3) are in the continuous local frame of the front
    end, ``T_map_base`` and ``cov_map`` in the map frame with the newest correction of the back
    end. Covariances are of (x, y, theta) in the axes of their frame. ``landmarks`` (n,) int64 are
    the keys of the reflectors of the detections, -1 if none; ``statuses`` (n,) of Status.
    ``scan_used``: the scan was matched and updated the estimate.
    ``unconfirmed``: scan or reflectors contradict the map, or the start pose in a saved map has
    not been confirmed yet; such a frame is not mapped. ``jumped``: the robot was relocalized, and
    no motion connects the frame with the one before.
    """

    stamp: int
    observation: Observation
    T_local_base: Array
    cov_local: Array
    T_map_base: Array
    cov_map: Array
    landmarks: NDArray[np.int64]
    statuses: NDArray[np.int64]
    health: Health = field(default_factory=Health)
    scan_score: float = float('nan')
    scan_used: bool = False
    unconfirmed: bool = False
    jumped: bool = False
    chi2: float = 0.0
    iterations: int = 0
    wall_ms: float = 0.0


@dataclass(frozen=True)
class Belief:
    """Estimate of the back end at its newest keyframe, in the map frame.

    ``T_map_base`` (3,) and ``points`` (m, 2) with their joint covariance ``cov``
    (3 + 2m, 3 + 2m). ``keys`` (m,) are those of the front end, ``aliases`` maps the key of a
    merged reflector to the key that it has now, ``removed`` are keys of reflectors that no longer
    exist.
    """

    T_map_base: Array
    keys: NDArray[np.int64]
    points: Array
    cov: Array
    aliases: dict[int, int]
    removed: tuple[int, ...] = ()


class Verdict(Enum):
    """Result of a global search; NOT_SEARCHED if the search would take too long."""

    UNIQUE = 'unique'
    AMBIGUOUS = 'ambiguous'
    IMPOSSIBLE = 'impossible'
    NOT_SEARCHED = 'not searched'


class EdgeKind(Enum):
    """Source of a relative-pose edge of the graph."""

    ODOMETRY = 'odometry'
    SCAN = 'scan'
    CLOSURE = 'closure'


@dataclass(frozen=True)
class Reflectors:
    """Reflector map: ``keys`` (n,) int64, ``points`` (n, 2), ``cov`` (n, 2, 2) in the map frame.

    ``ids`` (n,) are the ids of the reflectors (ANONYMOUS without one), ``sightings`` (n,) their
    numbers of detections, ``diameters`` (n,) [m], NaN if unknown.
    """

    keys: NDArray[np.int64]
    points: Array
    cov: Array
    ids: NDArray[np.int64]
    sightings: NDArray[np.int64]
    diameters: Array

    def __len__(self) -> int:
        return len(self.keys)
