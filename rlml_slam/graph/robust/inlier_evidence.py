# SPDX-License-Identifier: Apache-2.0
"""How much the error of a closure speaks for it: inliers against errors spread over the map.

The error e of a right closure has covariance a S, with S predicted by the graph and one scale a
for all of them, because the covariances of a graph are often too large or too small by the same
factor. Its density is Student's t, whose tails are those of real data; that of a wrong one is
uniform over an area and all headings. The evidence is the logarithm of their ratio: by Markov's
inequality that of a wrong closure exceeds t with a probability of e^-t at most.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from rlml_slam.se2 import Array

# degrees of freedom: between the 3 to 10 that Lange, Little & Taylor 1989 find in practice
NU = 5.0
USUAL = 0.9  # share of the closures that are no longer than the usual reach
SCALES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)  # where the search for the scale begins
_PEAK = math.lgamma((NU + 3.0) / 2.0) - math.lgamma(NU / 2.0) - 1.5 * math.log(NU * math.pi)


def mahalanobis2(e: Array, S: Array) -> Array:
    """e^T S^-1 e ``(...)`` of errors ``(..., 3)``."""
    return np.asarray(np.einsum('...i,...i->...', e, np.linalg.solve(S, e[..., None])[..., 0]))


def uniform(area: Array | float) -> Array:
    """Log density of wrong errors within an area [m²], any heading."""
    return np.asarray(-np.log(2.0 * np.pi * np.asarray(area, dtype=np.float64)))


def extent2(poses: Array) -> float:
    """Square of the larger extent of the poses (n, 3) [m²], at least 1."""
    return max(float(np.ptp(poses[:, :2], axis=0).max()) ** 2, 1.0)


def near_by(poses: Array, z: Array, cov: Array) -> float:
    """Log density of the errors of wrong closures that look like closures z (k, 3) do at all.

    Those join two poses as near to each other as closures are long and, with covariance ``cov`` of
    that, uncertain. Chance does so as often as two poses are, whose errors then lie within that
    reach at any heading. Robots keep to their ways: that is more often than if the poses (n, 3)
    were spread evenly over the map, which is the least.
    """
    anywhere, n = float(uniform(extent2(poses))), len(poses)
    if not len(z):
        return anywhere
    length2 = (z[:, :2] ** 2).sum(1) + np.trace(cov[:, :2, :2], axis1=1, axis2=2)
    reach = math.sqrt(float(np.quantile(length2, USUAL)))
    tree = cKDTree(poses[:, :2])
    pairs = float(tree.count_neighbors(tree, reach)) - n
    if pairs <= 0.0:
        return anywhere
    return max(math.log(pairs / (n * (n - 1.0))) + float(uniform(math.pi * reach**2)), anywhere)


def evidence(e: Array, S: Array, scale: float, wrong: Array) -> Array:
    """Log t density of errors (n, 3) with covariance scale * S, less the log density ``wrong``."""
    q = mahalanobis2(e, S) / scale
    volume = 0.5 * np.linalg.slogdet(S)[1] + 1.5 * math.log(scale)
    return np.asarray(_PEAK - volume - 0.5 * (NU + 3.0) * np.log1p(q / NU) - wrong)


def fit_scale(e: Array, S: Array, wrong: Array) -> float:
    """The scale under which a mixture of right and wrong errors is likeliest; 1 of no errors.

    Expectation maximisation over scale and share of the right ones, with the weights
    (NU + 3) / (NU + q) of the t distribution, from several starts.
    """
    best, found = -math.inf, 1.0
    if not len(e):
        return found
    s = mahalanobis2(e, S)
    volume = 0.5 * np.linalg.slogdet(S)[1]
    for start in SCALES:
        scale, share, likelihood = start, 0.5, -math.inf
        for _ in range(100):
            q = s / scale
            right = _PEAK - volume - 1.5 * math.log(scale) - 0.5 * (NU + 3.0) * np.log1p(q / NU)
            both = np.logaddexp(math.log(share) + right, math.log(1.0 - share) + wrong)
            likelihood, before = float(both.sum()), likelihood
            if likelihood - before < 1e-6 * len(e):
                break
            member = np.exp(math.log(share) + right - both)
            share = float(np.clip(member.mean(), 1e-3, 1.0 - 1e-3))
            scale = float((member * (NU + 3.0) / (NU + q) * s).sum() / (3.0 * member.sum()))
            scale = max(scale, 1e-9)
        if likelihood > best:
            best, found = likelihood, scale
    return found
