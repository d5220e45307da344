# SPDX-License-Identifier: Apache-2.0
"""The graph as markers for RViz and Foxglove; apart, as a front end has no graph to draw."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph import FactorKind, Graph
from rlml_slam.ros.codecs.markers import ORANGE, SPHERE_LIST, WHITE, Markers
from rlml_slam.ros.codecs.message_types import Make

LINE_LIST = 5  # visualization_msgs/Marker

EDGE_COLORS = {
    FactorKind.ODOMETRY: (0.6, 0.6, 0.6, 1.0),
    FactorKind.SCAN: (0.2, 0.5, 1.0, 1.0),
    FactorKind.CLOSURE: (0.1, 0.8, 0.3, 1.0),
}


def graph_markers(make: Make, stamp: int, frame_id: str, graph: Graph) -> Any:
    """MarkerArray: keyframes, and edges by kind; factors that are switched off are left out."""
    out = Markers(make, stamp, frame_id)
    poses, size = graph.poses, (0.08, 0.08, 0.08)
    out.add('keyframes', SPHERE_LIST, WHITE, size, points=poses[:, :2])
    edges = graph.edges
    for kind, color in EDGE_COLORS.items():
        of_kind = edges.enabled & (edges.kinds == kind)
        _lines(out, kind.name.lower(), color, poses[edges.nodes[of_kind], :2])
    seen = graph.sightings
    ends = np.stack(
        [poses[seen.nodes[:, 0], :2], graph.landmarks[seen.nodes[:, 1]]], 1
    )[seen.enabled]  # fmt: skip
    _lines(out, 'sightings', (*ORANGE[:3], 0.25), ends)
    return out.array()


def _lines(
    out: Markers, name: str, color: tuple[float, float, float, float], ends: NDArray[np.float64]
) -> None:
    if len(ends):
        out.add(name, LINE_LIST, color, (0.02, 0.0, 0.0), points=ends)
