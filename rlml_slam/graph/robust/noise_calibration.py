# SPDX-License-Identifier: Apache-2.0
"""How far errors really are from what the covariances of a graph say, found from all of them.

The covariances of translation and heading are each too large or too small by a factor of their
own: there are scan matchers that state 0.3 m and hold 0.03 m, and state their heading well. An
error e = (p, theta) with stated covariance S is split into theta, of variance b^2 S_theta, and
p - S_p_theta theta / S_theta, what is left of the translation when the lever is taken off, of
covariance a^2 (S_p - S_p_theta S_p_theta^T / S_theta). Together they have Student's t
distribution, with the tails of the graph at hand: Gaussian where it is simulated, heavy where it
is measured. How heavy is averaged over what the errors leave open: a few do not settle it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rlml_slam.graph.robust.inlier_evidence import NU, mahalanobis2
from rlml_slam.se2 import Array

# degrees of freedom, from the heaviest tails that Lange, Little & Taylor 1989 find in practice to
# a Gaussian
FREEDOMS = (3.0, 5.0, 10.0, 30.0, 1000.0)
STARTS = (1e-3, 3e-2, 1.0)  # of a^2 and b^2, in terms of what is believed
ROUNDS = 100
LITTLE = 1e-5  # gain of log likelihood per error at which a fit stops


@dataclass(frozen=True)
class Calibration:
    """Per choice of tails: ``scales`` (m, 2), a^2 and b^2, and ``chances`` (m,), logarithms."""

    scales: Array
    chances: Array

    def evidence(self, e: Array, S: Array, wrong: float) -> Array:
        """Log density of errors (n, 3), stated covariances (n, 3, 3), less that of wrong ones."""
        parts = _parts(e, S)
        each = [
            chance + _density(parts, nu, *scale)
            for nu, scale, chance in zip(FREEDOMS, self.scales, self.chances, strict=True)
        ]
        return np.asarray(np.logaddexp.reduce(each, axis=0) - wrong)


def calibrate(e: Array, S: Array, scale: float, wrong: float) -> Calibration:
    """From errors (n, 3) of right and wrong closures, with log density ``wrong`` of the latter.

    Beforehand both factors are believed to be ``scale``, as surely as the t distribution with NU
    degrees of freedom does: as if that had been found from NU errors.
    """
    parts = _parts(e, S)
    starts = [(scale * a2, scale * b2) for a2 in STARTS for b2 in STARTS]
    fits = []
    for nu in FREEDOMS:
        tried = [_fit(parts, nu, start, scale, wrong) for start in starts]
        fits.append(max(tried, key=lambda fit: fit[0]))
        starts = [fits[-1][1]]  # the best of one choice of tails is near that of the next
    likelihoods = np.array([fit[0] for fit in fits])
    chances = likelihoods - np.logaddexp.reduce(likelihoods)
    return Calibration(np.array([fit[1] for fit in fits]), chances)


def _parts(e: Array, S: Array) -> tuple[Array, Array, Array]:
    """Squared norms (n,) of the heading, of the translation given that, and log volumes (n,)."""
    turn = e[:, 2] ** 2 / S[:, 2, 2]
    return np.maximum(mahalanobis2(e, S) - turn, 0.0), turn, 0.5 * np.linalg.slogdet(S)[1]


def _density(parts: tuple[Array, Array, Array], nu: float, a2: float, b2: float) -> Array:
    """Log t density (n,)."""
    shift, turn, volume = parts
    peak = math.lgamma((nu + 3.0) / 2.0) - math.lgamma(nu / 2.0) - 1.5 * math.log(nu * math.pi)
    q = shift / a2 + turn / b2
    peak -= math.log(a2) + 0.5 * math.log(b2)
    return np.asarray(peak - volume - 0.5 * (nu + 3.0) * np.log1p(q / nu))


def _fit(
    parts: tuple[Array, Array, Array], nu: float, start: tuple[float, float], scale: float,
    wrong: float,
) -> tuple[float, tuple[float, float]]:  # fmt: skip
    """Log posterior and (a^2, b^2) by expectation maximisation, as evidence.fit_scale."""
    shift, turn, _ = parts
    (a2, b2), share, likelihood = start, 0.5, -math.inf
    for _ in range(ROUNDS):
        right = math.log(share) + _density(parts, nu, a2, b2)
        both = np.logaddexp(right, math.log(1.0 - share) + wrong)
        prior = -0.5 * NU * sum(math.log(v) + scale / v for v in (a2, b2))
        likelihood, before = float(both.sum()) + prior, likelihood
        if likelihood - before < LITTLE * (len(both) + NU):
            break
        member = np.exp(right - both)
        share = float((member.sum() + 1.0) / (len(member) + 2.0))  # Laplace's rule
        w = member * (nu + 3.0) / (nu + shift / a2 + turn / b2)
        a2 = float(((w * shift).sum() + NU * scale) / (2.0 * member.sum() + NU))
        b2 = float(((w * turn).sum() + NU * scale) / (member.sum() + NU))
    return likelihood, (a2, b2)
