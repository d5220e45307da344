# SPDX-License-Identifier: Apache-2.0
"""Local map for a wide search: a submap whose unknown cells are filled in from its neighbours.

A laser that does not look all around sees other surfaces of a corridor on the way back than on the
way there. In the submap of a few metres of the way there, up to half of the end points of a scan
fall into unknown cells, which count as free: the right place scores no better than a wrong one.
The neighbouring submaps know many of these cells. What the submap knows is left as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.graph import Graph, path_bound
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.se2 import Array
from rlml_slam.slam.closures.keyframe_submap import KeyframeSubmap

MAX_DRIFT = 0.3  # [m] bound of the sigma between the submap and a neighbour: a few cells


class Surroundings(NamedTuple):
    """Finished submaps, with the graph in which they lie."""

    graph: Graph
    submaps: Sequence[KeyframeSubmap]


def local_map(m: KeyframeSubmap, surroundings: Surroundings) -> Submap:
    """Submap ``m`` within its extent, with the cells that only its neighbours know.

    Neighbours are the submaps whose pose relative to it is certain, the most certain one first
    (graph/robust/path_bound.py).
    """
    graph, submaps = surroundings
    anchors = np.array([other.anchor.index for other in submaps], dtype=np.int64)
    drift = path_bound(graph, m.anchor.index, anchors)[:, 0] if len(anchors) else np.zeros(0)
    out = Submap(m.submap.parameters)
    out.values, out.corner = m.submap.values.copy(), m.submap.corner
    out.insertions = m.submap.insertions
    grid = m.grid_pose(graph.poses)
    for k in np.argsort(drift, kind='stable').tolist():
        if drift[k] >= MAX_DRIFT:
            break
        other = submaps[k]
        if other is not m:
            _fill(out, other.submap, se2.between(other.grid_pose(graph.poses), grid))
    return out


def _fill(out: Submap, other: Submap, T_other_out: Array) -> None:
    """Set the unknown cells of ``out`` to the nearest cells of another submap."""
    corner, rows, columns = np.array(other.corner), *other.values.shape
    # the part of the grid that lies in the box around the other one
    corners = corner + np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]])
    box = se2.transform(se2.inverse(T_other_out), corners * out.resolution) / out.resolution
    limits = out.values.shape[1], out.values.shape[0]
    (j0, i0), (j1, i1) = (
        np.clip(np.floor(edge).astype(np.int64) - np.array(out.corner), 0, limits)
        for edge in (box.min(0), box.max(0) + 1.0)
    )
    part = out.values[i0:i1, j0:j1]
    if not part.size:
        return
    c, s = math.cos(T_other_out[2]), math.sin(T_other_out[2])
    x = np.arange(j0, j1, dtype=np.float32) + np.float32(out.corner[0] + 0.5)
    y = (np.arange(i0, i1, dtype=np.float32) + np.float32(out.corner[1] + 0.5))[:, None]
    u, v = (T_other_out[:2] / out.resolution - corner).tolist()
    j, i = _cells(c * x + u, -s * y), _cells(s * x + v, c * y)
    at = (part == 0) & (j >= 0) & (j < columns) & (i >= 0) & (i < rows)
    part[at] = other.values[i[at], j[at]]


def _cells(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.int32]:
    """Indices (rows, columns) of the cells at x + y, both in cells."""
    return np.asarray(np.floor(x + y), dtype=np.int32)
