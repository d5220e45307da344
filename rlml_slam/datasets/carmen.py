# SPDX-License-Identifier: Apache-2.0
"""CARMEN text logs: FLASER, ROBOTLASER1, RAWLASER/RAWLASER1 and ODOM lines of the front laser.

    FLASER n r.. x y theta odom_x odom_y odom_theta ipc_time host logger_time
    RAWLASER1 type start_angle fov step max_range accuracy remission_mode n r.. m i.. ipc_time ..
    ROBOTLASER1 <as RAWLASER1 up to i..> x y theta odom_x odom_y odom_theta tv rv <3> ipc_time ..
    ODOM x y theta tv rv accel ipc_time host logger_time

The stamps are ipc_time, or logger_time where no laser line has the other. (x, y, theta) is the
laser's pose and odom_… the robot's, so the two give the laser's pose on it. Old lines do not say
what angles their beams have: 180 or 181 of them step by 1 degree and 360 or 361 by half a degree
from -90 on, 400 or 401 by a quarter from -50 on (a SICK set to 100 degrees), as CARMEN reads them;
any other number spans 180 degrees.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rlml_slam import se2
from rlml_slam.datasets.text_file import parse_numbers, parse_stamp, read_lines
from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import Array
from rlml_slam.types import Odometry, Scan

LASER_FRAME = 'laser'
MAX_RANGE = 80.0  # [m] a SICK's farthest; its codes for "no return" are above
RANGE_MIN = 0.02  # [m] a SICK reports errors as zero
# beams of a FLASER line, odd: angle of the first one and step [deg]
OLD_ANGLES = {181: (-90.0, 1.0), 361: (-90.0, 0.5), 401: (-50.0, 0.25)}
MAX_BROKEN = 0.01  # more broken lines than this share: it is not a CARMEN log
_OLD = ('FLASER', 'RAWLASER')
_NEW = ('ROBOTLASER1', 'RAWLASER1')


@dataclass
class CarmenLog:
    """What a log holds, in the order of stamps.

    ``T_base_laser`` (3,); ``odometry`` is from ODOM lines, else from the laser lines. ``counts``:
    lines by kind, ``broken``, ``out_of_order`` scans, ``invalid_stamp``; ``first_error`` says
    the first broken line. ``set_back`` [ns] is by how much the scans' clock went back at most.
    """

    odometry: list[Odometry] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)
    T_base_laser: Array = field(default_factory=lambda: np.zeros(3))
    counts: Counter[str] = field(default_factory=Counter)
    first_error: str = ''
    set_back: int = 0


@dataclass(frozen=True)
class _LaserLine:
    scan: Scan
    laser: Array | None  # poses (3,) in the odometry's frame; None where the line has none
    robot: Array | None


class _Reader:
    """Parses line by line; the laser's angles and ranges may be given instead of guessed."""

    def __init__(
        self, max_range: float | None, field_of_view: float | None, by_logger: bool = False
    ) -> None:
        self._given_range = max_range
        self._fov = field_of_view
        self._clock = 2 if by_logger else 0  # word of the stamp, from ipc_time on
        self.params: dict[str, str] = {}

    def max_range(self) -> float:
        """Range [m] from which on a FLASER line's value is "no return"."""
        if self._given_range is not None:
            return self._given_range
        stated = self.number('robot_front_laser_max', 'laser_front_laser_max')
        return MAX_RANGE if stated is None else stated

    def number(self, *names: str) -> float | None:
        """What the first of these PARAM lines states that states a number, None without any."""
        for name in names:
            try:
                return float(self.params[name])
            except (KeyError, ValueError):
                continue
        return None

    def odometry(self, words: Sequence[str]) -> Odometry:
        """ODOM x y theta tv rv accel ipc_time [host logger_time]."""
        if len(words) < 8 + self._clock:
            raise ValueError('the line is cut short')
        return Odometry(parse_stamp(words[7 + self._clock]), _pose(words[1:4]))

    def old_laser(self, words: Sequence[str]) -> _LaserLine:
        """FLASER or RAWLASER."""
        n, at = _count(words, 1), 2
        has_poses = words[0] == 'FLASER'
        if len(words) < at + n + (7 if has_poses else 1) + self._clock:
            raise ValueError(f'the line is too short for {n} beams and a stamp')
        ranges, at = words[at : at + n], at + n
        laser = robot = None
        if has_poses:
            laser, robot, at = _pose(words[at : at + 3]), _pose(words[at + 3 : at + 6]), at + 6
        stamp = words[at + self._clock]
        scan = _scan(stamp, self._angles(n), ranges, (), self.max_range())
        return _LaserLine(scan, laser, robot)

    def new_laser(self, words: Sequence[str]) -> _LaserLine:
        """ROBOTLASER1 or RAWLASER1."""
        if len(words) < 9:
            raise ValueError('the line is cut short')
        start, _, step, stated = parse_numbers(words[2:6])
        n, at = _count(words, 8), 9
        ranges, at = words[at : at + n], at + n
        m, at = _count(words, at), at + 1
        intensities, at = words[at : at + m], at + m
        laser = robot = None
        if words[0] == 'ROBOTLASER1':
            laser, robot = _pose(words[at : at + 3]), _pose(words[at + 3 : at + 6])
            at += 11
        at += self._clock
        if len(words) <= at:
            raise ValueError(f'the line is too short for {n} beams, {m} remissions and a stamp')
        longest = float(stated) if self._given_range is None else self._given_range
        if not (step > 0.0 and longest > 0.0):
            raise ValueError(f'angular resolution {step:g} or maximum range {longest:g} is wrong')
        scan = _scan(
            words[at], (float(start), float(step)), ranges, intensities if m == n else (), longest
        )
        return _LaserLine(scan, laser, robot)

    def _angles(self, n: int) -> tuple[float, float]:
        """Angle [rad] of the first of n beams and the step, of a line that has neither."""
        if self._fov is not None:
            return -0.5 * self._fov, self._fov / max(n - 1, 1)
        start, step = OLD_ANGLES.get(n + 1 - n % 2, (-90.0, 180.0 / max(n - 1, 1)))
        return math.radians(start), math.radians(step)


def _count(words: Sequence[str], at: int) -> int:
    if len(words) <= at or not words[at].isdecimal():
        raise ValueError('the number of beams is missing')
    return int(words[at])


def _pose(words: Sequence[str]) -> Array:
    if len(words) != 3:
        raise ValueError('the line is cut short')
    return parse_numbers(words)


def _scan(
    stamp: str,
    angles: tuple[float, float],
    ranges: Sequence[str],
    intensities: Sequence[str],
    longest: float,
) -> Scan:
    r = np.array(ranges, dtype=np.float32)
    if len(r) == 0:
        raise ValueError('a scan without beams')
    # REP-117: +Inf is "nothing within reach"
    r = np.where(r >= longest, np.float32(np.inf), r)
    return Scan(
        parse_stamp(stamp), LASER_FRAME, angles[0], angles[1], 0.0, RANGE_MIN, longest,
        r, np.array(intensities, dtype=np.float32),
    )  # fmt: skip


def read_carmen(
    path: str | Path,
    max_range: float | None = None,
    field_of_view: float | None = None,
    strict: bool = False,
) -> CarmenLog:
    """Read a log (also .gz, .xz). ``max_range`` [m] and ``field_of_view`` [rad] override it.

    Broken lines are left out and counted. Raises FileFormatError, with file and line, at the
    first one if ``strict``, if more than MAX_BROKEN of the lines are broken, and if there is no
    scan at all, or none with a stamp.
    """
    log = _read(path, _Reader(max_range, field_of_view), strict)
    if not log.scans:
        log = _read(path, _Reader(max_range, field_of_view, by_logger=True), strict)
    if not log.scans:
        raise FileFormatError(f'{path}: no scan in it has a stamp above zero')
    return log


def _read(path: str | Path, reader: _Reader, strict: bool) -> CarmenLog:
    log = CarmenLog()
    laser_lines: list[_LaserLine] = []
    for number, line in read_lines(path):
        words = line.split()
        kind = words[0]
        try:
            if kind == 'PARAM' and len(words) > 2:
                reader.params[words[1]] = words[2]
            elif kind == 'ODOM':
                log.odometry.append(reader.odometry(words))
            elif kind in _OLD:
                laser_lines.append(reader.old_laser(words))
            elif kind in _NEW:
                laser_lines.append(reader.new_laser(words))
            log.counts[kind] += 1
        except ValueError as e:
            error = f'{path}:{number}: broken {kind} line: {e}'
            if strict:
                raise FileFormatError(error) from e
            log.first_error = log.first_error or error
            log.counts['broken'] += 1
    if log.counts['broken'] > max(1, MAX_BROKEN * log.counts.total()):
        raise FileFormatError(f'{log.first_error} ({log.counts["broken"]} broken lines)')
    if not laser_lines:
        raise FileFormatError(f'{path}: no FLASER, ROBOTLASER1 or RAWLASER line in it')
    _finish(log, laser_lines, reader)
    return log


def _finish(log: CarmenLog, lines: list[_LaserLine], reader: _Reader) -> None:
    """Order by stamps, and find the laser's place on the robot."""
    log.scans = [line.scan for line in lines]
    log.T_base_laser = _sensor_pose(lines, reader)
    if not log.odometry:
        log.odometry = [
            Odometry(line.scan.stamp, line.robot) for line in lines if line.robot is not None
        ]
    for items in (log.odometry, log.scans):
        valid = [item for item in items if item.stamp > 0]
        log.counts['invalid_stamp'] += len(items) - len(valid)
        items[:] = valid  # type: ignore[assignment]
    stamps = np.array([s.stamp for s in log.scans], dtype=np.int64)
    log.counts['out_of_order'] = int(np.sum(np.diff(stamps) <= 0))
    log.set_back = int((np.maximum.accumulate(stamps) - stamps).max(initial=0))
    log.scans.sort(key=lambda s: s.stamp)
    log.odometry.sort(key=lambda o: o.stamp)


def _sensor_pose(lines: list[_LaserLine], reader: _Reader) -> Array:
    """T_base_laser (3,): what the log states, else the constant offset between its two poses.

    An offset that changes is that of a log whose poses were corrected: then it says nothing.
    """
    stated = reader.number('robot_frontlaser_offset')
    if stated is not None:
        left = reader.number('robot_frontlaser_side_offset')
        turn = reader.number('robot_frontlaser_angular_offset')
        return np.array([stated, left or 0.0, turn or 0.0])
    pairs = [(line.robot, line.laser) for line in lines if line.robot is not None]
    if not pairs:
        return np.zeros(3)
    robot, laser = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    offsets = se2.between(robot, laser)
    middle = np.median(offsets, axis=0)
    spread = np.abs(se2.between(middle, offsets)).max(axis=0)
    if (spread > 1e-3).any():
        return np.zeros(3)
    # the poses are written with six decimals
    return np.round(middle, 5) + 0.0
