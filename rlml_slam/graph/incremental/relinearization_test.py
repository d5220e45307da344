# SPDX-License-Identifier: Apache-2.0
"""Relinearization test: which factors of the incremental solver have a linear model that is off.

With phi and eta what theta_i and t_j - t_i have moved by since a factor was linearized,
p = R^T eta and q = R^T (t_j - t_i), the residual differs from its linear model by

    r = (R(phi)^T - 1) q + phi K (q - p),   K = [0 -1; 1 0]        (factors.model_error),

of second order and nothing where only positions moved; and its Jacobian has turned by phi. The
axes of a range turn with its direction instead. A factor is relinearized when r, or what the
change of its robust weight amounts to, is a considerable share of its standard deviation, or when
the turn of its axes or the change of its weight is.

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
    SIGHTINGS,
    STALE,
    STEP,
    Problem,
    State,
    Thresholds,
)
from rlml_slam.graph.model.factors import (
    Information,
    direction,
    is_curved,
    model_error,
    rotate_back,
    weighted,
)
from rlml_slam.graph.model.robust_loss import loss
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array, wrapped_by_turns

# bound of a residual in sigmas that ``valid_turn`` assumes: nearly all are within it
RESIDUAL_BOUND = 4.0
# share of the thresholds above which a factor is relinearized together with one that exceeds them
GROUP_SHARE = 1.0 / 3.0


@part
def valid_turn(z: np.void, robust: bool, thresholds: Thresholds) -> float:
    """Turn of its pose [rad] up to which a factor's linear model holds; negative if unknown.

    It is the phi of phi (RESIDUAL_BOUND + phi arm / 2) = GROUP_SHARE * thresholds.linear, with
    the arm in sigmas. With robust losses, and where axes turn with positions, there is none.
    """
    if robust or is_curved(z['kind']):
        return -1.0
    arm = math.sqrt((z['I00'] + z['I11']) * (z['dx'] * z['dx'] + z['dy'] * z['dy']))
    near = GROUP_SHARE * thresholds.linear
    phi = (
        2.0
        * near
        / (RESIDUAL_BOUND + math.sqrt(RESIDUAL_BOUND * RESIDUAL_BOUND + 2.0 * arm * near))
    )
    return min(phi, GROUP_SHARE * thresholds.turn)


@part
def is_robust(losses: Array) -> bool:
    """Whether any kind of factors has a loss that is not the square."""
    robust = False
    for k in range(len(losses)):
        robust = robust or losses[k, 0] != 0
    return robust


@part
def restrict_validity(u: np.void, z: np.void) -> None:
    """Restrict the headings within which unknown u needs no test to those of factor z.

    A factor without such headings leaves none.
    """
    u['valid_low'] = max(u['valid_low'], z['from'] - z['valid_turn'])
    u['valid_high'] = min(u['valid_high'], z['from'] + z['valid_turn'])


@part
def squared(z: np.void, e0: float, e1: float, e2: float) -> float:
    """e^T W e of a residual of factor z."""
    W = Information(z['I00'], z['I01'], z['I02'], z['I11'], z['I12'], z['I22'])
    q0, q1, q2 = weighted(W, e0, e1, e2)
    total: float = e0 * q0 + e1 * q1 + e2 * q2
    return total


@part
def needs_test(u: np.void) -> bool:
    """Whether the factors of an unknown that moved have to be tested.

    Without robust losses the linear model of a factor depends on the heading that it is from, and
    on little else as long as the residuals are within RESIDUAL_BOUND.
    """
    theta = u['theta'] + u['dtheta']
    return not u['valid_low'] < theta < u['valid_high']


@part
def find_stale_factors(state: State, moved: Ints, problem: Problem) -> None:
    """List the factors of the unknowns ``moved`` that have to be relinearized.

    That is none unless a linear model exceeds the thresholds; then it is all that are off by
    GROUP_SHARE of them: forces of factors that were linearized at different headings do not
    balance, so what turned together is relinearized together.
    """
    counts = state.counts
    worst = 0.0
    for n in range(len(moved)):
        u = state.unknowns[moved[n]]
        # the factors of one a little further on are loaded meanwhile
        soon = state.unknowns[moved[min(n + 4, len(moved) - 1)]]['head'] // 2
        fetch(state.factors, soon, 0)
        fetch(state.factors, soon, LINE)
        theta = u['theta'] + u['dtheta']
        heard = u['size'] == 2 and u['valid_low'] > u['valid_high']  # a landmark with ranges
        u['valid_low'], u['valid_high'] = -np.inf, np.inf
        link = u['head']
        while link >= 0:
            f, end = link // 2, link % 2
            z = state.factors[f]
            link = z['next_a'] if end == 0 else z['next_b']
            if end == 0 or (heard and is_curved(z['kind'])):
                restrict_validity(u, z)
                if abs(theta - z['from']) < z['valid_turn']:
                    continue
            elif not problem.robust:
                if heard:
                    continue
                break  # and so are those that follow
            if z['tested'] == counts[STEP]:
                continue
            z['tested'] = counts[STEP]
            error = _model_error(z, problem)
            if error > GROUP_SHARE * GROUP_SHARE:
                worst = max(worst, error)
                state.stale[counts[STALE]] = f
                counts[STALE] += 1
    if worst < 1.0:
        counts[STALE] = 0


@part
def _model_error(z: np.void, problem: Problem) -> float:
    """Squared error of a factor's linear model, 1 at the thresholds."""
    i, j, kind = z['i'], z['j'], z['kind']
    poses, landmarks, thresholds = problem.poses, problem.landmarks, problem.thresholds
    on_landmark = z['table'] in (SIGHTINGS, LANDMARK_PRIORS)
    dx, dy = (landmarks[j, 0], landmarks[j, 1]) if on_landmark else (poses[j, 0], poses[j, 1])
    theta = 0.0
    if i >= 0:
        theta = poses[i, 2]
        dx -= poses[i, 0]
        dy -= poses[i, 1]
    phi = wrapped_by_turns(theta - z['from'])
    q = rotate_back(z['C'], z['S'], dx, dy)
    q0 = rotate_back(z['C'], z['S'], z['dx'], z['dy'])
    cos, sin, turn = math.cos(phi), math.sin(phi), phi
    if is_curved(kind):
        cos, sin = direction(q[0], q[1])
        turn = math.atan2(sin, cos)
    r0, r1 = model_error((cos, sin), phi, q, q0)
    w = z['weight']
    error: float = w * (z['I00'] * r0 * r0 + 2.0 * z['I01'] * r0 * r1 + z['I11'] * r1 * r1)
    if problem.robust:
        losses = problem.losses
        e2 = 0.0 if on_landmark else wrapped_by_turns(poses[j, 2] - theta - z['theta'])
        e0, e1 = rotate_back(cos, sin, q[0], q[1])
        pull = squared(z, e0 - z['x'], e1 - z['y'], e2)
        new = loss(losses[kind, 0], losses[kind, 1], pull)[1]
        # a weight that changes by dw pulls like a residual that changes by dw / w
        change = (new - w) / max(w, new, 1e-6)
        error += change * change * pull * max(w, new, 1e-6)
        # it also is information, which is off by as much where nothing pulls
        turn = max(abs(turn), abs(change))
    return error / (thresholds.linear * thresholds.linear) + turn * turn / (
        thresholds.turn * thresholds.turn
    )
