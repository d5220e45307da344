# SPDX-License-Identifier: Apache-2.0
"""Association of measurements with landmarks of the state, by the selected method."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rlml_slam.ekf.association import compatible_ids, mahalanobis2, nearest
from rlml_slam.ekf.extraction import Measured
from rlml_slam.ekf.filter import Filter, innovation_covs
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.matching.reflectors.association import Association, Associator, Believed, gate
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Status


class Matcher:
    """Association with the thresholds of one parameter set.

    ``defers``: ambiguous measurements are associated later, by branches.
    """

    def __init__(self, params: EkfParameters) -> None:
        e = self._p = params.ekf
        self._reflector = params.reflector
        self.gate, self._new_gate = gate(e.gate), gate(e.new_gate)
        self._joint: Associator | None = None
        # extracted features are too many, and too short-lived, for branches
        auto = 'deferred' if e.extractor == 'reflectors' else 'nearest'
        association = auto if e.association == 'auto' else e.association
        # lines have no position for the test of joint compatibility
        if association != 'nearest' and e.extractor != 'lines':
            self._joint = Associator(
                dataclasses.replace(
                    params.reflector, gate=e.gate, new_gate=e.new_gate,
                    min_separation=e.min_separation,
                )
            )  # fmt: skip
        self.defers = association == 'deferred' and self._joint is not None

    def match(
        self, seen: Measured, filter_: Filter, tracks: LandmarkTracks, stamp: int
    ) -> Association:
        """Associate measurements (k,) with the filter's local landmarks, by their slot."""
        # with ids, joint compatibility adds nothing
        if self._joint is None or (seen.detections.ids != ANONYMOUS).all():
            return self._nearest(seen, filter_, tracks.ids[filter_.local])
        local = filter_.local
        recent = stamp - tracks.last_seen[local] < self._reflector.track_timeout * 1e9
        return self._joint.associate(
            seen.detections,
            Believed(
                filter_.pose, filter_.points, tracks.ids[local], filter_.pose_and_points_cov(),
                recent if self.defers else None, tracks.spread2[local] if self.defers else None,
            ),
        )  # fmt: skip

    def learn_spread(
        self, seen: Measured, found: Association, local: NDArray[np.int64], tracks: LandmarkTracks
    ) -> None:
        """Learn the spread of a landmark that is several close ones, from double detections."""
        assert self._joint is not None
        points = seen.detections.points
        double = self._joint.doubles(seen.detections, found.match)
        for k in np.flatnonzero(double >= 0):
            gap = float(np.linalg.norm(points[k] - points[double[k]]))
            tracks.see_double(int(local[found.match[double[k]]]), gap)

    def _nearest(self, seen: Measured, filter_: Filter, ids: NDArray[np.int64]) -> Association:
        """Nearest neighbour within the gate; a known id uses the wider new-landmark gate."""
        z, detections, k = seen.z, seen.detections, len(seen.z)
        slots, statuses = np.full(k, -1, dtype=np.int64), np.full(k, Status.NEW, dtype=np.int64)
        if not len(ids):
            return Association(slots, statuses, np.full(k, np.nan))
        model = filter_.model
        h, H_r, H_m = model.observe(filter_.x[:3], filter_.points)
        nu = model.innovation(z[:, None], h[None])
        d2 = mahalanobis2(nu, innovation_covs(filter_, H_r, H_m)[None] + seen.R[:, None])
        same_id = (detections.ids[:, None] == ids[None]) & (ids[None] != ANONYMOUS)
        gated = np.where(same_id, np.where(d2 <= self._new_gate, 0.0, np.inf), d2)
        same = compatible_ids(detections.ids, ids)
        slots = nearest(np.where(same, gated, np.inf), self.gate)
        statuses[slots >= 0] = Status.USED
        statuses[(slots < 0) & self._is_known(seen, filter_, d2, same_id)] = Status.GATED
        best = np.where(slots >= 0, d2[np.arange(k), np.maximum(slots, 0)], np.nan)
        return Association(slots, statuses, best)

    def _is_known(
        self, seen: Measured, filter_: Filter, d2: Array, same_id: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """(k,): too close to a landmark, though outside of its gate, to start a candidate."""
        where = filter_.model.place(filter_.x[:3], seen.z)[0]
        gap = np.linalg.norm(where[:, None] - filter_.points[None], axis=-1)
        sigma = np.sqrt(np.linalg.eigvalsh(seen.detections.cov)[:, -1])
        blur = self._reflector.separability_sigma * sigma
        near = gap.min(axis=1) < np.maximum(self._p.min_separation, blur)
        near |= d2.min(axis=1) <= self._new_gate
        # a detection with an id is new if no landmark has it
        anonymous = seen.detections.ids == ANONYMOUS
        out: NDArray[np.bool_] = (near & anonymous) | same_id.any(axis=1)
        return out
