# SPDX-License-Identifier: Apache-2.0
"""Cramér-Rao bound of the pose at many places, with one or two reflectors hidden.

The information of a reflector is J^T S^-1 J with the Jacobian of the front end's reflector term
(eq. 1, ``innovations.expected``) at heading zero, and S its noise and the covariance of the map.
Another heading turns the axes of the position and changes no sigma. Information is kept as rows
xx, xy, xt, yy, yt, tt of x, y and heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.params import Reflector
from rlml_slam.planning.driving import predicted, schur
from rlml_slam.se2 import Array
from rlml_slam.sensing.polar import polar_covariance

CHUNK = 4000  # places at a time, for memory
OPEN = 1e-9  # share of the strongest direction's information below which one is open


class Bound(NamedTuple):
    """Sigmas (n,) of position, in its worst direction [m], and heading [rad].

    ``hidden`` (n, 2): of position with the worst one, the worst two reflectors hidden.
    NaN where it was not asked for. ``information`` (n, 6) without any hidden. Infinite where open.
    """

    position: Array
    heading: Array
    hidden: Array
    information: Array


def detection_cov(offsets: Array, p: Reflector) -> Array:
    """Covariances (k, 2, 2) of detections of reflectors at ``offsets`` (k, 2) from the robot."""
    r = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-6)
    return polar_covariance(offsets / r[:, None], p.sigma_range**2, (r * p.sigma_bearing) ** 2)


def reflector_information(offsets: Array, cov: Array, p: Reflector) -> Array:
    """Information (k, 6) of reflectors at ``offsets`` (k, 2) with map covariances (k, 2, 2)."""
    S = detection_cov(offsets, p) + cov
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    a, b, c = S[:, 1, 1] / det, -S[:, 0, 1] / det, S[:, 0, 0] / det
    x, y = offsets.T
    xt, yt = b * x - a * y, c * x - b * y
    return np.stack([a, b, xt, c, yt, yt * x - xt * y], -1)


def sigmas(information: Array) -> tuple[Array, Array]:
    """Position sigma [m] in the worst direction and heading sigma [rad], of rows (..., 6)."""
    xx, xy, xt, yy, yt, tt = np.moveaxis(information, -1, 0)
    with np.errstate(divide='ignore', invalid='ignore'):
        det = xx * yy - xy * xy
        rest = tt - (yy * xt * xt - 2.0 * xy * xt * yt + xx * yt * yt) / det
        heading = np.where((det > 0.0) & (rest > OPEN * tt), rest**-0.5, np.inf)
    return position_sigma(information), heading


def position_sigma(information: Array) -> Array:
    """Sigma [m] in the worst direction, of rows (..., 6)."""
    a, b, c = schur(information)
    weakest = 0.5 * (a + c) - np.sqrt((0.5 * (a - c)) ** 2 + b * b)
    least = OPEN * (information[..., 0] + information[..., 3])
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.where(weakest > least, weakest**-0.5, np.inf)


def bound(
    places: Array, seen: NDArray[np.bool_], reflectors: Array, cov: Array, p: Reflector,
    also: Array | None = None, q: float = math.inf, hide: bool = True,
) -> Bound:  # fmt: skip
    """The bound at places (n, 2) that see (n, m) reflectors (m, 2) with covariances (m, 2, 2).

    ``also`` (n, 6): information from elsewhere, such as the scan. ``q`` [m^2]: while driving, with
    that variance of odometry from scan to scan; infinite for a single scan. ``hide``: also with
    the worst ones hidden, which takes most of the time.
    """
    n = len(places)
    total, hidden = np.zeros((n, 6)), np.zeros((n, 2))
    also = np.zeros((n, 6)) if also is None else also

    def with_all(rows: NDArray[np.int64] | slice, information: Array) -> Array:
        return information + predicted(information, q) + also[rows]

    for first in range(0, n, CHUNK):
        rows, columns = np.nonzero(seen[first : first + CHUNK])
        rows += first
        offsets = reflectors[columns] - places[rows]
        each = reflector_information(offsets, cov[columns], p)
        starts = np.flatnonzero(np.diff(rows, prepend=-1))
        if len(starts):
            total[rows[starts]] = np.add.reduceat(each, starts)
        if hide:
            _hide(total, rows, each, hidden,
                  lambda at, left: position_sigma(with_all(at, left)))  # fmt: skip
    position, heading = sigmas(with_all(slice(None), total))
    few, nothing = seen.sum(axis=1), position_sigma(also)
    for k in range(2):  # with fewer in view, all are hidden
        hidden[:, k] = np.where(few <= k, nothing, hidden[:, k]) if hide else np.nan
    return Bound(position, heading, hidden, total + also)


def _hide(
    total: Array, rows: NDArray[np.int64], each: Array, hidden: Array,
    sigma: Callable[[NDArray[np.int64], Array], Array],
) -> None:  # fmt: skip
    """Write the largest sigma without one, without two of the reflectors of each place."""
    left = total[rows] - each
    np.maximum.at(hidden[:, 0], rows, sigma(rows, left))
    for step in range(1, len(rows)):
        both = np.flatnonzero(rows[step:] == rows[:-step])
        if not len(both):
            break
        np.maximum.at(hidden[:, 1], rows[both], sigma(rows[both], left[both] - each[both + step]))
