# SPDX-License-Identifier: Apache-2.0
"""Errors of S runs against the truth, and whether the covariances account for them."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from rlml_lab.deformable.ekf import Estimate
from rlml_lab.deformable.nls import Smoothed
from rlml_slam.se2 import Array


def pose_error2(truth: Array, mean: Array) -> Array:
    """Sum over the steps of (squared position error [m^2], squared heading error [rad^2]), (S, 2).

    Their sum is ss3, the note's "pose error": the sum, not the mean, over all steps of
    dx^2 + dy^2 + dtheta^2 of one run.
    """
    error2 = (mean[..., :3] - truth[..., :3]) ** 2
    return np.stack([error2[..., :2].sum((1, 2)), error2[..., 2].sum(1)], -1)


def ss3(truth: Array, mean: Array) -> Array:
    """The note's pose error of each run, (S,)."""
    total: Array = pose_error2(truth, mean).sum(-1)
    return total


def step_nees(truth: Array, estimate: Estimate) -> Array:
    """Normalised error e^T P^-1 e of the state at each step but the first, (S, N-1); n expected.

    The first pose is known exactly and would make P singular.
    """
    e = (estimate.mean - truth)[:, 1:]
    weighted = np.linalg.solve(estimate.cov[:, 1:], e[..., None])[..., 0]
    nees: Array = (e * weighted).sum(-1)
    return nees


def run_nees(truth: Array, smoothed: Smoothed) -> Array:
    """Normalised error e^T H e of all states of a run together, (S,); N n - 3 expected."""
    e = smoothed.mean - truth
    within = np.einsum('sna,snab,snb->s', e, smoothed.diagonal, e)
    across = np.einsum('sna,snab,snb->s', e[:, 1:], smoothed.below, e[:, :-1])
    nees: Array = within + 2.0 * across
    return nees


def chi2_bounds(degrees: int, samples: int, probability: float = 0.999) -> tuple[float, float]:
    """Two-sided bounds of the mean of ``samples`` independent chi^2 of ``degrees``."""
    tail = (1.0 - probability) / 2.0
    low, high = chi2.ppf([tail, 1.0 - tail], degrees * samples) / samples
    return float(low), float(high)


def mean_ci(values: Array) -> tuple[float, float]:
    """Mean and half width of its 95 % confidence interval (normal; fit for >= 30 runs)."""
    if len(values) < 2:
        return float(np.mean(values)), float('inf')
    return float(values.mean()), float(1.959964 * values.std(ddof=1) / np.sqrt(len(values)))
