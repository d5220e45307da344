# SPDX-License-Identifier: Apache-2.0
"""Compiled linearisation: factors scattered straight into the panels of the fronts.

The same factors as factors.py, which the tests hold this against. With R = R(theta_i +
theta_delta) and d = t_j - t_i the residual of an edge is e = (R^T d - R_delta^T t_delta, wrapped
angle) and its Jacobians are J_j = diag(R^T, 1) and J_i = -J_j A with A = [1 0 -d_y; 0 1 d_x;
0 0 1], so that with M = J_j^T W J_j and u = J_j^T W e

    H_jj = M, H_ij = -A^T M, H_ii = A^T M A, g_j = u, g_i = -A^T u.

A sighting has the same form with J_m = R(theta)^T and A = [1 0 -d_y; 0 1 d_x].
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.model.packed_system import System
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.graph.sparse.symbolic_analysis import Records
from rlml_slam.se2 import Array


@part
def wrapped(angle: float) -> float:
    """Angle moved to (-pi, pi]."""
    turns: float = np.ceil((angle - math.pi) / (2.0 * math.pi))
    return angle - 2.0 * math.pi * turns


@kernel
def linearize(system: System, poses: Array, landmarks: Array, fill: bool) -> tuple[float, float]:
    """(cost, chi2) at an estimate, with the gradient g = J^T W e; with ``fill`` also H."""
    rotations = system.rotations
    for i in range(len(poses)):
        angle = poses[i, 2]
        rotations[i, 0], rotations[i, 1] = math.cos(angle), math.sin(angle)
    return linearize_here(system, poses, landmarks, fill)


@part
def linearize_here(
    system: System, poses: Array, landmarks: Array, fill: bool
) -> tuple[float, float]:
    """As linearize, at the estimate of its last call: the rotations are those."""
    g, values = system.g, system.values
    fill = bool(fill)  # not of a literal's type, for which all below would be compiled anew
    for i in range(len(g)):
        g[i] = 0.0
    if fill:
        for i in range(len(values)):
            values[i] = 0.0
    losses, variables, rotations = system.losses, system.variables, system.rotations
    c0, s0 = _edges(system.edges, variables, losses, poses, rotations, values, g, fill)
    c1, s1 = _sightings(
        system.sightings, variables, losses, poses, rotations, landmarks, values, g, fill
    )
    c2, s2 = _priors(system.priors, variables, losses, poses, landmarks, values, g, fill)
    return c0 + c1 + c2, s0 + s1 + s2


@part
def _edges(
    edges: Records,
    variables: Records,
    losses: Array,
    poses: Array,
    rotations: Array,
    v: Array,
    g: Array,
    fill: bool,
) -> tuple[float, float]:
    cost, chi2 = 0.0, 0.0
    for f in range(len(edges)):
        z = edges[f]
        i, j, kind = z['i'], z['j'], z['kind']
        c = rotations[i, 0] * z['c'] - rotations[i, 1] * z['s']
        s = rotations[i, 1] * z['c'] + rotations[i, 0] * z['s']
        dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        e0 = c * dx + s * dy - z['x']
        e1 = c * dy - s * dx - z['y']
        e2 = wrapped(poses[j, 2] - poses[i, 2] - z['theta'])
        I00, I01, I02 = z['I00'], z['I01'], z['I02']
        I11, I12, I22 = z['I11'], z['I12'], z['I22']
        q0 = I00 * e0 + I01 * e1 + I02 * e2
        q1 = I01 * e0 + I11 * e1 + I12 * e2
        q2 = I02 * e0 + I12 * e1 + I22 * e2
        squared = e0 * q0 + e1 * q1 + e2 * q2
        rho, w = loss(losses[kind, 0], losses[kind, 1], squared)
        cost += rho
        chi2 += squared
        u0, u1, u2 = w * (c * q0 - s * q1), w * (s * q0 + c * q1), w * q2
        a, b = z['a'], z['b']
        if a >= 0:
            k = variables[a]['scalar']
            g[k] -= u0
            g[k + 1] -= u1
            g[k + 2] -= dx * u1 - dy * u0 + u2
        if b >= 0:
            k = variables[b]['scalar']
            g[k] += u0
            g[k + 1] += u1
            g[k + 2] += u2
        if not fill:
            continue
        t00, t01 = w * (I00 * c - I01 * s), w * (I00 * s + I01 * c)
        t10, t11 = w * (I01 * c - I11 * s), w * (I01 * s + I11 * c)
        M00, M01, M11 = c * t00 - s * t10, c * t01 - s * t11, s * t01 + c * t11
        M02, M12, M22 = w * (c * I02 - s * I12), w * (s * I02 + c * I12), w * I22
        n0 = dx * M01 - dy * M00 + M02
        n1 = dx * M11 - dy * M01 + M12
        n2 = dx * M12 - dy * M02 + M22
        if a >= 0:
            k, ld = variables[a]['address'], variables[a]['stride']
            v[k] += M00
            v[k + 1] += M01
            v[k + 2] += n0
            v[k + ld + 1] += M11
            v[k + ld + 2] += n1
            v[k + 2 * ld + 2] += dx * n1 - dy * n0 + n2
        if b >= 0:
            k, ld = variables[b]['address'], variables[b]['stride']
            v[k] += M00
            v[k + 1] += M01
            v[k + 2] += M02
            v[k + ld + 1] += M11
            v[k + ld + 2] += M12
            v[k + 2 * ld + 2] += M22
        k = z['block']
        if k < 0:
            continue
        # columns of i and rows of j hold H_ij^T, columns of j and rows of i hold H_ij
        l02, l12, l20, l21 = n0, n1, M02, M12
        ld = variables[b]['stride']
        if variables[a]['scalar'] < variables[b]['scalar']:
            l02, l12, l20, l21 = M02, M12, n0, n1
            ld = variables[a]['stride']
        v[k] -= M00
        v[k + 1] -= M01
        v[k + 2] -= l02
        v[k + ld] -= M01
        v[k + ld + 1] -= M11
        v[k + ld + 2] -= l12
        v[k + 2 * ld] -= l20
        v[k + 2 * ld + 1] -= l21
        v[k + 2 * ld + 2] -= n2
    return cost, chi2


@part
def _sightings(
    sightings: Records, variables: Records, losses: Array, poses: Array, rotations: Array,
    landmarks: Array, v: Array, g: Array, fill: bool,
) -> tuple[float, float]:  # fmt: skip
    cost, chi2 = 0.0, 0.0
    for f in range(len(sightings)):
        z = sightings[f]
        i, j, kind = z['i'], z['j'], z['kind']
        c, s = rotations[i, 0], rotations[i, 1]
        dx, dy = landmarks[j, 0] - poses[i, 0], landmarks[j, 1] - poses[i, 1]
        e0 = c * dx + s * dy - z['x']
        e1 = c * dy - s * dx - z['y']
        I00, I01, I11 = z['I00'], z['I01'], z['I11']
        q0, q1 = I00 * e0 + I01 * e1, I01 * e0 + I11 * e1
        squared = e0 * q0 + e1 * q1
        rho, w = loss(losses[kind, 0], losses[kind, 1], squared)
        cost += rho
        chi2 += squared
        u0, u1 = w * (c * q0 - s * q1), w * (s * q0 + c * q1)
        a, b = z['a'], z['b']
        if a >= 0:
            k = variables[a]['scalar']
            g[k] -= u0
            g[k + 1] -= u1
            g[k + 2] -= dx * u1 - dy * u0
        if b >= 0:
            k = variables[b]['scalar']
            g[k] += u0
            g[k + 1] += u1
        if not fill:
            continue
        t00, t01 = w * (I00 * c - I01 * s), w * (I00 * s + I01 * c)
        t10, t11 = w * (I01 * c - I11 * s), w * (I01 * s + I11 * c)
        M00, M01, M11 = c * t00 - s * t10, c * t01 - s * t11, s * t01 + c * t11
        n0, n1 = dx * M01 - dy * M00, dx * M11 - dy * M01
        if a >= 0:
            k, ld = variables[a]['address'], variables[a]['stride']
            v[k] += M00
            v[k + 1] += M01
            v[k + 2] += n0
            v[k + ld + 1] += M11
            v[k + ld + 2] += n1
            v[k + 2 * ld + 2] += dx * n1 - dy * n0
        if b >= 0:
            k, ld = variables[b]['address'], variables[b]['stride']
            v[k] += M00
            v[k + 1] += M01
            v[k + ld + 1] += M11
        k = z['block']
        if k < 0:
            continue
        if variables[a]['scalar'] < variables[b]['scalar']:  # columns of the pose
            ld = variables[a]['stride']
            row, column = ld, 2 * ld
        else:
            ld = variables[b]['stride']
            row, column = ld, 2
        v[k] -= M00
        v[k + 1] -= M01
        v[k + row] -= M01
        v[k + row + 1] -= M11
        # the row or column of theta
        v[k + column] -= n0
        v[k + column + (1 if column > 2 else ld)] -= n1
    return cost, chi2


@part
def _priors(
    priors: Records, variables: Records, losses: Array, poses: Array, landmarks: Array,
    v: Array, g: Array, fill: bool,
) -> tuple[float, float]:  # fmt: skip
    cost, chi2 = 0.0, 0.0
    for f in range(len(priors)):
        z = priors[f]
        i, a, kind = z['i'], z['a'], z['kind']
        is_pose = i < len(poses)
        if is_pose:
            e0, e1 = poses[i, 0] - z['x'], poses[i, 1] - z['y']
            e2 = wrapped(poses[i, 2] - z['theta'])
        else:
            k = i - len(poses)
            e0, e1, e2 = landmarks[k, 0] - z['x'], landmarks[k, 1] - z['y'], 0.0
        q0 = z['I00'] * e0 + z['I01'] * e1 + z['I02'] * e2
        q1 = z['I01'] * e0 + z['I11'] * e1 + z['I12'] * e2
        q2 = z['I02'] * e0 + z['I12'] * e1 + z['I22'] * e2
        squared = e0 * q0 + e1 * q1 + e2 * q2
        rho, w = loss(losses[kind, 0], losses[kind, 1], squared)
        cost += rho
        chi2 += squared
        if a < 0:
            continue
        k = variables[a]['scalar']
        g[k] += w * q0
        g[k + 1] += w * q1
        if is_pose:
            g[k + 2] += w * q2
        if fill:
            k, ld = variables[a]['address'], variables[a]['stride']
            v[k] += w * z['I00']
            v[k + 1] += w * z['I01']
            v[k + ld + 1] += w * z['I11']
            if is_pose:
                v[k + 2] += w * z['I02']
                v[k + ld + 2] += w * z['I12']
                v[k + 2 * ld + 2] += w * z['I22']
    return cost, chi2


@kernel
def move(variables: Records, step: Array, poses: Array, landmarks: Array) -> None:
    """Add ``step`` (in the order of elimination) to the free nodes; angles stay wrapped."""
    for a in range(len(variables)):
        i, k = variables[a]['node'], variables[a]['scalar']
        if i < len(poses):
            poses[i, 0] += step[k]
            poses[i, 1] += step[k + 1]
            poses[i, 2] = wrapped(poses[i, 2] + step[k + 2])
        else:
            landmarks[i - len(poses), 0] += step[k]
            landmarks[i - len(poses), 1] += step[k + 1]
