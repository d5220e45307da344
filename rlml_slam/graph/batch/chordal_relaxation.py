# SPDX-License-Identifier: Apache-2.0
"""Chordal relaxation: initial estimate from linear least squares alone.

With r = (cos, sin) of a pose's heading taken as any complex number, t its position and m a
landmark as complex numbers, the residuals

    edge       r_j - e^(i theta_delta) r_i   and   t_j - t_i - r_i t_delta
    sighting   m - t - r z
    range      m - t, of little weight; such landmarks are trilaterated in the end

are linear (Martinec & Pajdla 2007; Carlone, Tron, Daniilidis & Dellaert 2015). Weights are the
information of the angle and the mean information of the position, because the axes of the
residual are not known yet. Every block of the normal matrix is a complex number w conj(c_p) c_q,
so the same fronts serve with two rows per unknown. Without sightings the headings are solved
alone; with sightings all at once, because then the landmarks are what ties them together.
Positions follow with the headings back on the unit circle.

The influence of one fixed heading fades with the distance and the noise: relaxed headings get
shorter from edge to edge, by orders of magnitude in large or noisy graphs, and follow the few
edges on the way rather than all. So they are normalised to length 1 and solved for again, r <-
H^-1 (w r / |r| - g) with the same factor, which turns them towards the maximum of r^H H^-1 r among
those of length 1 (the generalised power method: Boumal 2016).
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.batch.landmark_start import place_by_ranges
from rlml_slam.graph.model.factors import relaxed
from rlml_slam.graph.model.packed_system import System, assign_addresses
from rlml_slam.graph.sparse.multifrontal import (
    factorise,
    layout_fronts,
    reuse_or_allocate,
    solve_lower,
    solve_upper,
)
from rlml_slam.graph.sparse.symbolic_analysis import Records
from rlml_slam.se2 import Array

# Relaxed headings get shorter from node to node, the more the noisier the edges are. Where one is
# shorter than SHORT, up to POWER_STEPS power iterations follow, until none turns by CONVERGED.
SHORT = 1e-4
POWER_STEPS = 10
CONVERGED = 0.01  # sum of the changes of cosine and sine; half a degree is less than edges' noise


@kernel
def relax(system: System, poses: Array, landmarks: Array) -> bool:
    """Overwrite the free nodes by the relaxed solution; False if it cannot be solved.

    The panels of the system serve as memory: it has to be linearised from_relaxed.
    """
    jointly = len(system.sightings) > 0
    return _relax(system, poses, landmarks, jointly, True, POWER_STEPS, SHORT)


@kernel
def relax_jointly(
    system: System, poses: Array, landmarks: Array, from_relaxed: bool, power_steps: int
) -> bool:
    """As relax, but headings together with positions, and always with ``power_steps``.

    These begin with the relaxed headings, or with the current ones.
    """
    return _relax(system, poses, landmarks, True, from_relaxed, power_steps, math.inf)


@part
def _relax(
    system: System, poses: Array, landmarks: Array, jointly: bool, from_relaxed: bool,
    power_steps: int, short: float,
) -> bool:  # fmt: skip
    n, variables = len(poses), system.variables
    units = np.empty((n, 2))
    for i in range(n):
        units[i, 0], units[i, 1] = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    good = _headings(system, poses, landmarks, units, jointly, from_relaxed, power_steps, short)
    if good:
        for a in range(len(variables)):
            i = variables[a]['node']
            if i < n:
                poses[i, 2] = math.atan2(units[i, 1], units[i, 0])
        good = _positions(system, poses, landmarks)
    place_by_ranges(system, poses, landmarks)
    assign_addresses(
        system.structure, system.fronts, system.entries, variables, system.edges, system.sightings
    )
    return good


@part
def _positions(system: System, poses: Array, landmarks: Array) -> bool:
    """Positions and landmarks with the headings held: one real unknown each for x and for y."""
    variables, edges, sightings = system.variables, system.edges, system.sightings
    n, num = len(poses), len(variables)
    dims = np.empty(num, np.int64)
    for a in range(num):
        dims[a] = 1
    fronts, entries, size = layout_fronts(system.structure, dims)
    assign_addresses(system.structure, fronts, entries, variables, edges, sightings)
    v = reuse_or_allocate(system.values, fronts[len(fronts) - 1]['panel'])
    for i in range(len(v)):
        v[i] = 0.0
    gx, gy = np.empty(num), np.empty(num)
    for i in range(num):
        gx[i] = gy[i] = 0.0
    for f in range(len(edges) + len(sightings)):
        if f < len(edges):
            z = edges[f]
            i, j, a, b, k = z['i'], z['j'], z['a'], z['b'], z['block']
            w, x, y = relaxed(z['kind'], z['I00'], z['I11'], z['x'], z['y'])
            angle = poses[i, 2] + z['theta']  # the record holds R_delta^T t_delta
            tx, ty = poses[j, 0], poses[j, 1]
        else:
            q = sightings[f - len(edges)]
            i, j, a, b, k = q['i'], q['j'], q['a'], q['b'], q['block']
            w, x, y = relaxed(q['kind'], q['I00'], q['I11'], q['x'], q['y'])
            angle = poses[i, 2]
            tx, ty = landmarks[j, 0], landmarks[j, 1]
        c, s = math.cos(angle), math.sin(angle)
        ex = w * (tx - poses[i, 0] - c * x + s * y)
        ey = w * (ty - poses[i, 1] - s * x - c * y)
        if a >= 0:
            gx[variables[a]['scalar']] -= ex
            gy[variables[a]['scalar']] -= ey
            v[variables[a]['address']] += w
        if b >= 0:
            gx[variables[b]['scalar']] += ex
            gy[variables[b]['scalar']] += ey
            v[variables[b]['address']] += w
        if k >= 0:
            v[k] -= w
    for f in range(len(system.priors)):
        p = system.priors[f]
        i, a = p['i'], p['a']
        if a >= 0:
            w = 0.5 * (p['I00'] + p['I11'])
            x, y = (poses[i, 0], poses[i, 1]) if i < n else (
                landmarks[i - n, 0], landmarks[i - n, 1])  # fmt: skip
            gx[variables[a]['scalar']] += w * (x - p['x'])
            gy[variables[a]['scalar']] += w * (y - p['y'])
            v[variables[a]['address']] += w
    left, right = reuse_or_allocate(system.left, size[0]), reuse_or_allocate(system.right, size[1])
    if factorise(fronts, entries, v, left, right, gx) >= 0:
        return False
    solve_lower(fronts, entries, v, gy)
    solve_upper(fronts, entries, v, gx)
    solve_upper(fronts, entries, v, gy)
    for a in range(num):
        i, k = variables[a]['node'], variables[a]['scalar']
        if i < n:
            poses[i, 0] -= gx[k]
            poses[i, 1] -= gy[k]
        else:
            landmarks[i - n, 0] -= gx[k]
            landmarks[i - n, 1] -= gy[k]
    return True


@part
def _headings(
    system: System, poses: Array, landmarks: Array, units: Array, jointly: bool,
    from_relaxed: bool, power_steps: int, short: float,
) -> bool:  # fmt: skip
    """Solve for the directions ``units`` (n, 2); with ``jointly`` together with the positions."""
    variables, edges, sightings = system.variables, system.edges, system.sightings
    n, num = len(poses), len(variables)
    state, points = np.empty((n, 4)), landmarks.copy()  # r and t
    for i in range(n):
        state[i, 0], state[i, 1] = units[i, 0], units[i, 1]
        state[i, 2], state[i, 3] = poses[i, 0], poses[i, 1]
    dims = np.empty(num, np.int64)
    rows = 0
    for a in range(num):
        i = variables[a]['node']
        dims[a] = (2 if i < n else 0) + (2 if jointly else 0)
        rows += dims[a]
        # from 0 on, so that g is the pull of the fixed nodes and the priors alone, and headings
        # that get ever shorter keep their digits
        if i < n:
            state[i, 0] = state[i, 1] = state[i, 2] = state[i, 3] = 0.0
        else:
            points[i - n, 0] = points[i - n, 1] = 0.0
    fronts, entries, size = layout_fronts(system.structure, dims)
    assign_addresses(system.structure, fronts, entries, variables, edges, sightings)
    values = reuse_or_allocate(system.values, fronts[len(fronts) - 1]['panel'])
    for i in range(len(values)):
        values[i] = 0.0
    g, x = np.empty(rows), np.empty(rows)
    for i in range(rows):
        g[i] = 0.0
    _edges(edges, variables, state, values, g, jointly)
    if jointly:
        _sightings(sightings, variables, state, points, values, g)
    _priors(system.priors, variables, state, points, values, g, jointly)
    weight = 0.0  # of the current direction in a power iteration: the mean of the diagonal
    for a in range(num):
        if variables[a]['node'] < n:
            weight += values[variables[a]['address']] / num
    for i in range(rows):
        x[i] = -g[i]
    left, right = reuse_or_allocate(system.left, size[0]), reuse_or_allocate(system.right, size[1])
    if factorise(fronts, entries, values, left, right, x) >= 0:
        return False
    solve_upper(fronts, entries, values, x)
    if from_relaxed and _directions(variables, x, units)[0] > short:
        return True
    for _ in range(power_steps):
        for i in range(rows):
            x[i] = -g[i]
        for a in range(num):
            i, k = variables[a]['node'], variables[a]['scalar']
            if i < n:
                x[k] += weight * units[i, 0]
                x[k + 1] += weight * units[i, 1]
        solve_lower(fronts, entries, values, x)
        solve_upper(fronts, entries, values, x)
        if _directions(variables, x, units)[1] < CONVERGED:
            break
    return True


@part
def _directions(variables: Records, x: Array, units: Array) -> tuple[float, float]:
    """Take the directions of the headings in x; the shortest of these, the largest change."""
    shortest, change = math.inf, 0.0
    for a in range(len(variables)):
        i, k = variables[a]['node'], variables[a]['scalar']
        if i >= len(units):
            continue
        length = math.hypot(x[k], x[k + 1])
        shortest = min(shortest, length)
        if length > 0.0:
            re, im = x[k] / length, x[k + 1] / length
            change = max(change, abs(re - units[i, 0]) + abs(im - units[i, 1]))
            units[i, 0], units[i, 1] = re, im
    return shortest, change


@part
def _add(v: Array, k: int, ld: int, re: float, im: float) -> None:
    """Add a complex number to a 2 by 2 block."""
    v[k] += re
    v[k + 1] += im
    v[k + ld] -= im
    v[k + ld + 1] += re


@part
def _edges(
    edges: Records, variables: Records, state: Array, v: Array, g: Array, jointly: bool
) -> None:
    for f in range(len(edges)):
        z = edges[f]
        i, j, a, b = z['i'], z['j'], z['a'], z['b']
        block = z['block']
        ga, ka, la = 0, 0, 0
        gb, kb, lb = 0, 0, 0
        if a >= 0:
            ga, ka, la = variables[a]['scalar'], variables[a]['address'], variables[a]['stride']
        if b >= 0:
            gb, kb, lb = variables[b]['scalar'], variables[b]['address'], variables[b]['stride']
        first = ga < gb  # the columns are those of a
        ld = la if first else lb
        w, c, s = z['I22'], z['c'], z['s']
        e0 = w * (state[j, 0] - c * state[i, 0] + s * state[i, 1])
        e1 = w * (state[j, 1] - s * state[i, 0] - c * state[i, 1])
        if a >= 0:
            g[ga] -= c * e0 + s * e1
            g[ga + 1] -= c * e1 - s * e0
            _add(v, ka, la, w, 0.0)
        if b >= 0:
            g[gb] += e0
            g[gb + 1] += e1
            _add(v, kb, lb, w, 0.0)
        if block >= 0:
            _add(v, block, ld, -w * c, -w * s if first else w * s)
        if not jointly:
            continue
        w = 0.5 * (z['I00'] + z['I11'])
        # the record holds R_delta^T t_delta
        dx, dy = c * z['x'] - s * z['y'], s * z['x'] + c * z['y']
        e0 = w * (state[j, 2] - state[i, 2] - dx * state[i, 0] + dy * state[i, 1])
        e1 = w * (state[j, 3] - state[i, 3] - dy * state[i, 0] - dx * state[i, 1])
        if a >= 0:
            g[ga] -= dx * e0 + dy * e1
            g[ga + 1] -= dx * e1 - dy * e0
            g[ga + 2] -= e0
            g[ga + 3] -= e1
            _add(v, ka, la, w * (dx * dx + dy * dy), 0.0)
            _add(v, ka + 2, la, w * dx, w * dy)
            _add(v, ka + 2 * la + 2, la, w, 0.0)
        if b >= 0:
            g[gb + 2] += e0
            g[gb + 3] += e1
            _add(v, kb + 2 * lb + 2, lb, w, 0.0)
        if block >= 0:
            _add(v, block + 2 * ld + 2, ld, -w, 0.0)
            if first:
                _add(v, block + 2, ld, -w * dx, -w * dy)
            else:
                _add(v, block + 2 * ld, ld, -w * dx, w * dy)


@part
def _sightings(
    sightings: Records, variables: Records, state: Array, landmarks: Array, v: Array, g: Array
) -> None:
    for f in range(len(sightings)):
        z = sightings[f]
        i, j, a, b = z['i'], z['j'], z['a'], z['b']
        w, x, y = relaxed(z['kind'], z['I00'], z['I11'], z['x'], z['y'])
        e0 = w * (landmarks[j, 0] - state[i, 2] - x * state[i, 0] + y * state[i, 1])
        e1 = w * (landmarks[j, 1] - state[i, 3] - y * state[i, 0] - x * state[i, 1])
        ga, gb, ld = 0, 0, 0
        if b >= 0:
            gb, ld = variables[b]['scalar'], variables[b]['stride']
            g[gb] += e0
            g[gb + 1] += e1
            _add(v, variables[b]['address'], ld, w, 0.0)
        if a >= 0:
            ga, k, la = variables[a]['scalar'], variables[a]['address'], variables[a]['stride']
            g[ga] -= x * e0 + y * e1
            g[ga + 1] -= x * e1 - y * e0
            g[ga + 2] -= e0
            g[ga + 3] -= e1
            _add(v, k, la, w * (x * x + y * y), 0.0)
            _add(v, k + 2, la, w * x, w * y)
            _add(v, k + 2 * la + 2, la, w, 0.0)
            if ga < gb:
                ld = la
        k = z['block']
        if k >= 0 and ga < gb:  # rows of the landmark, columns of the pose
            _add(v, k, ld, -w * x, -w * y)
            _add(v, k + 2 * ld, ld, -w, 0.0)
        elif k >= 0:
            _add(v, k, ld, -w * x, w * y)
            _add(v, k + 2, ld, -w, 0.0)


@part
def _priors(
    priors: Records, variables: Records, state: Array, landmarks: Array, v: Array, g: Array,
    jointly: bool,
) -> None:  # fmt: skip
    n = len(state)
    for f in range(len(priors)):
        z = priors[f]
        i, a = z['i'], z['a']
        if a < 0:
            continue
        k, ld, gk = variables[a]['address'], variables[a]['stride'], variables[a]['scalar']
        x, y = 0.0, 0.0
        if i < n:
            w = z['I22']
            g[gk] += w * (state[i, 0] - math.cos(z['theta']))
            g[gk + 1] += w * (state[i, 1] - math.sin(z['theta']))
            _add(v, k, ld, w, 0.0)
            k += 2 * ld + 2
            gk += 2
            x, y = state[i, 2], state[i, 3]
        else:
            x, y = landmarks[i - n, 0], landmarks[i - n, 1]
        if jointly:
            w = 0.5 * (z['I00'] + z['I11'])
            g[gk] += w * (x - z['x'])
            g[gk + 1] += w * (y - z['y'])
            _add(v, k, ld, w, 0.0)
