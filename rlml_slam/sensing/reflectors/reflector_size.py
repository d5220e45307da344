# SPDX-License-Identifier: Apache-2.0
"""The size of the reflectors of a site, by how many beams each of them takes in all of its scans.

A centre is a radius behind what beams meet: a size that is off shifts all centres towards the
laser or away from it, the same in every scan, which no covariance of a single scan describes.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.bright_spots import LIT
from rlml_slam.sensing.reflectors.reflector_shapes import MEMORY, VIEW, nearest_once

WIDEST = 0.6  # [m] of a reflector; wider surfaces are walls
WIDTHS = np.geomspace(0.02, WIDEST, 60)  # [m]
RATIO = float(WIDTHS[1] / WIDTHS[0])
DIVERGENCES = np.array([0.001, 0.002, 0.003, 0.005, 0.008, 0.012, 0.016])  # [rad]
STRAY = 0.05  # share of sightings with a lost beam, or a part of the reflector hidden
ODD = 0.25  # share of reflectors of another size, or of none: a flat one looks narrower turned
MOVED = 1.0  # beams by which a reflector has moved when its edges lie elsewhere between beams
ROUNDING = 1e-9  # of a probability
GIVEN = 0.5  # probability that parameters are right, before anything is seen
MOST = 100  # reflectors that are remembered, the newest
# reflectors out of view whose evidence counts: one that is passed again and again is a new one
# each time, and what was taken for reflectors at the start has to fade
LASTING = 30.0


class ReflectorSize:
    """Probability of each width and divergence of the beam (eq. 57), from the spots of scans.

    A cylinder has one width from everywhere; one that has another in each view is odd, and says
    nothing. So each reflector counts once, however many scans show it until it is out of view.
    """

    def __init__(self, size: float, divergence: float) -> None:
        self._given = size, divergence
        self._divergences = np.append(DIVERGENCES, divergence)
        # a cylinder of the given diameter shines over LIT to all of it, to half a step of WIDTHS
        half = math.sqrt(RATIO)
        is_given = (LIT * size / half <= WIDTHS) & (size * half >= WIDTHS)
        is_given[np.argmin(np.abs(WIDTHS - size))] = True  # it may be none of the table's
        self._by_given = GIVEN * is_given / max(is_given.sum(), 1)
        width = self._by_given + (1.0 - GIVEN) / len(WIDTHS)
        angle = np.append(np.full(len(DIVERGENCES), (1.0 - GIVEN) / len(DIVERGENCES)), GIVEN)
        self._given_share = self._by_given / width
        self._prior = np.log(width[:, None] * angle)
        self._total = self._prior  # with the reflectors that are out of view
        self._points, self._stamps = np.zeros((0, 2)), np.zeros(0, np.int64)
        self._beams, self._angles = np.zeros(0), np.zeros(0)
        # log likelihoods (n, widths, divergences): this view, those before, those before if odd
        self._seen = np.zeros((3, 0, *self._total.shape))

    def add(self, stamp: int, points: Array, T_odom_laser: Array, spots: Array) -> None:
        """The reflectors of a scan at ``points`` (n, 2) in the frame of the laser.

        ``spots`` (n, 4): range [m], width [m], spacing of beams [m] and the middle as a beam.
        """
        points, spots = se2.transform(T_odom_laser, points[:MOST]), spots[:MOST]
        before = nearest_once(points, self._points)
        known, was = np.flatnonzero(before >= 0), before[before >= 0]
        angles, beams = np.arctan2(*(points - T_odom_laser[:2]).T[::-1]), spots[:, 3].copy()
        seen = np.zeros((3, len(points), *self._total.shape))
        seen[:, known] = self._seen[:, was]
        is_turned = np.abs(se2.wrap(angles[known] - self._angles[was])) > VIEW
        seen[:, known[is_turned]] = _with_view(seen[:, known[is_turned]])
        angles[known[~is_turned]] = self._angles[was[~is_turned]]
        # beams that lie as they did in the scan before say the same again
        same = ~is_turned & (np.abs(beams[known] - self._beams[was]) <= MOVED)
        beams[known[same]] = self._beams[was[same]]
        counts = np.setdiff1d(np.arange(len(points)), known[same])
        seen[0, counts] += self._likelihood(spots[counts])
        hidden = np.setdiff1d(np.arange(len(self._points)), was)
        kept = hidden[np.argsort(-self._stamps[hidden], kind='stable')][: MOST - len(points)]
        kept = np.sort(kept[self._stamps[kept] >= stamp - MEMORY])
        self._leave(self._seen[:, np.setdiff1d(hidden, kept)])
        self._points = np.concatenate([self._points[kept], points])
        self._stamps = np.concatenate([self._stamps[kept], np.full(len(points), stamp, np.int64)])
        self._beams = np.concatenate([self._beams[kept], beams])
        self._angles = np.concatenate([self._angles[kept], angles])
        self._seen = np.concatenate([self._seen[:, kept], seen], axis=1)

    def _leave(self, seen: Array) -> None:
        """Count reflectors (3, n, widths, divergences) that are out of view."""
        lasting = (1.0 - 1.0 / LASTING) ** seen.shape[1]
        self._total = self._prior + lasting * (self._total - self._prior) + _of_reflectors(seen)

    def _likelihood(self, spots: Array) -> Array:
        """Log of the likelihood (n, widths, divergences) of spots.

        A thing of width W takes k beams that lie s apart with probability 1 - |k - W / s|, here
        blurred by the distance between two widths of the table. No beam, if it is narrower than
        s, is no spot: what is seen has the rest of the probability, W / s.
        """
        r, width, spacing = (spots[:, k, None, None] for k in range(3))
        want = WIDTHS[:, None] + self._divergences * r
        blurred = spacing + (RATIO - 1.0) * WIDTHS[:, None]
        fits = np.maximum(1.0 - np.abs(width - want) / blurred, 0.0) * (spacing / blurred)
        fits /= np.minimum(want / spacing, 1.0)
        return np.log((1.0 - STRAY) * fits + STRAY * np.minimum(spacing / WIDEST, 1.0))

    def estimate(self) -> tuple[float, float, float]:
        """Size [m], divergence [rad] and the sigma of the size [m].

        The given size where it is more probable than all others, the divergence likewise; else
        the mean. What is seen may be LIT to all of a diameter: that is open.
        """
        total = self._total + _of_reflectors(self._seen)
        p = np.exp(total - total.max())
        p /= p.sum()
        width, angle = p.sum(axis=1), p.sum(axis=0)
        size, divergence = self._given
        others = width * (1.0 - self._given_share)
        lit = 0.0
        if others.sum() > 0.5 + ROUNDING:
            size = float(width @ WIDTHS)
            lit = (1.0 - LIT) / math.sqrt(12.0) * size
        if angle[-1] < 0.5 - ROUNDING:
            divergence = float(angle @ self._divergences)
        return size, divergence, math.sqrt(others @ (WIDTHS - size) ** 2 + lit**2)


def _odd(view: Array) -> Array:
    """Log of the likelihood (n, 1, divergences) of views whose width is any."""
    return np.logaddexp.reduce(view, axis=1, keepdims=True) - math.log(len(WIDTHS))


def _with_view(seen: Array) -> Array:
    """What was seen of reflectors (3, n, widths, divergences), at the end of a view."""
    view, before, odd = seen
    return np.stack([np.zeros_like(view), before + view, odd + _odd(view)])


def _of_reflectors(seen: Array) -> Array:
    """Log of the likelihood (widths, divergences) of reflectors, each of them odd or not."""
    _, regular, odd = _with_view(seen)
    out: Array = np.logaddexp(math.log(1.0 - ODD) + regular, math.log(ODD) + odd).sum(axis=0)
    return out
