# SPDX-License-Identifier: Apache-2.0
"""Candidates: landmarks that have not been seen often enough, relative to the robot.

A candidate is moved with the odometry and compared with detections in the robot's frame, so that
its covariance contains the noise of measurements and motion, but not the error of the pose. It
enters the state with its last measurement alone, which the filter has not used yet.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rlml_slam.ekf.association import compatible_ids, mahalanobis2, nearest
from rlml_slam.estimation.landmark_models import Model
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS

_ORIGIN = np.zeros(3)


class Candidates:
    """Columns (c,): ``z`` (c, 2) and ``cov`` (c, 2, 2) as measured from where the robot is now."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self.z = np.zeros((0, 2))
        self.cov = np.zeros((0, 2, 2))
        self.ids = np.zeros(0, dtype=np.int64)
        self.sightings = np.zeros(0, dtype=np.int64)
        self.last_seen = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.z)

    def move(self, delta: Array, cov: Array) -> None:
        """The robot moved by ``delta`` (3,) with covariance (3, 3), in its frame before."""
        if not len(self):
            return
        m, _, J_z = self._model.place(_ORIGIN, self.z)
        self.z, H_r, H_m = self._model.observe(delta, m)
        J = H_m @ J_z
        self.cov = J @ self.cov @ J.transpose(0, 2, 1) + H_r @ cov @ H_r.transpose(0, 2, 1)

    def see(
        self, stamp: int, z: Array, R: Array, ids: NDArray[np.int64], gate: float
    ) -> NDArray[np.int64]:
        """Number (k,) of sightings of the candidate of each detection, these included.

        A detection without a candidate starts one.
        """
        nu = self._model.innovation(z[:, None], self.z[None])
        d2 = mahalanobis2(nu, R[:, None] + self.cov[None])
        match = nearest(np.where(compatible_ids(ids, self.ids), d2, np.inf), gate)
        out = np.ones(len(z), dtype=np.int64)
        seen = np.flatnonzero(match >= 0)
        if len(seen):
            c = match[seen]
            K = self.cov[c] @ np.linalg.inv(self.cov[c] + R[seen])
            self.z[c] += np.einsum('kij,kj->ki', K, nu[seen, c])
            self.cov[c] -= K @ self.cov[c]
            self.sightings[c] += 1
            self.last_seen[c] = stamp
            has_id = ids[seen] != ANONYMOUS
            self.ids[c[has_id]] = ids[seen][has_id]
            out[seen] = self.sightings[c]
        new = match < 0
        k = int(new.sum())
        self.z = np.concatenate([self.z, z[new]])
        self.cov = np.concatenate([self.cov, R[new]])
        self.ids = np.concatenate([self.ids, ids[new]])
        self.sightings = np.concatenate([self.sightings, np.ones(k, dtype=np.int64)])
        self.last_seen = np.concatenate([self.last_seen, np.full(k, stamp, dtype=np.int64)])
        return out

    def drop(self, now: int, sightings: int, timeout: float, sigma: float) -> None:
        """Drop those that became landmarks, timed out, or have a large covariance."""
        J = self._model.place(_ORIGIN, self.z)[2]
        area = J @ self.cov @ J.transpose(0, 2, 1)
        sure = area[:, 0, 0] + area[:, 1, 1] <= 2.0 * sigma**2
        keep = (self.sightings < sightings) & (now - self.last_seen <= timeout * 1e9) & sure
        if not keep.all():
            for name in ('z', 'cov', 'ids', 'sightings', 'last_seen'):
                setattr(self, name, getattr(self, name)[keep])
