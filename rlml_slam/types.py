# SPDX-License-Identifier: Apache-2.0
"""Frozen values between modules. SI units, radians; stamps are integer nanoseconds; no ROS."""

from __future__ import annotations

from dataclasses import dataclass, field
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
    """Reflectors seen at one instant; an empty one means "looked and saw none".

    ``points`` (n, 2) [m] and ``cov`` (n, 2, 2) [m^2] in ``frame_id``; ``ids`` (n,) int64,
    ANONYMOUS where the reflector does not tell who it is; ``diameters`` (n,) [m], NaN = unknown.
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
    """Motion ``delta`` (3,) of base and its covariance ``cov`` (3, 3), both in the start frame.

    ``known`` is False where no odometry covered the interval: delta is then an extrapolation and
    cov is wide. Where the turn rate is the IMU's, ``bias_gain`` (3,) is d delta / d bias, delta
    being that of a bias of zero; ``bias`` [rad/s] is what IMU and wheels together say of it, with
    variance ``bias_var``, infinite without an IMU.

    Wheels tell speed and turn but for a scale: the true ones are larger by a share of them, which
    ``delta`` is without. Where the turn is the wheels', ``turn_gain`` (3,) is d delta / d share of
    turn; where it is the IMU's, ``bias`` is that and ``bias_turn`` [rad/s] times that share. The
    share of speed needs no gain: the way (x, y) is its own derivative.
    """

    delta: Array
    cov: Array
    known: bool = True
    bias_gain: Array = field(default_factory=lambda: np.zeros(3))
    bias: float = 0.0
    bias_var: float = np.inf
    turn_gain: Array = field(default_factory=lambda: np.zeros(3))
    bias_turn: float = 0.0


@dataclass(frozen=True)
class Observation:
    """All that was measured at one stamp, in the base frame at that stamp.

    ``motion`` is the odometry/IMU motion since the previous observation. ``points`` (n, 2) are
    the de-skewed end points of the valid beams, ``origin`` (2,) the laser's position; None where
    there was no scan. ``scan`` is the raw sweep. ``odom_pose`` (3,) is the raw odometry at the
    stamp, None without odometry. ``T_base_laser`` (3,) and ``sweep`` (3,), the motion of base
    during the sweep, are those that ``points`` were made with. ``stamp_sigma`` [s] is the error
    of the stamps, where they jitter.
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


class Status(IntEnum):
    """What became of one reflector detection.

    GATED fits no reflector and is too near to one to be another; NEW begins a candidate; GHOST is
    of no reflector of a map that does not change; AMBIGUOUS fits more than one. DOUBTFUL may be a
    known one, but the pose is too uncertain to tell: it is kept apart like a new one, until the
    back end can say which it is.
    """

    USED = 0
    GATED = 1
    NEW = 2
    GHOST = 3
    AMBIGUOUS = 4
    DOUBTFUL = 5


class Level(IntEnum):
    """Health of the estimate; the values are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    DEGRADED = 1
    LOST = 2


@dataclass(frozen=True)
class Health:
    """Level with the reasons that a person can act on."""

    level: Level = Level.OK
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Frame:
    """The front end's answer to one observation.

    ``T_local_base`` (3,) and ``cov_local`` (3, 3) live in the front end's continuous local frame
    (never corrected backwards), ``T_map_base`` and ``cov_map`` in the map frame with the newest
    correction of the back end. Covariances are of (x, y, theta) in the axes of their frame.
    ``landmarks`` (n,) int64: the front end's key of each detection's reflector, -1 where it has
    none; ``statuses`` (n,) of Status. ``scan_used``: the scan fitted and moved the estimate.
    ``doubtful``: what was seen contradicts the map, or nothing has confirmed the start in it yet;
    nothing of it belongs into the map. ``jumped``: the place was found anew, and no motion leads
    to it from the frame before.
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
    doubtful: bool = False
    jumped: bool = False
    chi2: float = 0.0
    iterations: int = 0
    wall_ms: float = 0.0


@dataclass(frozen=True)
class Belief:
    """What the back end believes at its newest keyframe, map frame.

    ``T_map_base`` (3,) and ``points`` (m, 2) with their joint covariance ``cov``
    (3 + 2m, 3 + 2m); ``keys`` (m,) are the front end's, ``aliases`` maps keys of reflectors that
    were merged to the key that goes on, ``gone`` are keys of those that are no longer there.
    """

    T_map_base: Array
    keys: NDArray[np.int64]
    points: Array
    cov: Array
    aliases: dict[int, int]
    gone: tuple[int, ...] = ()


class Verdict(Enum):
    """What a search of the whole map says; NOT_SEARCHED where there is too much to be searched."""

    UNIQUE = 'unique'
    AMBIGUOUS = 'ambiguous'
    IMPOSSIBLE = 'impossible'
    NOT_SEARCHED = 'not searched'


class EdgeKind(Enum):
    """Where a relative-pose edge of the graph comes from."""

    ODOMETRY = 'odometry'
    SCAN = 'scan'
    CLOSURE = 'closure'


@dataclass(frozen=True)
class Reflectors:
    """A map: ``keys`` (n,) int64, ``points`` (n, 2) and ``cov`` (n, 2, 2) in the map frame.

    ``ids`` (n,) are the reflectors' own ids (ANONYMOUS where none), ``sightings`` (n,) how often
    each was seen, ``diameters`` (n,) [m] or NaN.
    """

    keys: NDArray[np.int64]
    points: Array
    cov: Array
    ids: NDArray[np.int64]
    sightings: NDArray[np.int64]
    diameters: Array

    def __len__(self) -> int:
        return len(self.keys)
