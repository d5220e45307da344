# SPDX-License-Identifier: Apache-2.0
"""The scan term (eq. 1, 2): e_k = 1 - M(X + p_k), and its solution.

M is what the cells of the submap read (eq. 68), interpolated by a uniform cubic B-spline: twice
continuously differentiable, without overshoot, and a slight blur that widens the basin. Unknown
cells count as UNKNOWN. Poses are of the base in the submap frame; derivatives are with respect to
the raw coordinates (x, y, theta).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rlml_slam import params
from rlml_slam.compiled import brief, kernel, part
from rlml_slam.matching.scans import correlative_search, surfaces
from rlml_slam.matching.scans.correlative_search import Prior
from rlml_slam.matching.scans.ray_carving import Grid
from rlml_slam.matching.scans.submap import FREE_VALUE, NEVER_HIT, P_MIN, STEP, Submap
from rlml_slam.se2 import Array, wrapped

WIDE_STRIDE = 2  # cells between the shifts of the wide search; a wall is about as thick
UNKNOWN = P_MIN  # M of an unknown cell; like free space, so a wall is a ridge from both sides
INLIER = 0.5  # M from which an end point counts as explained
ROBUST = 0.6  # e at which the Geman-McClure weight has fallen to a quarter


@dataclass(frozen=True)
class ScanTerm:
    """The scan term at one pose: cost = sum rho(e_k), unit variance (divide by sigma_s^2).

    ``gradient`` (3,) = J^T W e; ``hessian`` (3, 3) = J^T W J plus the curvature of M where it is
    downward (on the ridge of a wall), so the step is -H^-1 g; ``cost`` is half the weighted sum
    of squares. ``score`` is the mean of M over all end points (0..1), which a cell that was missed
    once or twice does not contradict: its probability counts there. ``inliers`` is the number of
    end points with M > INLIER, ``count`` all of them.
    """

    cost: float
    gradient: Array
    hessian: Array
    score: float
    inliers: int
    count: int


@dataclass(frozen=True)
class ScanMatchResult:
    """Pose (3,) of base in the submap frame, and how far to trust it.

    ``information`` (3, 3) is that of the scan alone (H / sigma_s^2), ``prior_weight`` the share
    of the prior that was left after truncation (1 = scan and prior agree), ``pull`` (3,) the
    gradient of the prior's cost, which that of the scan holds in balance.
    """

    pose: Array
    information: Array
    score: float
    iterations: int
    converged: bool
    prior_weight: float
    pull: Array


@kernel
def spline(t: float) -> tuple[float, float, float, float]:
    """Weights of the four cells around a point, t in [0, 1) from the second to the third."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (3.0 * t * t * (t - 2.0) + 4.0) / 6.0,
        (3.0 * s * s * (s - 2.0) + 4.0) / 6.0,
        t * t * t / 6.0,
    )


@kernel
def spline_slope(t: float) -> tuple[float, float, float, float]:
    """Derivative of spline() with respect to t."""
    s = 1.0 - t
    return -0.5 * s * s, 0.5 * t * (3.0 * t - 4.0), -0.5 * s * (3.0 * s - 4.0), 0.5 * t * t


@kernel
def spline_curve(t: float) -> tuple[float, float, float, float]:
    """Second derivative of spline() with respect to t."""
    return 1.0 - t, 3.0 * t - 2.0, 1.0 - 3.0 * t, t


@kernel
def sample(values: NDArray[np.uint16], column: float, row: float) -> tuple[float, float, float]:
    """M and its slope (dM/dcolumn, dM/drow) [1/cell] at a place in cells from values[0, 0]."""
    m, m_u, m_v, _, _, _ = sample_curved(values, column, row)
    return m, m_u, m_v


@kernel
def sample_curved(
    values: NDArray[np.uint16], column: float, row: float
) -> tuple[float, float, float, float, float, float]:
    """M, its slope as sample(), and its second derivatives (uu, uv, vv) [1/cell^2]."""
    u, v = column - 0.5, row - 0.5  # a cell's value is that of its centre
    j, i = int(np.floor(u)), int(np.floor(v))
    if j < 1 or i < 1 or j + 2 >= values.shape[1] or i + 2 >= values.shape[0]:
        return UNKNOWN, 0.0, 0.0, 0.0, 0.0, 0.0
    tu, tv = u - j, v - i
    a0, a1, a2, a3 = spline(tu)
    d0, d1, d2, d3 = spline_slope(tu)
    f0, f1, f2, f3 = spline_curve(tu)
    b = spline(tv)
    c = spline_slope(tv)
    g = spline_curve(tv)
    flat, columns = values.reshape(-1), values.shape[1]
    m = m_u = m_v = m_uu = m_uv = m_vv = 0.0
    for r in range(4):
        at = np.uint64((i - 1 + r) * columns + j - 1)
        p0, p1 = known(flat[at]), known(flat[at + np.uint64(1)])
        p2, p3 = known(flat[at + np.uint64(2)]), known(flat[at + np.uint64(3)])
        along = a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3
        slope = d0 * p0 + d1 * p1 + d2 * p2 + d3 * p3
        m += b[r] * along
        m_u += b[r] * slope
        m_v += c[r] * along
        m_uu += b[r] * (f0 * p0 + f1 * p1 + f2 * p2 + f3 * p3)
        m_uv += c[r] * slope
        m_vv += g[r] * along
    # what a cell reads is linear in its value, and the weights of a spline sum up to one
    return (
        P_MIN + STEP * (m - 1.0), STEP * m_u, STEP * m_v, STEP * m_uu, STEP * m_uv, STEP * m_vv,
    )  # fmt: skip


@part
def known(value: int) -> float:
    """Value of a cell, an unknown one counting as P_MIN."""
    return float(max(int(value), 1))


@part
def missed_probability(values: NDArray[np.uint16], column: float, row: float) -> float:
    """Probability of the cell of an end point if it was only missed, else 0."""
    j, i = int(np.floor(column)), int(np.floor(row))
    if j < 0 or i < 0 or j >= values.shape[1] or i >= values.shape[0]:
        return 0.0
    value = int(values[i, j])
    return P_MIN + NEVER_HIT * STEP * (value - 1) if 0 < value <= FREE_VALUE else 0.0


@kernel
def accumulate(grid: Grid, points: Array, constraints: Array, pose: Array, out: Array) -> None:
    """Scan term into ``out`` (12,): cost, g (3), H upper triangle (6), sum of M, inliers.

    H is Newton's, made positive semidefinite point by point: with e far from 0 even at the
    optimum, J^T J alone misses most of the curvature on the ridge, and steps overshoot.
    """
    values, corner_j, corner_i, scale = grid
    out[:] = 0.0
    x, y = pose[0], pose[1]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    k2 = ROBUST * ROBUST
    for k in range(len(points)):
        px, py = points[k, 0], points[k, 1]
        rx, ry = c * px - s * py, s * px + c * py
        column, row = (x + rx) * scale - corner_j, (y + ry) * scale - corner_i
        m, m_u, m_v, m_uu, m_uv, m_vv = sample_curved(values, column, row)
        e = 1.0 - m
        # Geman-McClure: rho = e^2 / (1 + e^2/k^2), weight = (1 + e^2/k^2)^-2
        q = 1.0 / (1.0 + e * e / k2)
        w = q * q
        # the end point's constraint in the submap frame: P = R C R^T
        a, b, d = constraints[k, 0], constraints[k, 1], constraints[k, 2]
        p_xx = c * c * a - 2.0 * c * s * b + s * s * d
        p_xy = c * s * (a - d) + (c * c - s * s) * b
        p_yy = s * s * a + 2.0 * c * s * b + c * c * d
        jx, jy = -(p_xx * m_u + p_xy * m_v) * scale, -(p_xy * m_u + p_yy * m_v) * scale
        n_xx, n_xy, n_yy = downward(
            p_xx * p_xx * m_uu + 2.0 * p_xx * p_xy * m_uv + p_xy * p_xy * m_vv,
            p_xx * p_xy * m_uu + (p_xx * p_yy + p_xy * p_xy) * m_uv + p_xy * p_yy * m_vv,
            p_xy * p_xy * m_uu + 2.0 * p_xy * p_yy * m_uv + p_yy * p_yy * m_vv,
        )
        bend = e * scale * scale
        h_xx, h_xy = w * (jx * jx + bend * n_xx), w * (jx * jy + bend * n_xy)
        h_yy = w * (jy * jy + bend * n_yy)
        # d(x + R p)/d(x, y, theta) = [I, (-ry, rx)]
        h_xt, h_yt = -ry * h_xx + rx * h_xy, -ry * h_xy + rx * h_yy
        out[0] += 0.5 * e * e * q
        out[1] += w * jx * e
        out[2] += w * jy * e
        out[3] += w * (-ry * jx + rx * jy) * e
        out[4] += h_xx
        out[5] += h_xy
        out[6] += h_xt
        out[7] += h_yy
        out[8] += h_yt
        out[9] += -ry * h_xt + rx * h_yt
        out[10] += max(m, missed_probability(values, column, row))
        out[11] += m > INLIER


@kernel
def downward(a: float, b: float, d: float) -> tuple[float, float, float]:
    """The positive semidefinite part of -[[a, b], [b, d]], as (a, b, d)."""
    mean, half = 0.5 * (a + d), 0.5 * (a - d)
    root = np.sqrt(half * half + b * b)
    low, high = mean - root, mean + root
    if low >= 0.0:
        return 0.0, 0.0, 0.0
    if high <= 0.0:
        return -a, -b, -d
    f = -low / (high - low)
    return f * (high - a), -f * b, f * (high - d)


def linearize(submap: Submap, points: Array, pose: Array) -> ScanTerm:
    """The scan term of ``points`` (n, 2), base frame, at ``pose`` (3,) of base in the submap."""
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    out, pose = np.empty(12), np.ascontiguousarray(pose, dtype=np.float64)
    accumulate(submap.grid, points, surfaces.constraints(points), pose, out)
    n = len(points)
    return ScanTerm(
        float(out[0]), out[1:4].copy(), symmetric(out[4:10]),
        float(out[10]) / n if n else 0.0, int(out[11]), n,
    )  # fmt: skip


def symmetric(upper: Array) -> Array:
    """Matrix (3, 3) of its upper triangle, row by row (6,)."""
    a, b, c, d, e, f = upper
    return np.array([[a, b, c], [b, d, e], [c, e, f]])


@kernel
def refine(
    grid: Grid, points: Array, constraints: Array, start: Array, prior: Prior, sigma: float,
    max_iterations: int, out: Array,
) -> tuple[float, float, float, float, int, bool]:  # fmt: skip
    """LM on scan term / sigma^2 + robust prior; (x, y, theta, weight, iterations, converged).

    ``out`` (12,) holds the scan term at the result.
    """
    w = 1.0 / (sigma * sigma)
    pose = start.copy()
    trial = np.empty(3)
    term = np.empty(12)
    A = np.empty((3, 3))
    b = np.empty(3)
    accumulate(grid, points, constraints, pose, out)
    cost, weight = prior_term(pose, prior, A, b)
    cost += w * out[0]
    damping = 1e-4
    iterations = 0
    converged = False
    while iterations < max_iterations and not converged:
        iterations += 1
        _, weight = prior_term(pose, prior, A, b)
        n = 4
        for r in range(3):
            b[r] += w * out[1 + r]
            for q in range(r, 3):
                A[r, q] += w * out[n]
                A[q, r] = A[r, q]
                n += 1
            A[r, r] = A[r, r] * (1.0 + damping) + 1e-9
        step = solve3(A, b)
        for r in range(3):
            trial[r] = pose[r] - step[r]
        accumulate(grid, points, constraints, trial, term)
        trial_cost, _ = prior_term(trial, prior, A, b)
        trial_cost += w * term[0]
        converged = abs(step[0]) < 1e-4 and abs(step[1]) < 1e-4 and abs(step[2]) < 1e-5
        if trial_cost <= cost:
            pose[:] = trial
            out[:] = term
            cost = trial_cost
            damping = max(damping * 0.1, 1e-7)
        else:
            damping = max(damping * 10.0, 1e-3)
    return pose[0], pose[1], pose[2], weight, iterations, converged


@kernel
def prior_term(pose: Array, prior: Prior, A: Array, b: Array) -> tuple[float, float]:
    """Cost and smallest weight of the prior; its Hessian into A (3, 3), its gradient into b (3,).

    Each component of u = whitening (pose - prior) has a Geman-McClure loss of its own: it is a
    Gaussian near the prior and has no say far from it, so a component of the odometry that is
    plainly wrong loses against the scan, and the others stay.
    """
    at, whitening, robust_scale = prior
    d0, d1 = pose[0] - at[0], pose[1] - at[1]
    d2 = np.pi - np.mod(np.pi - (pose[2] - at[2]), 2.0 * np.pi)
    A[:] = 0.0
    b[:] = 0.0
    cost, weight = 0.0, 1.0
    for h in range(3):
        u = whitening[h, 0] * d0 + whitening[h, 1] * d1 + whitening[h, 2] * d2
        k = 1.0 / (1.0 + u * u / (robust_scale * robust_scale))
        cost += 0.5 * u * u * k
        weight = min(weight, k * k)
        for r in range(3):
            b[r] += k * k * whitening[h, r] * u
            for q in range(3):
                A[r, q] += k * k * whitening[h, r] * whitening[h, q]
    return cost, weight


@brief
def whitening_of(information: Array, theta: float) -> Array:
    """W (3, 3) with W^T W = information, its rows forward, sideways, turn of the base at theta."""
    c, s = np.cos(theta), np.sin(theta)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    L = np.linalg.cholesky(np.dot(np.dot(R.T.copy(), information), R))
    W: Array = np.dot(L.T.copy(), R.T.copy())
    return W


@kernel
def solve3(A: Array, b: Array) -> tuple[float, float, float]:
    """Solution of the symmetric positive definite A x = b (3 x 3) by Cholesky."""
    l00 = np.sqrt(A[0, 0])
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = np.sqrt(max(A[1, 1] - l10 * l10, 1e-12))
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(A[2, 2] - l20 * l20 - l21 * l21, 1e-12))
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    x2 = y2 / l22
    x1 = (y1 - l21 * x2) / l11
    x0 = (y0 - l10 * x1 - l20 * x2) / l00
    return x0, x1, x2


def match(
    submap: Submap,
    points: Array,
    prior_pose: Array,
    prior_information: Array,
    parameters: params.ScanMatch | None = None,
    searched: bool = True,
    window: tuple[float, float] | None = None,
    usual: float = 0.0,
) -> ScanMatchResult:
    """Pose of base in the submap from ``points`` (n, 2), base frame, and an odometry prior.

    ``prior_pose`` (3,), ``prior_information`` (3, 3) in raw coordinates of the submap frame.
    Points are in scan order, and thinned as scans are that are matched. With ``searched`` a
    correlative search in the window of the parameters gives the start, and where the fit is poor
    another one in the wide window; else the prior does. A ``window`` [m, rad] replaces that of the
    parameters, and then the prior is tried as well; a fit below ``usual`` counts as poor. With no
    points, or no submap, the prior is returned with no information and score 0.
    """
    p = parameters or params.ScanMatch()
    prior_pose = np.ascontiguousarray(prior_pose, dtype=np.float64)
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    if not len(points) or not submap.values.size:
        return ScanMatchResult(
            prior_pose.copy(), np.zeros((3, 3)), 0.0, 0, False, 1.0, np.zeros(3)
        )
    W = whitening_of(
        np.ascontiguousarray(prior_information, dtype=np.float64), float(prior_pose[2])
    )
    prior = Prior(prior_pose, W, p.prior_robust_scale)
    solve = _Solve(submap, points, surfaces.constraints(points), prior, p)
    if not searched:
        return solve.refined(prior_pose)
    width, angle = (p.search_window, p.search_angle) if window is None else window
    result = solve.refined(solve.found(width, angle, 1))
    if window is not None:
        other = solve.refined(prior_pose)
        result = other if solve.merit(other) >= solve.merit(result) else result
    if result.score < max(p.wide_search_threshold, usual):
        other = solve.refined(solve.found(p.wide_window, p.wide_angle, WIDE_STRIDE))
        if solve.merit(other) > solve.merit(result):
            return other
    return result


@dataclass(frozen=True)
class _Solve:
    """One match: what all its searches and refinements share."""

    submap: Submap
    points: Array
    constraints: Array
    prior: Prior
    p: params.ScanMatch

    def found(self, half_width: float, half_angle: float, stride: int) -> Array:
        """The best pose of a window search around the prior."""
        return correlative_search.window(
            self.submap, self.points, self.prior, half_width, half_angle,
            self.p.search_prior_weight, stride,
        ).pose  # fmt: skip

    def refined(self, start: Array) -> ScanMatchResult:
        """The local optimum from ``start``."""
        p, out = self.p, np.empty(12)
        x, y, theta, weight, iterations, converged = refine(
            self.submap.grid, self.points, self.constraints, start, self.prior, p.sigma,
            p.max_iterations, out,
        )  # fmt: skip
        A, pull = np.empty((3, 3)), np.empty(3)
        prior_term(np.array([x, y, theta]), self.prior, A, pull)
        return ScanMatchResult(
            np.array([x, y, wrapped(theta)]), symmetric(out[4:10]) / p.sigma**2,
            float(out[10]) / len(self.points), iterations, converged, weight, pull,
        )  # fmt: skip

    def merit(self, result: ScanMatchResult) -> float:
        """Score less what the prior has against the pose, as in the search."""
        x, y, turn = result.pose - self.prior.pose
        loss = correlative_search.prior_loss(
            x, y, wrapped(turn), self.prior.whitening, self.prior.robust_scale
        )
        return result.score - self.p.search_prior_weight * loss


def warm_up() -> None:
    """Compile the kernels with the signatures that are used at run time."""
    submap = Submap()
    points = np.array([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.8]])
    submap.insert(points, np.zeros(2))
    linearize(submap, points, np.zeros(3))
    match(submap, points, np.zeros(3), np.eye(3), params.ScanMatch(wide_search_threshold=1.0))
