# SPDX-License-Identifier: Apache-2.0
"""Rauch-Tung-Striebel smoother on the EKF's result: smoothing without relinearisation.

Most of the gain of the NLS over an EKF is smoothing, so a comparison needs this third estimator.
"""

from __future__ import annotations

from rlml_lab.deformable.ekf import Estimate, predict
from rlml_lab.deformable.experiment import Measurements
from rlml_slam.deformable.block_tridiagonal import cholesky, solve_lower, solve_upper
from rlml_slam.deformable.model import Noise, motion


def run_rts(measurements: Measurements, noise: Noise, filtered: Estimate) -> Estimate:
    """The filtered estimate of S runs, smoothed backwards."""
    mean, cov = filtered.mean.copy(), filtered.cov.copy()
    S, N, _ = mean.shape
    for run in range(S):
        for i in range(N - 2, -1, -1):
            u, ahead, P = measurements.control[run, i], mean[run, i].copy(), cov[run, i].copy()
            _, _, _, a, b = motion(ahead[0], ahead[1], ahead[2], u)
            predict(ahead, P, u, measurements.drift[run, i], noise)
            # gain C = P_i F^T P_{i+1|i}^-1, row by row
            C, L = cov[run, i].copy(), P.copy()
            C[:, 0] += a * C[:, 2]
            C[:, 1] += b * C[:, 2]
            cholesky(L)
            for row in C:
                solve_lower(L, row)
                solve_upper(L, row)
            mean[run, i] += C @ (mean[run, i + 1] - ahead)
            cov[run, i] += C @ (cov[run, i + 1] - P) @ C.T
    return Estimate(mean, cov)
