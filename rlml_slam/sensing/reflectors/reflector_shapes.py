# SPDX-License-Identifier: Apache-2.0
"""Flat or round: what the scans of one reflector say of its shape, added up.

The centre of a cylinder is a radius behind what the beams meet, that of a flat reflector is not.
A few beams cannot say which of them it is, and guessing is an error of a radius that is the same
in every scan, so no covariance of a single scan describes it. All scans of one reflector can.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.bright_spots import ODDS, SURE, TILTED

NEAR = 0.2  # [m] between a reflector and where it was seen last
MEMORY = 5_000_000_000  # [ns] for which odometry leaves it there
# scans that share what is open about a shape: some 3 s from a similar view. They are fused as if
# they were independent, so each has the variance of their mean times their number.
SHARED = 30.0
VIEW = 0.1  # [rad] by which a reflector is seen from another side
# round and flat ones, as if seen before: cylinders are more frequent, and a site has one kind
EXPECTED = 1.0, 0.3
DECIDED = 3.0  # log of the odds from which on a reflector counts as one of its shape
SEEN = np.dtype([
    ('point', np.float64, 2),  # [m] in odom
    ('odds', np.float64),  # logarithm, without the tilt in this view
    ('tilts', np.float64, 2),  # sum of TILTED and number of scans of this view
    ('view', np.float64),  # [rad] from the laser
    ('stamp', np.int64),  # [ns]
])  # fmt: skip


class ReflectorShapes:
    """The reflectors that were seen lately, in the frame of odometry.

    ``prior`` is the log of the odds that an unknown one is flat: as the decided ones are.
    """

    def __init__(self) -> None:
        self._seen = np.zeros(0, SEEN)
        self._decided = np.array(EXPECTED)  # round and flat ones so far

    @property
    def prior(self) -> float:
        """Log of the odds that a reflector of which nothing is known is flat."""
        num_round = self._decided[0] + np.sum(_odds(self._seen) < -DECIDED)
        num_flat = self._decided[1] + np.sum(_odds(self._seen) > DECIDED)
        return float(np.log(num_flat / num_round))

    def update(self, stamp: int, points: Array, origin: Array, rows: Array) -> Array:
        """Odds (n,) that reflectors are flat, by this scan and those before.

        ``points`` (n, 2) and the laser at ``origin`` (2,) are in odom, ``rows`` (n, COLUMNS) what
        the scan shows. From one view a tilt is the same in all scans: their mean counts, once.
        """
        self._forget(self._seen['stamp'] < stamp - MEMORY)
        before = nearest_once(points, self._seen['point'])
        now = np.zeros(len(points), SEEN)
        now['view'] = np.inf
        now[before >= 0] = self._seen[before[before >= 0]]
        view = np.arctan2(*(points - origin).T[::-1])
        with np.errstate(invalid='ignore'):
            is_new = ~(np.abs(se2.wrap(view - now['view'])) < VIEW)
        now['odds'] += rows[:, ODDS]
        now['odds'][is_new] += _mean(now['tilts'][is_new])
        now['odds'] = np.clip(now['odds'], -SURE, SURE)
        now['tilts'][is_new] = 0.0
        now['tilts'] += np.stack([rows[:, TILTED], np.ones(len(points))], -1)
        now['view'][is_new] = view[is_new]
        now['point'], now['stamp'] = points, stamp
        hidden = np.setdiff1d(np.arange(len(self._seen)), before)
        self._seen = np.concatenate([self._seen[hidden], now])
        return np.asarray(np.clip(_odds(now), -SURE, SURE) + self.prior)

    def _forget(self, old: NDArray[np.bool_]) -> None:
        """Drop reflectors that are out of view; what they were is what others are likely to be."""
        odds = _odds(self._seen[old])
        self._decided += np.sum(odds < -DECIDED), np.sum(odds > DECIDED)
        self._seen = self._seen[~old]


def _odds(seen: NDArray[np.void]) -> Array:
    """Log of the odds (n,) that reflectors are flat, with the tilt in this view."""
    return np.asarray(seen['odds'] + _mean(seen['tilts']))


def _mean(tilts: Array) -> Array:
    """Mean TILTED (n,) of sums and numbers (n, 2), 0 of none."""
    return np.asarray(tilts[:, 0] / np.maximum(tilts[:, 1], 1.0))


def nearest_once(points: Array, known: Array) -> NDArray[np.int64]:
    """Index (n,) of the known reflector at each point (n, 2), each once; -1 for none."""
    out = np.full(len(points), -1)
    if not len(known):
        return out
    distance = np.linalg.norm(points[:, None] - known, axis=-1)
    for i in np.argsort(distance.min(axis=1)):
        j = int(distance[i].argmin())
        if distance[i, j] < NEAR:
            out[i] = j
            distance[:, j] = np.inf
    return out
