# SPDX-License-Identifier: Apache-2.0
"""Log likelihood of measurements by landmark, for the weights of the branches."""

from __future__ import annotations

import math

import numpy as np

from rlml_slam.ekf.association import mahalanobis2
from rlml_slam.ekf.extraction import Measured
from rlml_slam.ekf.filter import Filter, innovation_covs
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.se2 import Array
from rlml_slam.slam.landmarks.delayed_association import SPREAD

# [m], [rad] of motion between two independent frames: errors of a sensor, and which one of a group
# of landmarks it sees, are correlated from one frame to the next
DECORRELATION = np.array([0.3, 0.25])
MIN_WEIGHT = 0.3  # of a frame from the same place, for the filter


def log_density(filter_: Filter, tracks: LandmarkTracks, seen: Measured) -> tuple[Array, Array]:
    """Log density [1/m²] and squared Mahalanobis distance (k, a) of measurements, by landmark.

    One landmark of the map may be several close ones: SPREAD is added to the noise.
    """
    z = seen.z
    h, H_r, H_m = filter_.model.observe(filter_.x[:3], filter_.points)
    S = innovation_covs(filter_, H_r, H_m)[None] + seen.R[:, None]
    spread2 = tracks.spread2[filter_.local][None] + SPREAD**2
    r2 = np.maximum(z[:, :1] ** 2, 1e-12)
    S[..., 0, 0] += spread2
    S[..., 1, 1] += spread2 / r2
    d2 = mahalanobis2(filter_.model.innovation(z[:, None], h[None]), S)
    # the density of range and bearing over that of the plane is the range
    log_det = np.log(np.linalg.det(S) * r2)
    return -0.5 * (d2 + log_det) - math.log(2.0 * math.pi), d2
