# SPDX-License-Identifier: Apache-2.0
"""Carves a scan into a grid: end points are hit, what the rays to them cross is missed.

Neighbouring rays cross the same cells up to where they are a cell apart. So the area that they
cover is carved row by row, each cell of it once, and rays are followed from its edge on only. The
cells are the same as if every ray were followed from the sensor on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.se2 import Array

TOUCHED = np.uint16(0x8000)  # marks a cell that the scan has changed, or will
WHOLE_RAY = 2.0**40  # a ray's length as an integer
CLOSE = 0.99  # [cells] between two rays, so that a cell does not fit in between
GRAZED = 1.0  # [cells] from a ray to a surface that it does not cross yet
SAME = 0.5  # of a ray: a neighbour that is shorter by more ends on something else
HALF = 0.75  # [cells] from the middle of a cell to a corner, and less than that between
LAST = 4.0 * HALF  # [cells] of the last two cells of a ray, which it does not miss
Cells = NDArray[np.uint16]


class Grid(NamedTuple):
    """Cells ``values`` (rows, columns) as kernels take them.

    ``corner_j`` and ``corner_i`` are the lattice indices of the first, ``scale`` cells per metre.
    """

    values: Cells
    corner_j: float
    corner_i: float
    scale: float


@kernel
def carve(
    grid: Grid, points: Array, origin: Array, hit: Cells, miss: Cells, touched: NDArray[np.int32]
) -> int:
    """Apply one scan to a grid; cells listed, or -1 if the list ``touched`` is too short.

    ``points`` (n, 2) are end points in scan order. Cells outside of the area that rays cover are
    marked with the top bit and listed, and unmarked at the end. The length of the list is checked
    before anything is changed.
    """
    values, corner_j, corner_i, scale = grid
    columns = values.shape[1]
    flat = values.reshape(-1)
    x0, y0 = origin[0] * scale - corner_j, origin[1] * scale - corner_i
    rays = np.empty((len(points), 2))
    for k in range(len(points)):
        rays[k, 0] = points[k, 0] * scale - corner_j - x0
        rays[k, 1] = points[k, 1] * scale - corner_i - y0
    kept = unmissed(rays)
    area, starts = covered(rays, kept)
    # upper bound on listed cells: each ray crosses |di| + |dj| + 1 cells
    bound = 0
    for k in range(len(points)):
        share = 1.0 - starts[k]
        bound += int(abs(rays[k, 0]) * share) + int(abs(rays[k, 1]) * share) + 4
    if min(bound, flat.size) > touched.size:
        return -1
    n = 0
    for k in range(len(points)):
        x1, y1 = points[k, 0] * scale - corner_j, points[k, 1] * scale - corner_i
        cell = int(np.floor(y1)) * columns + int(np.floor(x1))
        v = flat[cell]
        if v < TOUCHED:
            flat[cell] = hit[v] | TOUCHED
            touched[n] = cell
            n += 1
    hits = n
    for k in range(len(points)):
        dx, dy = rays[k, 0], rays[k, 1]
        end = 1.0 - kept[k] / max(math.sqrt(dx * dx + dy * dy), 1.0)
        sx, sy = x0 + starts[k] * dx, y0 + starts[k] * dy
        n = touch_ray(flat, columns, sx, sy, x0 + end * dx, y0 + end * dy, touched, n)
    for row, first, end in spans_of(area, x0, y0, len(values)):
        for cell in range(np.uint64(row * columns + first), np.uint64(row * columns + end)):
            v = flat[cell]
            if v < TOUCHED:
                flat[cell] = miss[np.uint64(v)]
    for m in range(hits):
        flat[np.uint64(touched[m])] &= ~TOUCHED
    for m in range(hits, n):
        at = np.uint64(touched[m])
        flat[at] = miss[np.uint64(flat[at] & ~TOUCHED)]
    return n


@part
def unmissed(rays: Array) -> Array:
    """Length (n,) [cells] before the end of each ray along which it grazes a surface.

    There it is less than GRAZED beside the line to the end of a neighbouring, shorter ray. It
    would wear off the wall on which both end, where their ends are far apart, and its near side
    where they are not.
    """
    n = len(rays)
    out = np.zeros(n)
    for k in range(n):
        x, y = rays[k, 0], rays[k, 1]
        length = math.sqrt(x * x + y * y)
        for other in (k - 1, k + 1):
            if 0 <= other < n and length > 0.0:
                dx, dy = x - rays[other, 0], y - rays[other, 1]
                along, beside = (x * dx + y * dy) / length, abs(x * dy - y * dx) / length
                if 0.0 < along < SAME * length:
                    grazed = along if beside <= GRAZED else along * GRAZED / beside
                    out[k] = max(out[k], grazed)
    return out


@part
def covered(rays: Array, kept: Array) -> tuple[Array, Array]:
    """What rays (n, 2) [cells] from one origin cover so densely that they cross every cell of it.

    The corners (2n, 2) of an area about the origin, two on each ray, and the share (n,) of each
    ray up to which the cells that it crosses have their middles in that area, or are crossed by
    another ray beyond such a share of its own. Of each ray, ``kept`` (n,) [cells] are left out.

    A cell whose middle lies between two rays is crossed by one of them wherever they are less than
    the side of a cell apart: it would not fit in between. Rays are in the order of their angles or
    nearly so; between two that are not, there is no area.
    """
    n = len(rays)
    length, until = np.empty(n), np.empty(n)
    turn = 0.0
    for k in range(n):
        length[k] = math.sqrt(rays[k, 0] * rays[k, 0] + rays[k, 1] * rays[k, 1])
        until[k] = length[k] - kept[k]
        if k:
            turn += rays[k - 1, 0] * rays[k, 1] - rays[k - 1, 1] * rays[k, 0]
    area, share = np.zeros((2 * n, 2)), np.zeros(n)
    before = 0.0  # up to where the area between the last ray and this one is covered
    for k in range(n):
        after = 0.0
        if k + 1 < n:
            ax, ay, bx, by = rays[k, 0], rays[k, 1], rays[k + 1, 0], rays[k + 1, 1]
            dot, cross = ax * bx + ay * by, ax * by - ay * bx
            if dot > 0.0 and cross * turn >= 0.0:
                after = min(until[k], until[k + 1]) - LAST
                if abs(cross) * after > CLOSE * dot:
                    after = CLOSE * dot / abs(cross)  # twice the tangent of half the angle is less
                after = max(after - HALF, 0.0)
        if length[k] > 0.0:
            ux, uy = rays[k, 0] / length[k], rays[k, 1] / length[k]
            area[2 * k, 0], area[2 * k, 1] = ux * before, uy * before
            area[2 * k + 1, 0], area[2 * k + 1, 1] = ux * after, uy * after
            share[k] = max(min(before, after) - HALF, 0.0) / length[k]
        before = after
    return area, share


@part
def spans_of(area: Array, x0: float, y0: float, rows: int) -> NDArray[np.int64]:
    """Cells with their middles in an area: (m, 3) of row, first column and one past the last.

    ``area`` (n, 2) [cells] are its corners relative to the origin (x0, y0), around which it goes
    in one sense, more than once perhaps. No cell is in two spans.
    """
    n = len(area)
    row_of = np.empty(n, dtype=np.int64)  # the first row with its middle above each corner
    for k in range(n):
        row_of[k] = int(np.ceil(area[k, 1] + y0 - 0.5))
    # how many edges cross the middle of each row
    counts = np.zeros(rows + 1, dtype=np.int64)
    last = row_of[n - 1]
    for k in range(n):
        counts[np.uint64(min(last, row_of[k]))] += 1
        counts[np.uint64(max(last, row_of[k]))] -= 1
        last = row_of[k]
    begins, total, crossed = np.empty(rows + 1, dtype=np.int64), 0, 0
    for i in range(rows + 1):
        begins[i] = total
        crossed += counts[i]
        total += crossed
    # where: 2 column + 1 upwards, sorted row by row
    ends, crossings = begins.copy(), np.empty(total, dtype=np.int64)
    a, ax, ay = row_of[n - 1], area[n - 1, 0], area[n - 1, 1]
    for k in range(n):
        b, bx, by = row_of[k], area[k, 0], area[k, 1]
        if a != b:
            slope, low, high = (bx - ax) / (by - ay), min(ax, bx), max(ax, bx)
            upwards = int(b > a)
            for i in range(np.uint64(min(a, b)), np.uint64(max(a, b))):
                x = x0 + min(max(ax + slope * (i + 0.5 - y0 - ay), low), high)
                code = 2 * int(np.ceil(x - 0.5)) + upwards
                m, begin = ends[i], begins[i]
                ends[i] = m + 1
                while m > begin and crossings[np.uint64(m - 1)] > code:
                    crossings[np.uint64(m)] = crossings[np.uint64(m - 1)]
                    m -= 1
                crossings[np.uint64(m)] = code
        a, ax, ay = b, bx, by
    spans = np.empty((len(crossings), 3), dtype=np.int64)
    count = 0
    for i in range(rows):
        winding = 0
        for m in range(np.uint64(begins[i]), np.uint64(ends[i])):
            column = crossings[m] >> 1
            if winding == 0:
                spans[count, 0], spans[count, 1] = i, column
            winding += 1 if crossings[m] & 1 else -1
            if winding == 0 and column > spans[count, 1]:
                spans[count, 2] = column
                count += 1
    return spans[:count]


@part
def touch_ray(
    flat: NDArray[np.uint16],
    columns: int,
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    touched: NDArray[np.int32],
    n: int,
) -> int:
    """Mark and list the cells from (x0, y0) to (x1, y1) [cells], but the last two (Amanatides).

    The cell before the end point's is not known to be free: the wall's noise reaches into it, and
    beams that graze the wall would wear off its near side. The loop has no branches, which no
    processor could predict: the place along the ray is an integer, and a cell that is marked
    already is overwritten by the next one in the list.
    """
    j, i = int(np.floor(x0)), int(np.floor(y0))
    dx, dy = x1 - x0, y1 - y0
    left = abs(int(np.floor(x1)) - j) + abs(int(np.floor(y1)) - i)
    step_j = 1 if dx > 0 else -1
    step_i = columns if dy > 0 else -columns
    per_j = 1.0 / abs(dx) if dx != 0 else np.inf
    per_i = 1.0 / abs(dy) if dy != 0 else np.inf
    first_j = ((j + 1 - x0) if dx > 0 else (x0 - j)) * per_j if dx != 0 else np.inf
    first_i = ((i + 1 - y0) if dy > 0 else (y0 - i)) * per_i if dy != 0 else np.inf
    # where along the ray the next column (row) begins; how far beyond its end does not matter
    next_j, next_i = int(min(first_j, 2.0) * WHOLE_RAY), int(min(first_i, 2.0) * WHOLE_RAY)
    width, height = int(min(per_j, 2.0) * WHOLE_RAY), int(min(per_i, 2.0) * WHOLE_RAY)
    cell, turn, both, ahead = i * columns + j, step_j - step_i, width + height, next_j - next_i
    for _ in range(left - 1):
        # unsigned: an index that may be negative is looked at twice
        at = np.uint64(cell)
        touched[np.uint64(n)] = cell
        v = flat[at]
        flat[at] = v | TOUCHED
        n += int(v < TOUCHED)
        sideways = ahead >> 63  # all bits where the next column begins first, or none
        cell = cell + step_i + (sideways & turn)
        ahead = (ahead - height) + (sideways & both)
    return n


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    touched, table = np.zeros(64, dtype=np.int32), np.zeros(0x8000, dtype=np.uint16)
    values, points = np.zeros((16, 16), dtype=np.uint16), np.array([[12.0, 9.0], [11.0, 10.0]])
    carve(Grid(values, 0.0, 0.0, 1.0), points, np.array([3.0, 3.0]), table, table, touched)
