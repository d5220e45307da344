# SPDX-License-Identifier: Apache-2.0
"""Correlative search: exhaustive in a small window, branch and bound in a large one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.errors import InputError
from rlml_slam.matching.submap import LEVELS, P_MAX, P_MIN, Submap
from rlml_slam.se2 import Array, wrap


@dataclass(frozen=True)
class Candidate:
    """Pose (3,) of base in the submap frame with its mean hit probability there."""

    pose: Array
    score: float


def window(
    submap: Submap,
    points: Array,
    pose: Array,
    half_width: float,
    half_angle: float,
    whitening: Array | None = None,
    prior_scale: float = 3.0,
    share: float = 0.05,
    stride: int = 1,
) -> Candidate:
    """The best pose on a lattice around ``pose`` (3,), ties to the nearest.

    The objective is the mean of M less prior_loss(): where the scan does not tell (along a
    corridor), the prior does. Without ``whitening`` (3, 3) it is the scan alone.

    ``points`` (n, 2) in the base frame. Shifts are multiples of ``stride`` cells; the angular
    step moves the mean end point by as much.
    """
    spacing = stride * submap.resolution
    n = round(half_width / spacing)
    reach = float(np.mean(np.hypot(points[:, 0], points[:, 1]))) if len(points) else 1.0
    step = min(max(spacing / max(reach, spacing), 0.005 * stride), 0.05 * stride)
    m = math.ceil(half_angle / step)
    step = half_angle / m if m else 0.0
    j, i = submap.corner
    x, y, theta, total = search_window(
        submap.values, float(j), float(i), 1.0 / submap.resolution, points, pose, n, stride, m,
        step, np.zeros((3, 3)) if whitening is None else whitening, prior_scale,
        share * len(points) * LEVELS / (P_MAX - P_MIN),
    )  # fmt: skip
    score = P_MIN + (P_MAX - P_MIN) * total / (LEVELS * max(len(points), 1))
    return Candidate(np.array([x, y, float(wrap(theta))]), score)


@kernel
def prior_loss(x: float, y: float, turn: float, whitening: Array, prior_scale: float) -> float:
    """Sum over u = whitening @ (x, y, turn) of v^2 / (1 + v^2), v = u_k / prior_scale."""
    loss = 0.0
    for h in range(3):
        u = (whitening[h, 0] * x + whitening[h, 1] * y + whitening[h, 2] * turn) / prior_scale
        loss += u * u / (1.0 + u * u)
    return loss


@kernel
def search_window(
    values: NDArray[np.uint16],
    corner_j: float,
    corner_i: float,
    scale: float,
    points: Array,
    pose: Array,
    n: int,
    stride: int,
    m: int,
    step: float,
    whitening: Array,
    prior_scale: float,
    unit: float,
) -> tuple[float, float, float, int]:
    """Exhaustive sum of cell values over (2 n + 1)^2 shifts and 2 m + 1 angles.

    ``unit`` is the sum of cell values that a component far from the prior costs.
    """
    width = 2 * n + 1
    sums = np.empty((width, width), dtype=np.int64)
    best, best_distance = -np.inf, 0.0
    best_a = best_j = best_i = best_sum = 0
    for a in range(-m, m + 1):
        c, s = np.cos(pose[2] + a * step), np.sin(pose[2] + a * step)
        sums[:] = 0
        for k in range(len(points)):
            px, py = points[k, 0], points[k, 1]
            u = (pose[0] + c * px - s * py) * scale - corner_j
            v = (pose[1] + s * px + c * py) * scale - corner_i
            add_block(values, int(np.floor(u)) - n * stride, int(np.floor(v)) - n * stride,
                      stride, sums)  # fmt: skip
        for r in range(width):
            for q in range(width):
                di, dj = (r - n) * stride, (q - n) * stride
                distance = di * di + dj * dj + a * a
                loss = prior_loss(dj / scale, di / scale, a * step, whitening, prior_scale)
                value = sums[r, q] - unit * loss
                if value > best or (value == best and distance < best_distance):
                    best, best_distance, best_sum = value, distance, sums[r, q]
                    best_a, best_j, best_i = a, dj, di
    return pose[0] + best_j / scale, pose[1] + best_i / scale, pose[2] + best_a * step, best_sum


@kernel
def add_block(
    values: NDArray[np.uint16], j: int, i: int, stride: int, sums: NDArray[np.int64]
) -> None:
    """Add the cells (i, j), (i, j + stride) ... of a square to ``sums``; 0 outside the grid."""
    rows, columns = values.shape
    width = len(sums)
    reach = (width - 1) * stride
    if j >= 0 and i >= 0 and j + reach < columns and i + reach < rows:
        for r in range(width):
            for q in range(width):
                sums[r, q] += values[i + r * stride, j + q * stride]
        return
    for r in range(width):
        y = i + r * stride
        if 0 <= y < rows:
            for q in range(width):
                x = j + q * stride
                if 0 <= x < columns:
                    sums[r, q] += values[y, x]


@dataclass(frozen=True)
class WideResult:
    """The best pose of a wide search and the best one well separated from it, None if too weak."""

    best: Candidate | None
    second: Candidate | None
    evaluated: int


class Pyramid:
    """Max-pooled grids of one submap for branch and bound (Hess et al. 2016, section V-B).

    Level h at [i, j] is the largest value of the 2^h x 2^h cells from (i, j) on, quantised to a
    byte (0 = unknown or P_MIN, 255 = P_MAX). All levels have the resolution of the submap and
    are padded by 2^depth on the low sides, so that a block that begins outside is bounded too.
    """

    def __init__(self, submap: Submap, depth: int = 6) -> None:
        self.resolution = submap.resolution
        self.version = submap.version
        self.depth = depth
        pad = 2**depth
        self.corner = (submap.corner[0] - pad, submap.corner[1] - pad)
        base = np.zeros((submap.values.shape[0] + pad, submap.values.shape[1] + pad), np.uint8)
        # values reach LEVELS = 2^15 - 1; 0 and 1 (unknown, P_MIN) become 0
        base[pad:, pad:] = np.minimum(submap.values >> 7, 255)
        levels = [base]
        for h in range(depth):
            levels.append(pool(levels[-1], 2**h))
        self.levels = np.stack(levels)


def pool(grid: NDArray[np.uint8], shift: int) -> NDArray[np.uint8]:
    """Maximum of grid at (i, j), (i, j + shift), (i + shift, j), (i + shift, j + shift)."""
    wide = grid.copy()
    np.maximum(wide[:, :-shift], grid[:, shift:], out=wide[:, :-shift])
    tall = wide.copy()
    np.maximum(tall[:-shift], wide[shift:], out=tall[:-shift])
    return tall


def wide(
    pyramid: Pyramid,
    points: Array,
    pose: Array,
    half_width: float,
    half_angle: float,
    min_score: float = 0.0,
    separation: float = 0.5,
    separation_angle: float = 0.3,
    second_share: float = 0.7,
) -> WideResult:
    """Best pose on a lattice around ``pose`` (3,) by branch and bound, and the best other one.

    ``points`` (n, 2) in the base frame; scores are mean hit probabilities at the nearest cells.
    Shifts are whole cells within ``half_width`` [m], angles steps that move the far end points
    by about a cell within ``half_angle`` (>= pi: all around). The second candidate differs by
    more than ``separation`` [m] in x or y or by more than ``separation_angle``, and is
    looked for down to ``second_share`` of the best sum. Candidates below ``min_score`` are None.
    Raises InputError for no points.
    """
    if not len(points):
        raise InputError('wide search: the scan has no points')
    points = np.ascontiguousarray(points, dtype=np.float64)
    thetas = angles(points, pyramid.resolution, half_angle)
    n = round(half_width / pyramid.resolution)
    threshold = math.ceil((min_score - P_MIN) / (P_MAX - P_MIN) * 255.0 * len(points)) - 1
    found = np.empty((2, 4), dtype=np.int64)
    turns = separation_angle / (thetas[1] - thetas[0]) if len(thetas) > 1 else math.inf
    evaluated = branch_and_bound(
        pyramid.levels, pyramid.corner[0], pyramid.corner[1], 1.0 / pyramid.resolution, points,
        np.ascontiguousarray(pose, dtype=np.float64), thetas, n, max(threshold, -1),
        separation / pyramid.resolution, turns, half_angle >= math.pi, second_share, found,
    )  # fmt: skip

    def candidate(row: NDArray[np.int64]) -> Candidate | None:
        if row[0] < 0:
            return None
        shift = row[2:4] * pyramid.resolution
        at = (pose[0] + shift[0], pose[1] + shift[1], float(wrap(pose[2] + thetas[row[1]])))
        score = P_MIN + (P_MAX - P_MIN) * float(row[0]) / (255.0 * len(points))
        return Candidate(np.array(at), score)

    return WideResult(candidate(found[0]), candidate(found[1]), evaluated)


def angles(points: Array, resolution: float, half_angle: float) -> Array:
    """Angles searched (m,), relative: a step moves the 90th percentile of ranges by a cell."""
    reach = max(float(np.quantile(np.hypot(points[:, 0], points[:, 1]), 0.9)), 1.0)
    step = resolution / reach
    if half_angle >= math.pi:
        m = math.ceil(2.0 * math.pi / step)
        return np.arange(m, dtype=np.float64) * (2.0 * math.pi / m)
    m = math.ceil(half_angle / step)
    return np.arange(-m, m + 1, dtype=np.float64) * (half_angle / max(m, 1))


@kernel
def branch_and_bound(
    levels: NDArray[np.uint8],
    corner_j: int,
    corner_i: int,
    scale: float,
    points: Array,
    pose: Array,
    thetas: Array,
    n: int,
    threshold: int,
    separation: float,
    separation_turns: float,
    circular: bool,
    second_share: float,
    found: NDArray[np.int64],
) -> int:
    """Rows of ``found``: (sum, angle index, column shift, row shift) of best and second, -1 none.

    Returns the number of poses and blocks evaluated.
    """
    depth = len(levels) - 1
    cells = np.empty((len(thetas), len(points), 2), dtype=np.int32)
    for a in range(len(thetas)):
        c, s = np.cos(pose[2] + thetas[a]), np.sin(pose[2] + thetas[a])
        for k in range(len(points)):
            px, py = points[k, 0], points[k, 1]
            cells[a, k, 0] = int(np.floor((pose[0] + c * px - s * py) * scale)) - corner_j
            cells[a, k, 1] = int(np.floor((pose[1] + s * px + c * py) * scale)) - corner_i
    size = 1 << depth
    tiles = (2 * n + size) // size
    num_roots = len(thetas) * tiles * tiles
    sums = np.empty(num_roots, dtype=np.int64)
    m = 0
    for a in range(len(thetas)):
        for i in range(tiles):
            for j in range(tiles):
                sums[m] = block_sum(levels[depth], cells[a], j * size - n, i * size - n)
                m += 1
    order = np.argsort(-sums, kind='mergesort')
    evaluated = num_roots
    stack = np.empty((4 * depth + 4, 5), dtype=np.int64)
    child = np.empty((4, 3), dtype=np.int64)
    for rank in range(2):
        found[rank] = -1
        if rank == 0:
            best = threshold
        elif found[0, 0] >= 0:
            best = max(threshold, int(second_share * found[0, 0]))
        else:
            break
        for number in order:
            root = int(number)
            if sums[root] <= best:
                break
            a, rest = divmod(root, tiles * tiles)
            i, j = divmod(rest, tiles)
            stack[0, 0], stack[0, 1], stack[0, 2] = sums[root], a, j * size - n
            stack[0, 3], stack[0, 4] = i * size - n, depth
            top = 1
            while top > 0:
                top -= 1
                total, j, i, h = stack[top, 0], stack[top, 2], stack[top, 3], stack[top, 4]
                if total <= best:
                    continue
                if rank == 1 and excluded(
                    found[0], a, j, i, (1 << h) - 1, len(thetas), separation, separation_turns,
                    circular,
                ):  # fmt: skip
                    continue
                if h == 0:
                    best = total
                    found[rank, 0], found[rank, 1] = total, a
                    found[rank, 2], found[rank, 3] = j, i
                    continue
                half = 1 << (h - 1)
                count = 0
                for q in range(4):
                    cj, ci = j + (q & 1) * half, i + (q >> 1) * half
                    if cj > n or ci > n:
                        continue
                    value = block_sum(levels[h - 1], cells[a], cj, ci)
                    evaluated += 1
                    if value <= best:
                        continue
                    # ascending, so that the largest is on top; equal ones keep lattice order
                    at = count
                    while at > 0 and child[at - 1, 0] >= value:
                        child[at] = child[at - 1]
                        at -= 1
                    child[at, 0], child[at, 1], child[at, 2] = value, cj, ci
                    count += 1
                for q in range(count):
                    stack[top, 0], stack[top, 1] = child[q, 0], a
                    stack[top, 2], stack[top, 3] = child[q, 1], child[q, 2]
                    stack[top, 4] = h - 1
                    top += 1
    return evaluated


@kernel
def block_sum(level: NDArray[np.uint8], cells: NDArray[np.int32], j: int, i: int) -> int:
    """Sum over the points of the level's value at their cells shifted by (j, i)."""
    rows, columns = level.shape
    total = 0
    for k in range(len(cells)):
        q, r = cells[k, 0] + j, cells[k, 1] + i
        if 0 <= q < columns and 0 <= r < rows:
            total += level[r, q]
    return total


@kernel
def excluded(
    best: NDArray[np.int64],
    a: int,
    j: int,
    i: int,
    extra: int,
    num_angles: int,
    separation: float,
    separation_turns: float,
    circular: bool,
) -> bool:
    """Whether the whole block (j..j + extra, i..i + extra) at angle a is near the best pose."""
    da = abs(a - best[1])
    if circular:
        da = min(da, num_angles - da)
    if da > separation_turns:
        return False
    dj = max(abs(j - best[2]), abs(j + extra - best[2]))
    di = max(abs(i - best[3]), abs(i + extra - best[3]))
    return bool(dj <= separation and di <= separation)


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    points = np.array([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.8]])
    submap.insert(points, np.zeros(2))
    window(submap, points, np.zeros(3), 0.1, 0.1)
    wide(Pyramid(submap, 3), points, np.zeros(3), 0.2, 0.1)
