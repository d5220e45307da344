# SPDX-License-Identifier: Apache-2.0
"""The cost of an estimate: the sum of rho(e^T I e) over the enabled factors of a graph."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import brief, part
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.linearization import wrapped
from rlml_slam.graph.model.packed_system import Flags, Tables
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array


@brief
def total_cost(tables: Tables, poses: Array, landmarks: Array) -> tuple[float, int]:
    """(cost, number of residuals) at ``poses`` (n, 3) and ``landmarks`` (m, 2)."""
    losses, cost, num = tables.losses, 0.0, 0
    for table in (tables.edges, tables.pose_priors):
        sum_, rows = _of_poses(
            table.nodes, table.measured, table.information, table.kinds, table.enabled, losses,
            poses,
        )  # fmt: skip
        cost, num = cost + sum_, num + 3 * rows
    for table in (tables.sightings, tables.landmark_priors):
        sum_, rows = _of_landmarks(
            table.nodes, table.measured, table.information, table.kinds, table.enabled, losses,
            poses, landmarks,
        )  # fmt: skip
        cost, num = cost + sum_, num + 2 * rows
    return cost, num


@part
def _of_poses(
    nodes: Ints, measured: Array, information: Array, kinds: Ints, enabled: Flags, losses: Array,
    poses: Array,
) -> tuple[float, int]:  # fmt: skip
    """(cost, number) of edges and priors of poses, with the residuals of factors.py."""
    cost, num, last = 0.0, 0, nodes.shape[1] - 1
    for r in range(len(nodes)):
        if not enabled[r]:
            continue
        j = nodes[r, last]
        x, y, t = measured[r, 0], measured[r, 1], measured[r, 2]
        e0, e1, e2 = poses[j, 0] - x, poses[j, 1] - y, poses[j, 2] - t
        if last == 1:
            i = nodes[r, 0]
            e2 -= poses[i, 2]
            c, s = math.cos(t), math.sin(t)
            C, S = math.cos(poses[i, 2] + t), math.sin(poses[i, 2] + t)
            dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
            e0, e1 = C * dx + S * dy - (c * x + s * y), C * dy - S * dx - (c * y - s * x)
        e2 = wrapped(e2)
        q0 = information[r, 0, 0] * e0 + 2.0 * (information[r, 0, 1] * e1)
        q1 = information[r, 1, 1] * e1 + 2.0 * (information[r, 1, 2] * e2)
        q2 = information[r, 2, 2] * e2 + 2.0 * (information[r, 0, 2] * e0)
        squared = e0 * q0 + e1 * q1 + e2 * q2
        cost += loss(losses[kinds[r], 0], losses[kinds[r], 1], squared)[0]
        num += 1
    return cost, num


@part
def _of_landmarks(
    nodes: Ints, measured: Array, information: Array, kinds: Ints, enabled: Flags, losses: Array,
    poses: Array, landmarks: Array,
) -> tuple[float, int]:  # fmt: skip
    """(cost, number) of sightings and priors of landmarks."""
    cost, num, last = 0.0, 0, nodes.shape[1] - 1
    for r in range(len(nodes)):
        if not enabled[r]:
            continue
        k = nodes[r, last]
        e0, e1 = landmarks[k, 0], landmarks[k, 1]
        if last == 1:
            i = nodes[r, 0]
            C, S = math.cos(poses[i, 2]), math.sin(poses[i, 2])
            dx, dy = e0 - poses[i, 0], e1 - poses[i, 1]
            e0, e1 = C * dx + S * dy, C * dy - S * dx
        e0 -= measured[r, 0]
        e1 -= measured[r, 1]
        squared = e0 * (information[r, 0, 0] * e0 + 2.0 * (information[r, 0, 1] * e1))
        squared += information[r, 1, 1] * e1 * e1
        cost += loss(losses[kinds[r], 0], losses[kinds[r], 1], squared)[0]
        num += 1
    return cost, num


def warm_up() -> None:
    """Compile the kernel."""
    total_cost(Graph().tables(), np.zeros((0, 3)), np.zeros((0, 2)))
