# SPDX-License-Identifier: Apache-2.0
"""Equally spaced rows and lattices in a layout, along which the constellation repeats."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam.se2 import Array

SAME = 0.1  # [m] by which a reflector may be off its row
FEWEST = 4  # reflectors of a row
LONGEST = 40.0  # [m] between neighbours
MOST = 3  # rows that are named


def rows_of(points: Array) -> list[str]:
    """The rows, longest first, in words; points (m, 2) that one step moves onto others."""
    lines: list[str] = []
    covered = np.zeros(len(points), dtype=np.bool_)
    named: list[Array] = []
    for step, chain in sorted(_chains(points), key=lambda c: (-len(c[1]), *c[0])):
        if covered[chain].all() and (len(named) > 1 or (named and _is_multiple(step, named[0]))):
            continue
        if len(lines) == MOST:
            break
        covered[chain] = True
        named.append(step)
        is_lattice = len(named) > 1 and abs(_sine(named[0], named[-1])) > 0.5
        kind = 'the lattice also repeats' if is_lattice else 'repeats'
        lines.append(f'{kind} after ({step[0]:.1f}, {step[1]:.1f}) m: '
                     f'{len(chain)} reflectors in equally spaced rows')  # fmt: skip
    return lines


def _chains(points: Array) -> Iterator[tuple[Array, NDArray[np.int64]]]:
    """Steps (2,) that join at least FEWEST reflectors to rows of at least FEWEST, and which."""
    if len(points) < FEWEST:
        return
    tree = cKDTree(points)
    a, b = np.nonzero(np.hypot(*(points[None] - points[:, None]).transpose(2, 0, 1)) <= LONGEST)
    d = points[b] - points[a]
    forward = (d[:, 0] > SAME) | ((np.abs(d[:, 0]) <= SAME) & (d[:, 1] > SAME))
    d = d[forward]
    alike = cKDTree(d)
    d = d[alike.query_ball_point(d, 2.0 * SAME, return_length=True) >= FEWEST - 1]
    _, first = np.unique(np.rint(d / SAME).astype(np.int64), axis=0, return_index=True)
    for step in d[first]:
        gap, following = tree.query(points + step, distance_upper_bound=SAME)
        following = np.where(np.isfinite(gap), following, -1)
        row = _in_rows(following)
        if len(row) >= FEWEST:
            yield step, row


def _in_rows(following: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those (k,) whose row, from each to the ``following`` (m,) one, has FEWEST or more."""
    is_first = np.ones(len(following), dtype=np.bool_)
    is_first[following[following >= 0]] = False
    found: list[int] = []
    for k in np.flatnonzero(is_first):
        row = [int(k)]
        while following[row[-1]] >= 0:
            row.append(int(following[row[-1]]))
        found += row if len(row) >= FEWEST else []
    return np.unique(np.array(found, dtype=np.int64))


def _is_multiple(step: Array, of: Array) -> bool:
    times = np.hypot(*step) / np.hypot(*of)
    return abs(_sine(step, of)) < 0.05 and abs(times - round(times)) < 0.05


def _sine(a: Array, b: Array) -> float:
    return float((a[0] * b[1] - a[1] * b[0]) / (np.hypot(*a) * np.hypot(*b)))
