# SPDX-License-Identifier: Apache-2.0
"""Normal equations H dx = -g in memory: variables, packed factors and the addresses they add to.

One record per enabled factor holds all that its linearisation reads, so that the inner loop
walks through memory in order; the measured rotation is turned into sine and cosine once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel, part
from rlml_slam.graph.model.factors import rotate_back
from rlml_slam.graph.sparse.elimination_order import elimination_order
from rlml_slam.graph.sparse.multifrontal import layout_fronts, reuse_or_allocate
from rlml_slam.graph.sparse.symbolic_analysis import (
    Ints,
    Records,
    Structure,
    adjacency,
    elimination_tree,
    supernodes,
)
from rlml_slam.se2 import Array

Flags = NDArray[np.bool_]

# A pose or landmark that is solved for: its ``node`` (landmark k is n + k), number of rows
# (``size``), first row in the system (``scalar``), and ``address`` and column ``stride`` of its
# diagonal block in the values.
VARIABLE = np.dtype([(k, np.int64) for k in ('node', 'size', 'scalar', 'address', 'stride')])

# Nodes i and j, their variables a and b (-1: not solved for), the address of the off-diagonal
# block, in the columns of the variable that is eliminated first (-1: none), the kind of factor.
LINK = [(k, np.int64) for k in ('i', 'j', 'a', 'b', 'block', 'kind')]

# Edge: cosine and sine of theta_delta, R_delta^T t_delta, theta_delta, information.
EDGE = np.dtype(
    LINK
    + [(k, np.float64) for k in ('c', 's', 'x', 'y', 'theta')]
    + [(k, np.float64) for k in ('I00', 'I01', 'I02', 'I11', 'I12', 'I22')]
)
# Landmark seen from a pose (sighting or range): z and information.
SIGHTING = np.dtype(LINK + [(k, np.float64) for k in ('x', 'y', 'I00', 'I01', 'I11')])
# Prior on node i (landmark k is n + k): value and information; a landmark's last ones are zero.
PRIOR = np.dtype(
    [(k, np.int64) for k in ('i', 'a', 'kind')]
    + [(k, np.float64) for k in ('x', 'y', 'theta')]
    + [(k, np.float64) for k in ('I00', 'I01', 'I02', 'I11', 'I12', 'I22')]
)


class Factors(NamedTuple):
    """One table of the graph: nodes (k, a), measured (k, d), information (k, d, d), kinds, on."""

    nodes: Ints
    measured: Array
    information: Array
    kinds: Ints
    enabled: Flags


class Tables(NamedTuple):
    """The graph: flags of the fixed nodes, the factors, and (kind, scale) of each loss (7, 2)."""

    fixed_poses: Flags
    fixed_landmarks: Flags
    edges: Factors
    sightings: Factors
    pose_priors: Factors
    landmark_priors: Factors
    losses: Array


class System(NamedTuple):
    """Variables, packed factors, symbolic structure and memory of the normal equations.

    ``values`` holds the panels, ``left`` and ``right`` the update matrices, ``g`` and ``step``
    (rows,) a gradient and a step in the order of elimination, ``rotations`` (n, 2) the cosine and
    sine of each pose's heading where it was linearised last.
    """

    variables: Records
    edges: Records
    sightings: Records
    priors: Records
    losses: Array
    structure: Structure
    fronts: Records
    entries: Records
    values: Array
    left: Array
    right: Array
    g: Array
    step: Array
    rotations: Array


@kernel
def pack_system(tables: Tables, memory: Array) -> tuple[int, System]:
    """(-1, system) of a graph; or (node, ...), a node that nothing anchors to the map.

    ``memory`` is where the panels and update matrices go if it holds them.

    Solved for are the nodes that are not fixed and that an enabled factor touches. A connected
    part is anchored to the map by a fixed pose, a pose prior, or two landmarks that are fixed or
    have priors (one, if the part has no poses). Landmark k is node n + k.
    """
    edges, sightings, priors = _pack(tables)
    n = len(tables.fixed_poses)
    total = n + len(tables.fixed_landmarks)
    touched = _touched(total, n, edges, sightings, priors)
    index = np.empty(total, np.int64)
    num = 0
    for i in range(total):
        fixed = tables.fixed_poses[i] if i < n else tables.fixed_landmarks[i - n]
        index[i] = -1
        if touched[i] and not fixed:
            index[i] = num
            num += 1
    variables = np.empty(num, VARIABLE)
    dims = np.empty(num, np.int64)
    for i in range(total):
        if index[i] >= 0:
            variables[index[i]]['node'] = i
            variables[index[i]]['size'] = dims[index[i]] = 3 if i < n else 2
    pairs = np.empty((len(edges) + len(sightings), 2), np.int64)
    for f in range(len(edges)):
        pairs[f, 0] = edges[f]['a'] = index[edges[f]['i']]
        pairs[f, 1] = edges[f]['b'] = index[edges[f]['j']]
    for f in range(len(sightings)):
        k = len(edges) + f
        pairs[k, 0] = sightings[f]['a'] = index[sightings[f]['i']]
        pairs[k, 1] = sightings[f]['b'] = index[n + sightings[f]['j']]
    for f in range(len(priors)):
        priors[f]['a'] = index[priors[f]['i']]
    start, neighbours = adjacency(pairs, num)
    order = elimination_order(start, neighbours, dims)
    order, parent, count = elimination_tree(start, neighbours, order)
    unanchored = _unanchored_node(n, variables, edges, sightings, priors, order, parent)
    structure = supernodes(start, neighbours, order, parent, count, pairs, dims, 3 * num)
    fronts, entries, stack = layout_fronts(structure, dims)
    assign_addresses(structure, fronts, entries, variables, edges, sightings)
    rows = 0
    for a in range(num):
        rows += dims[a]
    size = fronts[len(fronts) - 1]['panel']
    memory = reuse_or_allocate(memory, size + stack[0] + stack[1])
    values, left = memory[:size], memory[size : size + stack[0]]
    right = memory[size + stack[0] : size + stack[0] + stack[1]]
    return unanchored, System(
        variables, edges, sightings, priors, tables.losses, structure, fronts, entries,
        values, left, right, np.empty(rows), np.empty(rows), np.empty((n, 2)),
    )  # fmt: skip


@part
def assign_addresses(
    structure: Structure, fronts: Records, entries: Records, variables: Records, edges: Records,
    sightings: Records,
) -> None:  # fmt: skip
    """Write the addresses of all blocks into the variables and the factors."""
    position, owner, entry = structure.position, structure.owner, structure.entry
    for a in range(len(variables)):
        k = position[a]
        s = owner[k]
        p = fronts[s]['start'] + k - fronts[s]['first']
        local, height = entries[p]['local'], fronts[s]['height']
        variables[a]['scalar'] = entries[p]['scalar']
        variables[a]['address'] = fronts[s]['panel'] + local * height + local
        variables[a]['stride'] = height
    for f in range(len(edges)):
        a, b = edges[f]['a'], edges[f]['b']
        edges[f]['block'] = -1
        if a >= 0 and b >= 0:
            edges[f]['block'] = _block(position, owner, fronts, entries, a, b, entry[f])
    for f in range(len(sightings)):
        a, b = sightings[f]['a'], sightings[f]['b']
        sightings[f]['block'] = -1
        if a >= 0 and b >= 0:
            e = entry[len(edges) + f]
            sightings[f]['block'] = _block(position, owner, fronts, entries, a, b, e)


@part
def _block(
    position: Ints, owner: Ints, fronts: Records, entries: Records, a: int, b: int, e: int
) -> int:
    """Address of the block of variables a and b, entry e of the front of the earlier one."""
    k = min(position[a], position[b])
    s = owner[k]
    start = fronts[s]['start']
    column = entries[start + k - fronts[s]['first']]['local']
    address: int = fronts[s]['panel'] + column * fronts[s]['height'] + entries[start + e]['local']
    return address


@part
def _count(enabled: Flags) -> int:
    num = 0
    for f in range(len(enabled)):
        if enabled[f]:
            num += 1
    return num


@part
def _pack(tables: Tables) -> tuple[Records, Records, Records]:
    """Records of the enabled factors, without variables and addresses."""
    nodes, measured, info = tables.edges.nodes, tables.edges.measured, tables.edges.information
    kinds, enabled = tables.edges.kinds, tables.edges.enabled
    edges = np.empty(_count(enabled), EDGE)
    w = 0
    for f in range(len(nodes)):
        if not enabled[f]:
            continue
        e = edges[w]
        e['i'], e['j'], e['kind'] = nodes[f, 0], nodes[f, 1], kinds[f]
        x, y, theta = measured[f, 0], measured[f, 1], measured[f, 2]
        c, s = math.cos(theta), math.sin(theta)
        e['c'], e['s'], e['theta'] = c, s, theta
        e['x'], e['y'] = rotate_back(c, s, x, y)
        e['I00'], e['I01'], e['I02'] = info[f, 0, 0], info[f, 0, 1], info[f, 0, 2]
        e['I11'], e['I12'], e['I22'] = info[f, 1, 1], info[f, 1, 2], info[f, 2, 2]
        w += 1
    nodes, measured = tables.sightings.nodes, tables.sightings.measured
    info, kinds = tables.sightings.information, tables.sightings.kinds
    enabled = tables.sightings.enabled
    sightings = np.empty(_count(enabled), SIGHTING)
    w = 0
    for f in range(len(nodes)):
        if not enabled[f]:
            continue
        z = sightings[w]
        z['i'], z['j'], z['kind'] = nodes[f, 0], nodes[f, 1], kinds[f]
        z['x'], z['y'] = measured[f, 0], measured[f, 1]
        z['I00'], z['I01'], z['I11'] = info[f, 0, 0], info[f, 0, 1], info[f, 1, 1]
        w += 1
    on_poses = _count(tables.pose_priors.enabled)
    priors = np.empty(on_poses + _count(tables.landmark_priors.enabled), PRIOR)
    _pack_priors(tables.pose_priors, 0, priors[:on_poses])
    _pack_priors(tables.landmark_priors, len(tables.fixed_poses), priors[on_poses:])
    return edges, sightings, priors


@part
def _pack_priors(factors: Factors, shift: int, priors: Records) -> None:
    w = 0
    size = factors.measured.shape[1]
    for f in range(len(factors.nodes)):
        if not factors.enabled[f]:
            continue
        z = priors[w]
        z['i'], z['kind'] = shift + factors.nodes[f, 0], factors.kinds[f]
        z['x'], z['y'] = factors.measured[f, 0], factors.measured[f, 1]
        info = factors.information[f]
        z['I00'], z['I01'], z['I11'] = info[0, 0], info[0, 1], info[1, 1]
        z['theta'] = z['I02'] = z['I12'] = z['I22'] = 0.0
        if size == 3:
            z['theta'] = factors.measured[f, 2]
            z['I02'], z['I12'], z['I22'] = info[0, 2], info[1, 2], info[2, 2]
        w += 1


@part
def _touched(total: int, n: int, edges: Records, sightings: Records, priors: Records) -> Flags:
    """Which nodes a factor touches (total,); landmark k is node n + k."""
    touched = np.empty(total, np.bool_)
    for i in range(total):
        touched[i] = False
    for f in range(len(edges)):
        touched[edges[f]['i']] = touched[edges[f]['j']] = True
    for f in range(len(sightings)):
        touched[sightings[f]['i']] = touched[n + sightings[f]['j']] = True
    for f in range(len(priors)):
        touched[priors[f]['i']] = True
    return touched


@part
def _unanchored_node(
    n: int, variables: Records, edges: Records, sightings: Records, priors: Records, order: Ints,
    parent: Ints,
) -> int:  # fmt: skip
    """A node that is solved for and whose connected part is not anchored to the map, or -1.

    The parts are the trees of the elimination forest.
    """
    num = len(variables)
    root, of = np.empty(num, np.int64), np.empty(num, np.int64)
    # per part: 1 anchored by the landmark ``known``, 2 by a pose or by two landmarks
    anchors, known = np.empty(num, np.int64), np.empty(num, np.int64)
    has_pose = np.empty(num, np.bool_)
    for k in range(num - 1, -1, -1):
        root[k] = root[parent[k]] if parent[k] >= 0 else k
        of[order[k]] = root[k]
        anchors[k], known[k], has_pose[k] = 0, -1, False
    for a in range(num):
        if variables[a]['node'] < n:
            has_pose[of[a]] = True
    for f in range(len(edges)):
        a, b = edges[f]['a'], edges[f]['b']
        if a < 0 and b >= 0:
            anchors[of[b]] = 2
        elif b < 0 and a >= 0:
            anchors[of[a]] = 2
    for f in range(len(sightings)):
        a, b = sightings[f]['a'], sightings[f]['b']
        if a < 0 and b >= 0:
            anchors[of[b]] = 2
        elif b < 0 and a >= 0:
            _anchor(anchors, known, of[a], n + sightings[f]['j'])
    for f in range(len(priors)):
        z, i, a = priors[f], priors[f]['i'], priors[f]['a']
        if a >= 0 and i < n and z['I00'] > 0.0 and z['I11'] > 0.0 and z['I22'] > 0.0:
            anchors[of[a]] = 2
        elif a >= 0 and i >= n:
            _anchor(anchors, known, of[a], i)
    for a in range(num):
        if anchors[of[a]] < (2 if has_pose[of[a]] else 1):
            return int(variables[a]['node'])
    return -1


@part
def _anchor(anchors: Ints, known: Ints, s: int, landmark: int) -> None:
    """Note an anchor of part s: a landmark whose position is known counts 1, a second one 2."""
    if anchors[s] == 0:
        anchors[s], known[s] = 1, landmark
    elif known[s] != landmark:
        anchors[s] = 2
