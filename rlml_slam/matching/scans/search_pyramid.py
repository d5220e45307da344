# SPDX-License-Identifier: Apache-2.0
"""Max-pooled copies of a grid that bound how well a scan can fit anywhere in a block of poses.

A block holds ``side`` x ``side`` shifts and a few neighbouring angles. In it, an end point meets
the cells of a square window; its bound is the largest of them. Windows of several sizes are kept,
because an end point far away moves by more cells with the angle than one near by.

Values have four bits (0 = unknown or P_MIN, 15 = P_MAX), rounded up. Rows and columns are stored
by their remainder modulo ``side``, so that neighbouring blocks are neighbours in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import formula
from rlml_slam.matching.scans.submap import LEVELS, Submap, probability_of, value_of

Bytes = NDArray[np.uint8]

BEFORE, AFTER = 72, 24  # empty cells around the grid, multiples of 8: blocks may begin there
LANES = 64  # blocks whose bounds are summed up at a time
FULL = 15  # largest value of four bits
UNIT = 17  # of the 255 values of a byte, per value of four bits
# Bytes of cell values, by the probability of the cells; 0 and 1 (unknown, P_MIN) become 0
BYTES = np.append(
    0, value_of(probability_of(np.arange(1, LEVELS + 1, dtype=np.uint16))) >> 7
).astype(np.uint8)
# Sizes of the windows [cells], even: a block of side 8 has four angles, one of side 4 has two.
EIGHT, FOUR = (8, 10, 12, 14, 18, 26, 42, 72), (4, 6, 8, 12, 20, 40)
NEAR = 1.0  # [m] from what is known, within which a robot may stand


class Level(NamedTuple):
    """Pooled grids for blocks of one ``side``, one for each of the ``windows`` [cells].

    Cell (i, j) of the padded grid is in the plane of the remainders of i and j, which are rounded
    down to multiples of ``phase``. In ``data``, window w begins at ``starts[w]``, a plane has
    ``plane`` bytes and its rows ``columns``.
    """

    data: Bytes
    side: int
    phase: int
    columns: int
    plane: int
    windows: NDArray[np.int64]
    starts: NDArray[np.int64]


class Levels(NamedTuple):
    """A grid of ``rows`` x ``width`` cells: blocks of side 8, 4 and 2, and the cells themselves.

    ``cells`` are bytes (0 = unknown or P_MIN, 255 = P_MAX), padded by BEFORE and AFTER to rows of
    ``columns``.
    """

    rows: int
    width: int
    eight: Level
    four: Level
    two: Level
    cells: Bytes
    columns: int


class Pyramid:
    """The levels of a submap, whose first cell is at ``corner`` (column, row) of the lattice.

    ``version`` is that of the submap when this was built. ``near`` says for each 8 x 8 cells of
    the padded grid whether anything within NEAR is known.
    """

    def __init__(self, submap: Submap) -> None:
        self.resolution = submap.resolution
        self.version = submap.version
        self.corner = submap.corner
        rows, width = submap.values.shape
        height, columns = (-(-n // 8) * 8 + BEFORE + AFTER for n in (rows, width))
        grid = np.zeros((height, columns), np.uint8)
        inner = (slice(BEFORE, BEFORE + rows), slice(BEFORE, BEFORE + width))
        grid[inner] = BYTES[submap.values]
        pairs = pooled(grid // UNIT + (grid % UNIT > 0), 1)  # of 2 x 2 cells
        self.levels = Levels(
            rows, width,
            _level(list(grown(pairs[::2, ::2], EIGHT)), EIGHT, 8, 2),
            _level(list(grown(pairs[::2, ::2], FOUR)), FOUR, 4, 2),
            _level([pairs], (2,), 2, 1),
            np.append(grid.ravel(), np.zeros(LANES, np.uint8)), columns,
        )  # fmt: skip
        known = np.zeros_like(grid)
        known[inner] = submap.values != 0
        blocks = known.reshape(height // 8, 8, columns // 8, 8).max(axis=(1, 3))
        reach = 1 + int(NEAR / (8.0 * self.resolution))
        for axis in (0, 1):
            blocks = _dilated(blocks, reach, axis)
        self.near = blocks

    @property
    def nbytes(self) -> int:
        """Memory of the levels."""
        v = self.levels
        return sum(a.nbytes for a in (v.eight.data, v.four.data, v.two.data, v.cells))


def pooled(grid: Bytes, shift: int) -> Bytes:
    """Maximum of grid at (i, j), (i, j + shift), (i + shift, j), (i + shift, j + shift)."""
    wide = grid.copy()
    np.maximum(wide[:, :-shift], grid[:, shift:], out=wide[:, :-shift])
    tall = wide.copy()
    np.maximum(tall[:-shift], wide[shift:], out=tall[:-shift])
    return tall


def grown(pairs: Bytes, windows: Sequence[int]) -> Iterator[Bytes]:
    """Maxima of ever larger windows [cells] of a grid of 2 x 2 cells."""
    size = 1
    for window in windows:
        while size < window // 2:
            step = min(size, window // 2 - size)
            pairs, size = pooled(pairs, step), size + step
        yield pairs


def _level(grids: Sequence[Bytes], windows: Sequence[int], side: int, phase: int) -> Level:
    """The grids by the remainders of rows and columns.

    A byte holds a value and, in the upper bits, the one below it. Rows of the largest blocks are
    as far apart as blocks are summed up at a time: those beyond the grid are empty then.
    """
    parts = side // phase
    rows, columns = (n // parts for n in grids[0].shape)
    stride = columns + (LANES if side == 8 else 1)
    planes = np.zeros((len(grids), parts * parts, rows, stride), np.uint8)
    for out, grid in zip(planes, grids, strict=True):
        split = grid.reshape(rows, parts, columns, parts).transpose(1, 3, 0, 2)
        out[:, :, :columns] = split.reshape(parts * parts, rows, columns)
    size, empty = parts * parts * rows * stride, np.zeros(LANES + stride, np.uint8)
    data = np.concatenate([empty, planes.ravel(), empty])
    data[:-stride] |= data[stride:] << 4
    starts = len(empty) + size * np.arange(len(grids))
    return Level(data, side, phase, stride, rows * stride, np.array(windows), starts)


def _dilated(blocks: Bytes, reach: int, axis: int) -> Bytes:
    """Maximum over ``reach`` blocks on each side."""
    blocks = np.moveaxis(blocks, axis, 0)
    out = blocks.copy()
    for k in range(1, reach + 1):
        np.maximum(out[:-k], blocks[k:], out=out[:-k])
        np.maximum(out[k:], blocks[:-k], out=out[k:])
    return np.moveaxis(out, 0, axis)


@formula
def place(level: Level, i: int, j: int, extent: int) -> int:
    """Where the bound of a block's window from cell (i, j) on is; -1: no window is that large.

    The window is ``extent`` cells larger than the block, because the angles of the block differ.
    """
    side, phase = level.side, level.phase
    needed = side + extent + max(i % phase, j % phase)
    for w in range(len(level.windows)):
        if level.windows[w] >= needed:
            plane = (i % side) // phase * (side // phase) + (j % side) // phase
            at = i // side * level.columns + j // side
            return int(level.starts[w] + plane * level.plane + at)
    return -1
