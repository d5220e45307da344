# SPDX-License-Identifier: Apache-2.0
"""Beams that see the robot itself: its frame, a mast, a cart that it tows.

They have the same range wherever the robot goes, and so hold it where it is. A thing that stays
where it is comes nearer or moves away: a wall by three times its distance while the robot turns by
TURN; and while it drives straight on, whatever is no surface along its way. Beams whose range has
not changed meanwhile are left out, until they see something else.
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

    ``since`` (n, 2) is the position by odometry at the first of these scans, ``away`` the number
    of scans in a row with another range.
    """

    range: Array
    count: NDArray[np.int64]
    least: Array
    most: Array
    since: Array
    is_part: NDArray[np.bool_]
    away: NDArray[np.int64]

    def begin(self, which: NDArray[np.bool_], ranges: Array, place: Array) -> None:
        """These beams have other ranges from now on."""
        self.is_part[which], self.count[which], self.away[which] = False, 0, 0
        self.least[which], self.most[which] = math.inf, -math.inf
        self.range[which], self.since[which] = ranges[which], place


class RobotParts:
    """What each lidar sees of its robot, by its frame; odometry tells how that moved."""

    def __init__(self) -> None:
        self._beams: dict[str, _Beams] = {}
        self._heading: float | None = None  # of the odometry, without jumps by a full turn

    def left_out(self, scan: Scan, odometry: Array | None, mounted: float) -> Scan:
        """The scan with NaN where a beam sees the robot; itself if none does.

        ``odometry`` (3,) is the pose at the stamp of the scan; without it, nothing is learned.
        ``mounted`` [rad] is the heading of the lidar on the robot.
        """
        n = len(scan.ranges)
        beams = self._beams.get(scan.frame_id)
        if beams is None or len(beams.range) != n:
            none, never = np.zeros(n, np.int64), np.full(n, math.inf)
            beams = _Beams(
                np.zeros(n), none, never, -never, np.zeros((n, 2)), none > 0, none.copy()
            )
            self._beams[scan.frame_id] = beams
        returns = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
        if odometry is not None:
            last = float(odometry[2]) if self._heading is None else self._heading
            self._heading = last + float(se2.wrap(odometry[2] - last))
            pose = np.array([odometry[0], odometry[1], self._heading])
            _learn(beams, np.where(returns, scan.ranges, np.nan), pose)
            _find(beams, scan, pose, mounted, int(returns.sum()))
        parts = beams.is_part & returns
        if not parts.any():
            return scan
        return replace(scan, ranges=np.where(parts, np.float32(np.nan), scan.ranges))


def _learn(b: _Beams, ranges: Array, pose: Array) -> None:
    """Take the ranges (n,) at a pose (3,), NaN where there is no return."""
    same = (np.abs(ranges - b.range) < SAME) & (b.count > 0)
    other = ~same & np.isfinite(ranges)
    b.away = np.where(other, b.away + 1, np.where(same, 0, b.away))
    begins = other & (~b.is_part | (b.away >= GONE))
    b.begin(begins, ranges, pose[:2])
    seen = same | begins
    b.count[seen] += 1
    b.least[seen] = np.minimum(b.least[seen], pose[2])
    b.most[seen] = np.maximum(b.most[seen], pose[2])


def _find(b: _Beams, scan: Scan, pose: Array, mounted: float, returns: int) -> None:
    """Find the beams that no thing which stays where it is can explain."""
    often = (b.count >= FEWEST) & ~b.is_part
    found = often & (b.most - b.least > TURN)
    way = pose[:2] - b.since
    moved = often & (b.most - b.least < STRAIGHT) & (np.hypot(way[:, 0], way[:, 1]) > MOVED)
    if moved.any():
        angles = scan.angle_min + scan.angle_increment * np.arange(len(b.range))
        # end points along and across the way of each
        turned = angles + mounted + pose[2] - np.arctan2(way[:, 1], way[:, 0])
        along, across = b.range * np.cos(turned), b.range * np.sin(turned)
        joined = moved[1:] & moved[:-1] & (np.abs(np.diff(b.range)) < ACROSS)
        ends = np.concatenate(([-1], np.flatnonzero(~joined), [len(moved) - 1]))
        for k in np.flatnonzero(np.diff(ends) >= NEIGHBOURS).tolist():
            one = slice(ends[k] + 1, ends[k + 1] + 1)
            wide = np.ptp(across[one])
            found[one] |= bool(wide > max(ACROSS, SLANT * np.ptp(along[one])))
    if not found.any():
        return
    if found.sum() > MOST * returns:
        b.begin(found, b.range, pose[:2])
    else:
        b.is_part |= found & (b.range < FARTHEST)
