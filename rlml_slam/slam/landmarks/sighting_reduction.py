# SPDX-License-Identifier: Apache-2.0
"""Sightings moved to another keyframe when theirs is marginalized, and fused there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.graph import RelativePoses, floored_covariance
from rlml_slam.se2 import Array, rotation, transform
from rlml_slam.slam.keyframes import SIGHTING_GATE

Records = NDArray[np.void]

# [m²] variance of the common error of all sightings of a reflector from one side: of its centre
# as the sensor sees it, and of the submaps there
COMMON2 = np.array([1e-4, 1e-4])


def moved(ties: RelativePoses, s: Records) -> tuple[Array, Array]:
    """Positions (k, 2) and covariances of sightings, relative to where ``ties`` (k,) begin."""
    z = transform(ties.T, s['z'][:, None])[:, 0]
    R = rotation(ties.T[:, 2])
    J = np.zeros((len(s), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = ties.T[:, 1] - z[:, 1], z[:, 0] - ties.T[:, 0]
    cov = R @ np.linalg.inv(s['information']) @ np.swapaxes(R, 1, 2)
    return z, cov + J @ ties.cov @ np.swapaxes(J, 1, 2)


def fused(s: Records) -> Records:
    """Sightings (k,) of one reflector, those from one pose that agree with the first fused.

    Of the others from that pose, the newest stays.
    """
    _, first, at = np.unique(s['pose'], return_index=True, return_inverse=True)
    cov: Array = np.linalg.inv(s['information'])
    d = s['z'] - s['z'][first][at]
    S = cov + cov[first][at]
    distance2 = np.einsum('ki,ki->k', d, np.linalg.solve(S, d[..., None])[..., 0])
    agree = distance2 < SIGHTING_GATE
    out = s[first]
    W, b = np.zeros((len(first), 2, 2)), np.zeros((len(first), 2))
    np.add.at(W, at[agree], s['information'][agree])
    np.add.at(b, at[agree], (s['information'] @ s['z'][..., None])[agree, :, 0])
    C = np.asarray(np.linalg.inv(W), dtype=np.float64)
    out['z'] = (C @ b[..., None])[..., 0]
    out['information'] = np.linalg.inv(floored_covariance(C, COMMON2, cov[agree], at[agree]))
    others = s[~agree][::-1]
    _, newest = np.unique(others['pose'], return_index=True)
    return np.concatenate([out, others[newest]])
