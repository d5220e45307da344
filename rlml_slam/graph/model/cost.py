# SPDX-License-Identifier: Apache-2.0
"""The cost of an estimate: the sum of rho(e^T I e) over the enabled factors of a graph."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import brief, part
from rlml_slam.graph.model.factors import (
    NUM_RESIDUALS,
    Information,
    axes,
    residual,
    rotate,
    rotate_back,
    weighted,
)
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.packed_system import Factors, Tables
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.se2 import Array, wrapped_by_turns


@brief
def total_cost(tables: Tables, poses: Array, landmarks: Array) -> tuple[float, int]:
    """(cost, number of residuals) at ``poses`` (n, 3) and ``landmarks`` (m, 2)."""
    losses, cost, num = tables.losses, 0.0, 0
    for table in (tables.edges, tables.pose_priors):
        sum_, rows = _of_poses(table, losses, poses)
        cost, num = cost + sum_, num + rows
    for table in (tables.sightings, tables.landmark_priors):
        sum_, rows = _of_landmarks(table, losses, poses, landmarks)
        cost, num = cost + sum_, num + rows
    return cost, num


@part
def _of_poses(table: Factors, losses: Array, poses: Array) -> tuple[float, int]:
    """(cost, number of residuals) of edges or of priors of poses."""
    cost, num, last = 0.0, 0, table.nodes.shape[1] - 1
    for r in range(len(table.nodes)):
        if not table.enabled[r]:
            continue
        j, kind = table.nodes[r, last], table.kinds[r]
        x, y, angle = table.measured[r, 0], table.measured[r, 1], table.measured[r, 2]
        dx, dy, theta = poses[j, 0], poses[j, 1], poses[j, 2]
        c, s = 1.0, 0.0
        if last == 1:
            i = table.nodes[r, 0]
            dx, dy, theta = dx - poses[i, 0], dy - poses[i, 1], theta - poses[i, 2]
            cos, sin = math.cos(angle), math.sin(angle)
            x, y = rotate_back(cos, sin, x, y)
            c, s = rotate(cos, sin, math.cos(poses[i, 2]), math.sin(poses[i, 2]))
        e0, e1 = residual(c, s, dx, dy, x, y)
        e2 = wrapped_by_turns(theta - angle)
        info = table.information[r]
        W = Information(info[0, 0], info[0, 1], info[0, 2], info[1, 1], info[1, 2], info[2, 2])
        q0, q1, q2 = weighted(W, e0, e1, e2)
        squared = e0 * q0 + e1 * q1 + e2 * q2
        cost += loss(losses[kind, 0], losses[kind, 1], squared)[0]
        num += NUM_RESIDUALS[kind]
    return cost, num


@part
def _of_landmarks(
    table: Factors, losses: Array, poses: Array, landmarks: Array
) -> tuple[float, int]:
    """(cost, number of residuals) of sightings, ranges or priors of landmarks."""
    cost, num, last = 0.0, 0, table.nodes.shape[1] - 1
    for r in range(len(table.nodes)):
        if not table.enabled[r]:
            continue
        k, kind = table.nodes[r, last], table.kinds[r]
        dx, dy = landmarks[k, 0], landmarks[k, 1]
        c, s = 1.0, 0.0
        if last == 1:
            i = table.nodes[r, 0]
            dx, dy = dx - poses[i, 0], dy - poses[i, 1]
            c, s = axes(kind, math.cos(poses[i, 2]), math.sin(poses[i, 2]), dx, dy)
        e0, e1 = residual(c, s, dx, dy, table.measured[r, 0], table.measured[r, 1])
        info = table.information[r]
        W = Information(info[0, 0], info[0, 1], 0.0, info[1, 1], 0.0, 0.0)
        q0, q1, _ = weighted(W, e0, e1, 0.0)
        cost += loss(losses[kind, 0], losses[kind, 1], e0 * q0 + e1 * q1)[0]
        num += NUM_RESIDUALS[kind]
    return cost, num


def warm_up() -> None:
    """Compile the kernel."""
    total_cost(Graph().tables(), np.zeros((0, 3)), np.zeros((0, 2)))
