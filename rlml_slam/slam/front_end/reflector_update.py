# SPDX-License-Identifier: Apache-2.0
"""The reflector term (e_R of eq. 2) as a measurement of the joint state: an iterated update."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import kernel
from rlml_slam.matching.reflectors.innovations import backward, expected, factorize, forward
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.joint_state import LANDMARKS, JointState, update

ITERATIONS = 4
CONVERGED = (1e-5, 1e-5, 1e-6)  # [m, m, rad] a last step of the pose


@kernel
def use_reflectors(
    x: Array,
    P: Array,
    index: NDArray[np.int64],
    z: Array,
    noise: Array,
    spread2: Array,
    distance2: Array,
    robust_scale: float,
) -> None:
    """Update ``x`` and ``P`` with detections z (q, 2) of reflectors ``index`` (q,).

    ``noise`` (q, 2, 2) are their covariances, ``spread2`` (q,) variances per axis besides,
    ``distance2`` (q,) the squared Mahalanobis distances of their innovations: by Huber's loss, one
    beyond ``robust_scale`` pulls no harder than at it. Gauss-Newton on the prior and the reflector
    terms of eq. 3, over the pose and the reflectors that were seen; then all else follows.
    """
    q = len(index)
    n = 3 + 2 * q
    at = np.empty(n, np.int64)
    at[:3] = np.arange(3)
    for k in range(q):
        at[3 + 2 * k] = LANDMARKS + 2 * index[k]
        at[4 + 2 * k] = LANDMARKS + 2 * index[k] + 1
    prior, cov = np.empty(n), np.empty((n, n))
    for r in range(n):
        prior[r] = x[at[r]]
        for c in range(n):
            cov[r, c] = P[at[r], at[c]]
    now, before = prior.copy(), np.empty(n)
    H, J = np.zeros((2 * q, n)), np.empty((2, 5))
    R = np.zeros((2 * q, 2 * q))
    v, here, y = np.empty(2 * q), np.empty(2), np.empty(2 * q)
    for k in range(q):
        excess = max(distance2[k] / robust_scale**2, 1.0)
        for r in range(2):
            R[2 * k + r, 2 * k] = noise[k, r, 0] * excess
            R[2 * k + r, 2 * k + 1] = noise[k, r, 1] * excess
            R[2 * k + r, 2 * k + r] = (noise[k, r, r] + spread2[k]) * excess
    for _ in range(ITERATIONS):
        for k in range(q):
            expected(now[:3], now[3 + 2 * k], now[4 + 2 * k], here, J)
            for r in range(2):
                H[2 * k + r, :3] = J[r, :3]
                H[2 * k + r, 3 + 2 * k : 5 + 2 * k] = J[r, 3:]
                v[2 * k + r] = z[k, r] - here[r]
        v += np.dot(H, now - prior)
        PH = np.dot(cov, H.T.copy())
        S = np.dot(H, PH) + R
        factorize(S)
        y[:] = v
        forward(S, y)
        backward(S, y)
        before[:] = now
        now = prior + np.dot(PH, y)
        moved = np.abs(now - before)
        if moved[0] < CONVERGED[0] and moved[1] < CONVERGED[1] and moved[2] < CONVERGED[2]:
            break
    update(x, P, at, H, R, v)


def warm_up() -> None:
    """Compile the kernel with the signature that is used at run time."""
    state = JointState(np.zeros(3), np.eye(3), 0.1)
    state.fix_landmarks(np.ones((1, 2)), np.eye(2)[None])
    index, one = np.zeros(1, dtype=np.int64), np.ones(1)
    use_reflectors(state.x, state.P, index, np.ones((1, 2)), np.eye(2)[None], one, one, 1.0)
