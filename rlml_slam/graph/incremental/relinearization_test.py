# SPDX-License-Identifier: Apache-2.0
"""Which factors of the incremental solver have to be linearised anew.

With phi and eta what theta_i and t_j - t_i have moved by since a factor was linearised,
p = R^T eta and q = R^T (t_j - t_i), the residual differs from its linear model by

    r = (R(phi)^T - 1) q + phi K (q - p),   K = [0 -1; 1 0],

of second order and nothing where only positions moved; and its Jacobian has turned by phi. A
factor is relinearised when r, or what the change of its robust weight amounts to, is a
considerable share of its standard deviation, or when phi or that change as a share of it is.

With e the residual then and e' now, r = phi K (e - e') - (R(phi) - 1 - phi K) (e' + z): at most
phi times what the residual has changed by, and half phi^2 times its arm.
"""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.compiled import fetch, part
from rlml_slam.graph.incremental.solver_state import (
    LANDMARK_PRIORS,
    LINE,
    LISTED,
    SIGHTINGS,
    STEP,
    State,
)
from rlml_slam.graph.model.linearization import wrapped
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array

# what factors are stretched by at most, in sigmas
USUAL = 4.0
# the share of the limits above which a factor is relinearised with others
NEAR = 1.0 / 3.0


@part
def calm(z: np.void, losses: Array, due: float, turn: float) -> float:
    """Turn of its pose up to which a factor is well modelled [rad], below zero for none.

    That is phi (USUAL + phi arm / 2) < NEAR due, with its arm in sigmas.
    """
    if is_robust(losses):
        return -1.0
    arm = math.sqrt((z['I00'] + z['I11']) * (z['dx'] * z['dx'] + z['dy'] * z['dy']))
    near = NEAR * due
    phi = 2.0 * near / (USUAL + math.sqrt(USUAL * USUAL + 2.0 * arm * near))
    return min(phi, NEAR * turn)


@part
def is_robust(losses: Array) -> bool:
    """Whether any kind of factors has a loss that is not the square."""
    robust = False
    for k in range(len(losses)):
        robust = robust or losses[k, 0] != 0
    return robust


@part
def narrow(u: np.void, z: np.void) -> None:
    """Bound the headings at which pose u needs no closer look by those of factor z from it."""
    u['low'] = max(u['low'], z['from'] - z['calm'])
    u['high'] = min(u['high'], z['from'] + z['calm'])


@part
def squared(z: np.void, e0: float, e1: float, e2: float) -> float:
    """e^T I e of a residual of factor z."""
    q0 = z['I00'] * e0 + z['I01'] * e1 + z['I02'] * e2
    q1 = z['I01'] * e0 + z['I11'] * e1 + z['I12'] * e2
    q2 = z['I02'] * e0 + z['I12'] * e1 + z['I22'] * e2
    total: float = e0 * q0 + e1 * q1 + e2 * q2
    return total


@part
def is_restless(u: np.void) -> bool:
    """Whether an unknown that moved has to be judged.

    Without robust losses a factor's linear model depends on the heading that it is from, and on
    little else as long as the factors are stretched by some sigmas at most.
    """
    theta = u['theta'] + u['dtheta']
    return not u['low'] < theta < u['high']


@part
def judge(
    state: State, restless: Ints, losses: Array, poses: Array, landmarks: Array, due: float,
    turn: float,
) -> None:  # fmt: skip
    """List the factors of the unknowns ``restless`` that have to be relinearised.

    That is nothing unless a linear model is off by ``due`` sigmas or a pose has turned by
    ``turn``; then it is all that are a third as far: forces of factors that were linearised at
    different headings do not balance, so what turned together is relinearised together.
    """
    counts = state.counts
    robust = is_robust(losses)
    worst = 0.0
    for n in range(len(restless)):
        u = state.unknowns[restless[n]]
        # the factors of one a little further on are on their way meanwhile
        soon = state.unknowns[restless[min(n + 4, len(restless) - 1)]]['head'] // 2
        fetch(state.factors, soon, 0)
        fetch(state.factors, soon, LINE)
        theta = u['theta'] + u['dtheta']
        u['low'], u['high'] = -np.inf, np.inf
        link = u['head']
        while link >= 0:
            f, end = link // 2, link % 2
            z = state.factors[f]
            link = z['next_a'] if end == 0 else z['next_b']
            if not robust and end == 1:  # and so are those that follow
                break
            if end == 0:
                narrow(u, z)
                if abs(theta - z['from']) < z['calm']:
                    continue
            if z['checked'] == counts[STEP]:
                continue
            z['checked'] = counts[STEP]
            error = _error(z, robust, losses, poses, landmarks, due, turn)
            if error > NEAR * NEAR:
                worst = max(worst, error)
                state.due[counts[LISTED]] = f
                counts[LISTED] += 1
    if worst < 1.0:
        counts[LISTED] = 0


@part
def _error(
    z: np.void, robust: bool, losses: Array, poses: Array, landmarks: Array, due: float,
    turn: float,
) -> float:  # fmt: skip
    """Squared error of a factor's linear model, 1 where it is due."""
    i, j, kind = z['i'], z['j'], z['kind']
    on_landmark = z['table'] in (SIGHTINGS, LANDMARK_PRIORS)
    dx, dy = (landmarks[j, 0], landmarks[j, 1]) if on_landmark else (poses[j, 0], poses[j, 1])
    theta = 0.0
    if i >= 0:
        theta = poses[i, 2]
        dx -= poses[i, 0]
        dy -= poses[i, 1]
    C, S = z['C'], z['S']
    phi = wrapped(theta - z['from'])
    q0, q1 = C * dx + S * dy, C * dy - S * dx
    cos, sin = math.cos(phi), math.sin(phi)
    # R(phi)^T q, and phi K R^T d_0 with q - p = R^T d_0
    e0, e1 = cos * q0 + sin * q1, cos * q1 - sin * q0
    d0, d1 = C * z['dx'] + S * z['dy'], C * z['dy'] - S * z['dx']
    r0, r1 = e0 - q0 - phi * d1, e1 - q1 + phi * d0
    w = z['weight']
    error: float = w * (z['I00'] * r0 * r0 + 2.0 * z['I01'] * r0 * r1 + z['I11'] * r1 * r1)
    if robust:
        e2 = 0.0 if on_landmark else wrapped(poses[j, 2] - theta - z['theta'])
        pull = squared(z, e0 - z['x'], e1 - z['y'], e2)
        new = loss(losses[kind, 0], losses[kind, 1], pull)[1]
        # a weight that changes by dw pulls like a residual that changes by dw / w
        change = (new - w) / max(w, new, 1e-6)
        error += change * change * pull * max(w, new, 1e-6)
        # it also is information, which is off by as much where nothing pulls
        phi = max(abs(phi), abs(change))
    return error / (due * due) + phi * phi / (turn * turn)
