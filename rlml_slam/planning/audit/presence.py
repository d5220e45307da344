# SPDX-License-Identifier: Apache-2.0
"""Reflectors that are seen less often than the others are: a binomial test with overdispersion.

Misses come in rows, for people and vehicles pass. The variance of the counts of one meter of
travel against that of the binomial distribution is the dispersion phi (McCullagh and Nelder,
*Generalized Linear Models*, 4.5); counts divided by it are tested as binomial.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from rlml_slam.planning.audit.evidence import Evidence
from rlml_slam.se2 import Array

LEAST = 10  # expected sightings below which nothing is said about a reflector
BEST = 0.995  # rate of detection that is assumed at most
RARE = 1e-3  # chance that any sound reflector of a layout is said to be missed
SHORT = 0.8  # share of the usual rate from which a reflector is seen as often as others


class Presence(NamedTuple):
    """Of each reflector (m,): ``expected`` and ``seen`` sightings, ``chance`` of so few.

    ``usual``: rate of detection of this run; ``is_low`` (m,): seen significantly less often.
    """

    expected: Array
    seen: Array
    chance: Array
    usual: float
    dispersion: float
    is_low: Array


def presence(e: Evidence) -> Presence:
    """Test each reflector against the rate at which the run saw the others."""
    hits = e.expected & (e.seen >= 0)
    n, s = e.expected.sum(axis=0).astype(float), hits.sum(axis=0).astype(float)
    tested = n >= LEAST
    share = s / np.maximum(n, 1.0)
    usual = min(float(np.median(share[tested])), BEST) if tested.any() else BEST
    phi = _dispersion(e, hits, usual)
    chance = np.where(tested, _cdf(s / phi, n / phi, usual), 1.0)
    is_low = tested & (share < SHORT * usual) & (chance * max(tested.sum(), 1) < RARE)
    return Presence(n, s, chance, usual, phi, is_low)


def _dispersion(e: Evidence, hits: NDArray[np.bool_], usual: float) -> float:
    """Variance of the counts per block over that of the binomial, median of all reflectors."""
    blocks = int(e.block[-1]) + 1
    found = []
    for k in range(e.expected.shape[1]):
        n = np.bincount(e.block, e.expected[:, k], blocks)
        s = np.bincount(e.block, hits[:, k], blocks)
        n, s = n[n > 0], s[n > 0]
        if n.sum() < LEAST or s.sum() < SHORT * usual * n.sum():
            continue  # another one than the usual
        rate = (s.sum() + 0.5) / (n.sum() + 1.0)
        found.append(np.sum((s - rate * n) ** 2 / (rate * (1.0 - rate) * n)) / max(len(n) - 1, 1))
    return max(1.0, float(np.median(found))) if found else 1.0


def _cdf(s: Array, n: Array, p: float) -> Array:
    """P(X <= s) of the binomial distribution of n, also between whole numbers."""
    missed = np.maximum(n - s, 0.0)
    with np.errstate(invalid='ignore'):
        chance = betainc(np.maximum(missed, 1e-9), s + 1.0, 1.0 - p)
    return np.where(missed > 0.0, chance, 1.0)
