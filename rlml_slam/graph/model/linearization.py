# SPDX-License-Identifier: Apache-2.0
"""Compiled linearization: factors scattered straight into the panels of the fronts.

With the axes R of a factor and d = t_j - t_i (factors.py), M = J_j^T W J_j and u = J_j^T W e, and
J_i = -J_j A, the blocks of H = J^T W J and of g = J^T W e are

    H_jj = M, H_ij = -A^T M, H_ii = A^T M A, g_j = u, g_i = -A^T u.

Robust losses weigh W by d rho / d s (iteratively reweighted least squares).
"""

from __future__ import annotations

import math

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.model.factors import (
    Information,
    axes,
    moment,
    position_information,
    residual,
    rotate,
    weighted,
)
from rlml_slam.graph.model.packed_system import System
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.graph.sparse.symbolic_analysis import Records
from rlml_slam.se2 import Array, wrapped_by_turns


@kernel
def linearize(system: System, poses: Array, landmarks: Array, fill: bool) -> tuple[float, float]:
    """(cost, chi2) at an estimate, with the gradient g = J^T W e; with ``fill`` also H."""
    rotations = system.rotations
    for i in range(len(poses)):
        angle = poses[i, 2]
        rotations[i, 0], rotations[i, 1] = math.cos(angle), math.sin(angle)
    return linearize_again(system, poses, landmarks, fill)


@part
def linearize_again(
    system: System, poses: Array, landmarks: Array, fill: bool
) -> tuple[float, float]:
    """As linearize, at the estimate of its last call: the rotations are those."""
    g, values = system.g, system.values
    fill = bool(fill)  # not of a literal's type, for which all below would be compiled again
    for i in range(len(g)):
        g[i] = 0.0
    if fill:
        for i in range(len(values)):
            values[i] = 0.0
    c0, s0 = _edges(system, poses, values, g, fill)
    c1, s1 = _sightings(system, poses, landmarks, values, g, fill)
    c2, s2 = _priors(system, poses, landmarks, values, g, fill)
    return c0 + c1 + c2, s0 + s1 + s2


@part
def _edges(system: System, poses: Array, v: Array, g: Array, fill: bool) -> tuple[float, float]:
    """Relative poses: (cost, chi2); 3 by 3 blocks."""
    edges, variables = system.edges, system.variables
    losses, rotations = system.losses, system.rotations
    cost, chi2 = 0.0, 0.0
    for f in range(len(edges)):
        z = edges[f]
        i, j, kind = z['i'], z['j'], z['kind']
        c, s = rotate(z['c'], z['s'], rotations[i, 0], rotations[i, 1])
        dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        e0, e1 = residual(c, s, dx, dy, z['x'], z['y'])
        e2 = wrapped_by_turns(poses[j, 2] - poses[i, 2] - z['theta'])
        W = Information(z['I00'], z['I01'], z['I02'], z['I11'], z['I12'], z['I22'])
        q0, q1, q2 = weighted(W, e0, e1, e2)
        squared = e0 * q0 + e1 * q1 + e2 * q2
        rho, w = loss(losses[kind, 0], losses[kind, 1], squared)
        cost += rho
        chi2 += squared
        u0, u1 = rotate(c, s, q0, q1)
        u0, u1, u2 = w * u0, w * u1, w * q2
        a, b = z['a'], z['b']
        if a >= 0:
            k = variables[a]['scalar']
            g[k] -= u0
            g[k + 1] -= u1
            g[k + 2] -= moment(dx, dy, u0, u1) + u2
        if b >= 0:
            k = variables[b]['scalar']
            g[k] += u0
            g[k + 1] += u1
            g[k + 2] += u2
        if not fill:
            continue
        M00, M01, M11 = position_information(W, w, c, s)
        M02, M12 = rotate(c, s, W.I02, W.I12)
        M02, M12, M22 = w * M02, w * M12, w * W.I22
        n0 = moment(dx, dy, M00, M01) + M02
        n1 = moment(dx, dy, M01, M11) + M12
        n2 = moment(dx, dy, M02, M12) + M22
        if a >= 0:
            k, ld = variables[a]['address'], variables[a]['stride']
            v[k] += M00
            v[k + 1] += M01
            v[k + 2] += n0
            v[k + ld + 1] += M11
            v[k + ld + 2] += n1
            v[k + 2 * ld + 2] += moment(dx, dy, n0, n1) + n2
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
    system: System, poses: Array, landmarks: Array, v: Array, g: Array, fill: bool
) -> tuple[float, float]:
    """Landmarks from poses, sighted or heard at a range: (cost, chi2); 3 by 2 blocks."""
    sightings, variables = system.sightings, system.variables
    losses, rotations = system.losses, system.rotations
    cost, chi2 = 0.0, 0.0
    for f in range(len(sightings)):
        z = sightings[f]
        i, j, kind = z['i'], z['j'], z['kind']
        dx, dy = landmarks[j, 0] - poses[i, 0], landmarks[j, 1] - poses[i, 1]
        c, s = axes(kind, rotations[i, 0], rotations[i, 1], dx, dy)
        e0, e1 = residual(c, s, dx, dy, z['x'], z['y'])
        W = Information(z['I00'], z['I01'], 0.0, z['I11'], 0.0, 0.0)
        q0, q1, _ = weighted(W, e0, e1, 0.0)
        squared = e0 * q0 + e1 * q1
        rho, w = loss(losses[kind, 0], losses[kind, 1], squared)
        cost += rho
        chi2 += squared
        u0, u1 = rotate(c, s, q0, q1)
        u0, u1 = w * u0, w * u1
        a, b = z['a'], z['b']
        if a >= 0:
            k = variables[a]['scalar']
            g[k] -= u0
            g[k + 1] -= u1
            g[k + 2] -= moment(dx, dy, u0, u1)
        if b >= 0:
            k = variables[b]['scalar']
            g[k] += u0
            g[k + 1] += u1
        if not fill:
            continue
        M00, M01, M11 = position_information(W, w, c, s)
        n0, n1 = moment(dx, dy, M00, M01), moment(dx, dy, M01, M11)
        if a >= 0:
            k, ld = variables[a]['address'], variables[a]['stride']
            v[k] += M00
            v[k + 1] += M01
            v[k + 2] += n0
            v[k + ld + 1] += M11
            v[k + ld + 2] += n1
            v[k + 2 * ld + 2] += moment(dx, dy, n0, n1)
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
    system: System, poses: Array, landmarks: Array, v: Array, g: Array, fill: bool
) -> tuple[float, float]:
    """Values of nodes in the axes of the map: (cost, chi2); H_jj = W."""
    priors, variables, losses = system.priors, system.variables, system.losses
    cost, chi2 = 0.0, 0.0
    for f in range(len(priors)):
        z = priors[f]
        i, a, kind = z['i'], z['a'], z['kind']
        is_pose = i < len(poses)
        if is_pose:
            e0, e1 = residual(1.0, 0.0, poses[i, 0], poses[i, 1], z['x'], z['y'])
            e2 = wrapped_by_turns(poses[i, 2] - z['theta'])
        else:
            k = i - len(poses)
            e0, e1 = residual(1.0, 0.0, landmarks[k, 0], landmarks[k, 1], z['x'], z['y'])
            e2 = 0.0
        W = Information(z['I00'], z['I01'], z['I02'], z['I11'], z['I12'], z['I22'])
        q0, q1, q2 = weighted(W, e0, e1, e2)
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
            v[k] += w * W.I00
            v[k + 1] += w * W.I01
            v[k + ld + 1] += w * W.I11
            if is_pose:
                v[k + 2] += w * W.I02
                v[k + ld + 2] += w * W.I12
                v[k + 2 * ld + 2] += w * W.I22
    return cost, chi2


@kernel
def apply_step(variables: Records, step: Array, poses: Array, landmarks: Array) -> None:
    """Add ``step`` (in the order of elimination) to the free nodes; angles stay wrapped."""
    for a in range(len(variables)):
        i, k = variables[a]['node'], variables[a]['scalar']
        if i < len(poses):
            poses[i, 0] += step[k]
            poses[i, 1] += step[k + 1]
            poses[i, 2] = wrapped_by_turns(poses[i, 2] + step[k + 2])
        else:
            landmarks[i - len(poses), 0] += step[k]
            landmarks[i - len(poses), 1] += step[k + 1]
