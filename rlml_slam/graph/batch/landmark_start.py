# SPDX-License-Identifier: Apache-2.0
"""Start of landmarks from the poses that measured them: means of sightings, trilateration.

A beacon that is only heard at ranges r_k from poses p_k has, with q_k = p_k - mean(p) and
f_k = |q_k|^2 - r_k^2, the position mean(p) + m of

    |m|^2 - 2 q_k . m + f_k = 0,     so     2 (sum w q q^T) m = sum w q (f - mean(f)),

linear where the poses are not in a line. In a line, that leaves m along the line alone, and
|m|^2 = -mean(f) two mirror images beside it. All three are refined by Gauss-Newton on the ranges;
the one of least cost is the start, the next one the other hypothesis. (Caffery, "A new approach to
the geometry of TOA location", VTC 2000, has the linear equations.)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rlml_slam.compiled import brief, part
from rlml_slam.graph.model.factors import RANGE, FactorKind, direction, residual
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.packed_system import Flags, System
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array, transform

STEPS = 20  # of Gauss-Newton from one hypothesis; it converges in some five where it does
# Two hypotheses nearer to one another than this share of the mean range are one.
SAME = 0.02
# Damping as a share of the mean curvature: ranges from nearly one direction leave the position
# across it undetermined, and an undamped step would leave the region of the ranges.
DAMPING = 1e-3


class Trilateration(NamedTuple):
    """Position (2,) of a beacon with its cost, and the next best hypothesis, of cost inf if none.

    The costs are sums of squared residuals over sigma^2. Where the second one is not larger by
    some ten, the ranges do not decide between the two.
    """

    position: Array
    cost: float
    other: Array
    other_cost: float


@brief
def trilaterate(points: Array, ranges: Array, weights: Array) -> Trilateration:
    """Position of what is at ``ranges`` (k,) from ``points`` (k, 2), weights 1 / sigma^2 (k,)."""
    candidates = _candidates(points, ranges, weights)
    costs, mean = np.empty(3), 0.0
    for h in range(3):
        costs[h] = _refine(points, ranges, weights, candidates[h])
    for k in range(len(ranges)):
        mean += ranges[k] / len(ranges)
    best = 0
    for h in range(1, 3):
        if costs[h] < costs[best]:
            best = h
    other = -1
    for h in range(3):
        dx, dy = candidates[h] - candidates[best]
        if math.hypot(dx, dy) > SAME * mean and (other < 0 or costs[h] < costs[other]):
            other = h
    if other < 0:
        return Trilateration(candidates[best], costs[best], candidates[best], math.inf)
    return Trilateration(candidates[best], costs[best], candidates[other], costs[other])


@part
def _candidates(points: Array, ranges: Array, weights: Array) -> Array:
    """The linear solution and the two mirror images (3, 2)."""
    total = cx = cy = 0.0
    for k in range(len(points)):
        total += weights[k]
        cx += weights[k] * points[k, 0]
        cy += weights[k] * points[k, 1]
    cx, cy = cx / total, cy / total
    a = b = c = gx = gy = mean = 0.0
    for k in range(len(points)):
        x, y = points[k, 0] - cx, points[k, 1] - cy
        f = x * x + y * y - ranges[k] * ranges[k]
        a += weights[k] * x * x
        b += weights[k] * x * y
        c += weights[k] * y * y
        gx += 0.5 * weights[k] * x * f
        gy += 0.5 * weights[k] * y * f
        mean += weights[k] * f / total
    # the line of the poses, the eigenvector of the larger eigenvalue
    angle = 0.5 * math.atan2(2.0 * b, a - c)
    ux, uy = math.cos(angle), math.sin(angle)
    spread = a * ux * ux + 2.0 * b * ux * uy + c * uy * uy
    along = (gx * ux + gy * uy) / spread if spread > 0.0 else 0.0
    beside = math.sqrt(max(0.0, -mean - along * along))
    det = a * c - b * b
    out = np.empty((3, 2))
    for h in range(2):
        side = beside if h == 0 else -beside
        out[h, 0], out[h, 1] = cx + along * ux - side * uy, cy + along * uy + side * ux
    out[2] = out[0]
    if det > 0.0:
        out[2, 0], out[2, 1] = cx + (c * gx - b * gy) / det, cy + (a * gy - b * gx) / det
    return out


@part
def _refine(points: Array, ranges: Array, weights: Array, m: Array) -> float:
    """Damped Gauss-Newton on one position, in place; its cost."""
    cost = _cost(points, ranges, weights, m)
    damping = DAMPING
    for _ in range(STEPS):
        a = b = c = gx = gy = 0.0
        for k in range(len(points)):
            dx, dy = m[0] - points[k, 0], m[1] - points[k, 1]
            ux, uy = direction(dx, dy)
            e = residual(ux, uy, dx, dy, ranges[k], 0.0)[0]
            a += weights[k] * ux * ux
            b += weights[k] * ux * uy
            c += weights[k] * uy * uy
            gx += weights[k] * ux * e
            gy += weights[k] * uy * e
        extra = damping * 0.5 * (a + c)
        a, c = a + extra, c + extra
        det = a * c - b * b
        if not det > 0.0:
            break
        x, y = m[0], m[1]
        m[0], m[1] = x - (c * gx - b * gy) / det, y - (a * gy - b * gx) / det
        new = _cost(points, ranges, weights, m)
        if new > cost:
            m[0], m[1] = x, y
            damping *= 10.0
        else:
            damping *= 0.1
            cost = new
    return cost


@part
def _cost(points: Array, ranges: Array, weights: Array, m: Array) -> float:
    cost = 0.0
    for k in range(len(points)):
        dx, dy = m[0] - points[k, 0], m[1] - points[k, 1]
        ux, uy = direction(dx, dy)
        e = residual(ux, uy, dx, dy, ranges[k], 0.0)[0]
        cost += weights[k] * e * e
    return cost


@part
def place_by_ranges(system: System, poses: Array, landmarks: Array) -> None:
    """Put the free landmarks that have ranges and no sightings where these say."""
    sightings = system.sightings
    num = 0
    for f in range(len(sightings)):
        num += sightings[f]['kind'] == RANGE
    if num == 0:
        return
    nodes, ranges, weights = np.empty((num, 2), np.int64), np.empty(num), np.empty(num)
    free = np.zeros(len(landmarks), np.bool_)
    w = 0
    for f in range(len(sightings)):
        z = sightings[f]
        if z['kind'] == RANGE:
            nodes[w, 0], nodes[w, 1], ranges[w], weights[w] = z['i'], z['j'], z['x'], z['I00']
            free[z['j']] = z['b'] >= 0
            w += 1
    for f in range(len(sightings)):
        if sightings[f]['kind'] != RANGE:
            free[sightings[f]['j']] = False
    _place_all(nodes, ranges, weights, free, poses, landmarks)


@brief
def _place_all(
    nodes: Ints, ranges: Array, weights: Array, free: Flags, poses: Array, landmarks: Array
) -> None:
    """Trilaterate the landmarks that are ``free`` (m,) from ranges (k,) of (pose, landmark)."""
    order = np.argsort(nodes[:, 1])
    start = 0
    while start < len(order):
        k = nodes[order[start], 1]
        end = start
        while end < len(order) and nodes[order[end], 1] == k:
            end += 1
        if free[k]:
            points, r, w = np.empty((end - start, 2)), np.empty(end - start), np.empty(end - start)
            for p in range(start, end):
                i = nodes[order[p], 0]
                points[p - start, 0], points[p - start, 1] = poses[i, 0], poses[i, 1]
                r[p - start], w[p - start] = ranges[order[p]], weights[order[p]]
            position = trilaterate(points, r, w).position
            landmarks[k, 0], landmarks[k, 1] = position[0], position[1]
        start = end


def place_landmarks(graph: Graph) -> None:
    """Start of the free landmarks: the mean of their enabled sightings, else trilateration."""
    s = graph.sightings
    use = np.flatnonzero(s.enabled & (s.kinds == FactorKind.REFLECTOR))
    a, k = s.nodes[use].T
    points = transform(graph.poses[a], s.measured[use][:, None, :])[:, 0]
    total = np.zeros_like(graph.landmarks)
    np.add.at(total, k, points)
    count = np.bincount(k, minlength=len(graph.landmarks))
    move = (count > 0) & ~graph.fixed_landmarks
    graph.landmarks[move] = total[move] / count[move, None]
    heard = np.flatnonzero(s.enabled & (s.kinds == FactorKind.RANGE))
    if len(heard):
        _place_all(
            s.nodes[heard].copy(), s.measured[heard, 0].copy(), s.information[heard, 0, 0].copy(),
            ~graph.fixed_landmarks & (count == 0), graph.poses, graph.landmarks,
        )  # fmt: skip


def locate_beacon(graph: Graph, landmark: int) -> Trilateration | None:
    """Where the ranges of a landmark, enabled or not, say that it is; None without any.

    For a beacon that has just been heard: keep its ranges disabled until the other hypothesis
    costs clearly more, then place it (``graph.landmarks``) and enable them.
    """
    s = graph.sightings
    rows = np.flatnonzero((s.kinds == FactorKind.RANGE) & (s.nodes[:, 1] == landmark))
    if not len(rows):
        return None
    points = graph.poses[s.nodes[rows, 0], :2].copy()
    return trilaterate(points, s.measured[rows, 0].copy(), s.information[rows, 0, 0].copy())


def warm_up() -> None:
    """Compile the kernels."""
    trilaterate(np.eye(2), np.ones(2), np.ones(2))
    _place_all(
        np.zeros((1, 2), np.int64), np.ones(1), np.ones(1), np.ones(1, np.bool_),
        np.zeros((1, 3)), np.zeros((1, 2)),
    )  # fmt: skip
