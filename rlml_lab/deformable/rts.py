# SPDX-License-Identifier: Apache-2.0
"""Rauch-Tung-Striebel smoother on the EKF's result: smoothing without relinearisation.

Most of the gain of the NLS over an EKF is smoothing, so a comparison needs this third estimator.
"""

from __future__ import annotations

import numpy as np

from rlml_lab.deformable.ekf import Estimate, predict
from rlml_lab.deformable.experiment import Measurements
from rlml_slam.compiled import kernel
from rlml_slam.deformable.block_tridiagonal import cholesky, solve_lower, solve_upper
from rlml_slam.deformable.model import Noise, motion
from rlml_slam.se2 import Array


@kernel
def _smooth_back(control: Array, drift: Array, noise: Noise, mean: Array, cov: Array) -> None:
    S, N, n = mean.shape
    ahead, P, C, L = np.empty(n), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for run in range(S):
        for i in range(N - 2, -1, -1):
            state, u = mean[run, i], control[run, i]
            ahead[:], P[:] = state, cov[run, i]
            predict(ahead, P, u, drift[run, i], noise)
            # gain C = P_i F^T P_{i+1|i}^-1, row by row
            _, _, _, a, b = motion(state[0], state[1], state[2], u)
            C[:] = cov[run, i]
            for k in range(n):
                C[k, 0] += a * C[k, 2]
                C[k, 1] += b * C[k, 2]
            L[:] = P
            cholesky(L)
            for k in range(n):
                solve_lower(L, C[k])
                solve_upper(L, C[k])
            mean[run, i] += C @ (mean[run, i + 1] - ahead)
            cov[run, i] += C @ (cov[run, i + 1] - P) @ C.T


def run_rts(measurements: Measurements, noise: Noise, filtered: Estimate) -> Estimate:
    """The filtered estimate of S runs, smoothed backwards."""
    smoothed = Estimate(filtered.mean.copy(), filtered.cov.copy())
    _smooth_back(measurements.control, measurements.drift, noise, *smoothed)
    return smoothed
