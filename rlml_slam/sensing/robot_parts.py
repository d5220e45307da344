# SPDX-License-Identifier: Apache-2.0
"""Beams that see the robot itself: its frame, a mast, a cart that it tows.

They have the same range wherever the robot goes, and so hold it where it is. A thing that stays
where it is comes nearer or moves away: a wall to three times its distance while the robot turns by
TURN; and while it drives straight on, whatever is no surface along its way. Beams whose range has
not changed meanwhile are left out, until they see something else. A pillar that a robot goes round
looks the same, so nothing is left out that is farther away than FARTHEST.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.types import Scan

SAME = 0.05  # [m] from the first of these ranges: noise of a laser at short range
TURN = 2.5  # [rad] between the two ends of the headings at which a range was the same
MOVED, STRAIGHT = 0.25, 0.05  # [m], [rad] straight on, with the same range
TURNED = 0.3  # [rad] or MOVED: a step, after which the scan must have changed
# share of the returns that have changed after a step, by [m] and by [m] per range: odometry alone
# may drift or spin
CHANGED, FAR, FARTHER = 0.1, 0.125, 0.01
# [m] width across the way of what neighbours see, and of that per metre along it: a robot comes
# nearer by more than 2 SAME to any surface that is as wide
ACROSS, SLANT = 0.1, 0.5
NEIGHBOURS = 6  # beams at least on it, their ranges less than ACROSS apart
FARTHEST = 1.5  # [m] a thing that moves with the robot is near it
FEWEST = 4  # scans in which the range was the same
GONE = 10  # scans in a row in which a beam sees something else, until it is used again
MOST = 0.5  # share of the returns: if more do not change, it is the odometry that is wrong


@dataclass
class _Beams:
    """Of each beam of a lidar (n,): its range, number of scans, and headings with that range.

    ``is_doubtful``: odometry may be wrong instead. ``away`` is the number of scans in a row with
    another range. The last step began ``scans`` ago at ``pose`` (3,) with ranges ``then`` (n,).
    """

    range: Array
    count: NDArray[np.int64]
    least: Array
    most: Array
    is_part: NDArray[np.bool_]
    is_doubtful: NDArray[np.bool_]
    away: NDArray[np.int64]
    pose: Array
    last: Array
    then: Array
    scans: int = -1
    heading: float = 0.0  # sum of the turns of all steps after which the scan had changed

    @classmethod
    def of(cls, ranges: Array, pose: Array) -> _Beams:
        """Nothing is known of these ranges (n,), NaN where there is no return."""
        n = len(ranges)
        return cls(
            ranges.copy(), np.zeros(n, np.int64), np.zeros(n), np.zeros(n), np.zeros(n, np.bool_),
            np.zeros(n, np.bool_), np.zeros(n, np.int64), pose, pose, ranges,
        )  # fmt: skip

    def begin(self, which: NDArray[np.bool_], ranges: Array) -> None:
        """These beams have other ranges from now on."""
        self.is_part[which] = self.is_doubtful[which] = False
        self.count[which] = self.away[which] = 0
        self.least[which] = self.most[which] = self.heading
        self.range[which] = ranges[which]


class RobotParts:
    """What each lidar sees of its robot, by its frame, from how ranges change with odometry."""

    def __init__(self) -> None:
        self._beams: dict[str, _Beams] = {}

    def left_out(self, scan: Scan, odometry: Array | None, mounted: float) -> Scan:
        """The scan with NaN where a beam sees the robot; itself if none does.

        ``odometry`` (3,) is the pose at the stamp of the scan; without it, nothing is learned.
        ``mounted`` [rad] is the heading of the lidar on the robot.
        """
        returns = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
        ranges = np.where(returns, scan.ranges, np.nan)
        b = self._beams.get(scan.frame_id)
        if odometry is not None:
            if b is None or len(b.range) != len(ranges):
                b = self._beams[scan.frame_id] = _Beams.of(ranges, odometry)
            elif _jumps(b.last, odometry):
                b.begin(~b.is_part, ranges)
                b.pose, b.then, b.scans = odometry, ranges, -1
            b.last = odometry
            _learn(b, ranges)
            _find(b, scan, ranges, mounted)
        if b is None or len(b.range) != len(ranges):
            return scan
        out = b.is_part | b.is_doubtful
        ranges = np.where(out, np.float32(np.nan), scan.ranges)
        return replace(scan, ranges=ranges) if (out & returns).any() else scan


def _jumps(last: Array, pose: Array) -> bool:
    """Whether odometry was set to another pose, or drove too far between two scans."""
    x, y, turn = se2.between(last, pose)
    return math.hypot(x, y) > 2.0 * MOVED or abs(turn) > 1.0


def _learn(b: _Beams, ranges: Array) -> None:
    """Take the ranges (n,), NaN where there is no return."""
    known = np.isfinite(ranges)
    same = np.abs(ranges - b.range) < SAME
    b.away = np.where(same, 0, b.away + known)
    b.begin(~same & (~b.is_part | (b.away >= GONE)), ranges)
    b.count += known


def _find(b: _Beams, scan: Scan, ranges: Array, mounted: float) -> None:
    """After a step, find the beams that no thing which stays where it is can explain."""
    b.scans += 1
    x, y, turn = se2.between(b.pose, b.last)
    way = math.hypot(x, y)
    if way < MOVED and abs(turn) < TURNED:
        return
    returns = np.isfinite(ranges).sum()
    changed = np.abs(ranges - b.then) > FAR + FARTHER * ranges
    is_straight = way >= MOVED and abs(turn) < STRAIGHT
    found = _in_the_way(b, scan, math.atan2(y, x) - mounted) & is_straight
    is_sure = changed.sum() >= CHANGED * returns
    if is_sure:
        b.heading += float(turn)
        b.least, b.most = np.minimum(b.least, b.heading), np.maximum(b.most, b.heading)
        found |= _without_single(b.most - b.least > TURN)
    found &= ~b.is_part & (b.count >= FEWEST) & np.isfinite(ranges)
    near = found & (b.range < FARTHEST)
    b.is_doubtful[:] = False
    if (found | b.is_part).sum() > MOST * returns:
        b.begin(found, ranges)
    elif is_sure:
        b.is_part |= near
    elif near.sum() == found.sum():  # else what is far came no nearer either: it did not move
        b.is_doubtful = near
    b.pose, b.then, b.scans = b.last, ranges, 0


def _without_single(found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The beams (n,) of three neighbours or more: noise may hold one at its range."""
    middle = found & np.roll(found, 1) & np.roll(found, -1)
    return middle | np.roll(middle, 1) | np.roll(middle, -1)


def _in_the_way(b: _Beams, scan: Scan, heading: float) -> NDArray[np.bool_]:
    """Other beams (n,) with the same range during a step, on what is no surface along it."""
    same = (b.count > b.scans) & ~b.is_part
    angles = scan.angle_min + scan.angle_increment * np.arange(len(same)) - heading
    along, across = b.range * np.cos(angles), b.range * np.sin(angles)
    joined = same[1:] & same[:-1] & (np.abs(np.diff(b.range)) < ACROSS)
    ends = np.concatenate(([-1], np.flatnonzero(~joined), [len(same) - 1]))
    found = np.zeros(len(same), np.bool_)
    for k in np.flatnonzero(np.diff(ends) >= NEIGHBOURS).tolist():
        one = slice(ends[k] + 1, ends[k + 1] + 1)
        wide = np.ptp(across[one])
        found[one] = wide > max(ACROSS, SLANT * np.ptp(along[one]))
    return found
