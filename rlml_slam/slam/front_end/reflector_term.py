# SPDX-License-Identifier: Apache-2.0
"""The reflector term: which detection is of which reflector, and what that says (e_R of eq. 2)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.estimation.kidnapping_detection import consents
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.matching.reflectors import association
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.inactive_landmarks import InactiveLandmarks
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.map_window import MapWindow
from rlml_slam.slam.front_end.reflector_update import use_reflectors
from rlml_slam.slam.landmarks.visibility import expected
from rlml_slam.types import ANONYMOUS, Belief, Detections, Observation, Reflectors, Status

NONE = np.zeros(0, dtype=np.int64)
# as plain numbers: a member of an enumeration takes longer to be looked up than to be compared
USED, GHOST = int(Status.USED), int(Status.GHOST)
NEW, DEFERRED, AMBIGUOUS = int(Status.NEW), int(Status.DEFERRED), int(Status.AMBIGUOUS)


class Matched:
    """What became of each detection (k) so far in one step."""

    def __init__(self, k: int) -> None:
        self.index = np.full(k, -1, dtype=np.int64)
        self.keys = np.full(k, -1, dtype=np.int64)
        self.status = np.full(k, NEW, dtype=np.int64)
        self.distance2 = np.full(k, np.nan)

    @classmethod
    def none(cls, detections: Detections | None) -> Matched:
        """Of detections of which nothing is known yet."""
        return cls(0 if detections is None else len(detections))

    @property
    def num_used(self) -> int:
        """Detections that moved the estimate."""
        return int(np.count_nonzero(self.status == USED))

    @property
    def agrees(self) -> bool:
        """Whether enough of them match to speak for the map."""
        return consents(len(self.status), self.num_used)

    @property
    def open(self) -> NDArray[np.bool_]:
        """Detections without a reflector."""
        return self.index < 0


class ReflectorTerm:
    """The reflectors of a joint state: ``tracks`` tells whose its landmarks are, row by row."""

    def __init__(self, params: Parameters, state: JointState) -> None:
        self._p = params
        self._state = state
        self.tracks = LandmarkTracks()
        self._associator = association.Associator(params.reflector)
        self._contradiction = association.gate(params.reflector.new_gate)
        self._window: MapWindow | None = None
        r = params.reflector
        self._distant = InactiveLandmarks(r.max_range, r.min_sightings)
        self._reach = 0.0

    def use_map(self, reflectors: Reflectors) -> None:
        """Have these (map frame), and never others."""
        self._window = MapWindow(reflectors, self._p.reflector.max_range)
        self._window.follow(self._state, self.tracks)

    def follow(self, detections: Detections | None) -> None:
        """Only reflectors in reach are in the state."""
        if self._window is not None:
            self._window.follow(self._state, self.tracks)
        elif self._p.node.mode == 'mapping':
            ids = NONE if detections is None else detections.ids
            self._distant.follow(self._state, self.tracks, ids)

    def use(self, observation: Observation, matched: Matched) -> None:
        """Associate what is not yet associated and update with it (e_R of eq. 2)."""
        detections = observation.detections
        if detections is None or not matched.open.any():
            return
        rows = np.flatnonzero(matched.open)
        afresh = len(rows) == len(detections)
        result = self._associator.associate(
            detections if afresh else _subset(detections, rows),
            association.Believed(
                self._state.pose,
                self._state.landmarks(),
                self.tracks.ids,
                self._state.pose_and_landmarks_cov(),
                self._recent(observation.stamp),
                self.tracks.spread2,
            ),
        )
        used = result.match >= 0
        matched.status[rows] = result.status
        if not afresh:
            taken = used & (result.match[:, None] == matched.index).any(axis=1)
            matched.status[rows[taken]] = AMBIGUOUS
            used &= ~taken
        if not used.any():
            return
        k, index = rows[used], result.match[used]
        matched.index[k] = index
        matched.distance2[k] = result.distance2[used]
        use_reflectors(
            self._state.x, self._state.P, index, detections.points[k], detections.cov[k],
            self.tracks.spread2[index], matched.distance2[k], self._p.reflector.robust_scale,
        )  # fmt: skip
        self.tracks.see(index, observation.stamp, detections.ids[k])

    def _recent(self, stamp: int) -> NDArray[np.bool_] | None:
        """(m,): reflectors that were in view a moment ago; a given map needs no such care."""
        if self._p.node.mode != 'mapping':
            return None
        return stamp - self.tracks.last_seen < self._p.reflector.track_timeout * 1e9

    def with_spread(self, observation: Observation, matched: Matched) -> Observation:
        """The observation with what its detections' groups add to their noise; learns of groups.

        Where two detections at once are of one reflector, that is several which cannot be told
        apart, and each detection is of any of them.
        """
        detections = observation.detections
        if detections is None or not len(detections):
            return observation
        seen = np.flatnonzero(matched.index >= 0)
        spread2 = np.zeros(len(detections))
        spread2[seen] = self.tracks.spread2[matched.index[seen]]
        if self._p.node.mode == 'mapping' and 0 < len(seen) < len(detections):
            double = self._associator.doubles(detections, matched.index)
            for k in np.flatnonzero(double >= 0):
                gap = detections.points[k] - detections.points[double[k]]
                self.tracks.see_double(int(matched.index[double[k]]), float(np.linalg.norm(gap)))
        if not spread2.any():
            return observation
        cov = detections.cov + spread2[:, None, None] * np.eye(2)
        return replace(observation, detections=replace(detections, cov=cov))

    def grow(self, observation: Observation, matched: Matched, doubtful: bool) -> None:
        """New reflectors enter as candidates, candidates not seen again leave."""
        p, detections = self._p.reflector, observation.detections
        if self._p.node.mode != 'mapping':
            # a map that never changes has all reflectors that there are
            matched.status[matched.status == NEW] = GHOST
        elif detections is not None and not doubtful:
            fresh = (matched.status == NEW) | (matched.status == DEFERRED)
            for k in np.flatnonzero(fresh):
                matched.index[k] = self._state.add_landmark(
                    detections.points[k], detections.cov[k]
                )
                self.tracks.append(
                    observation.stamp, int(detections.ids[k]), float(detections.diameters[k])
                )
        seen = matched.index >= 0
        matched.keys[seen] = self.tracks.keys[matched.index[seen]]
        if detections is not None:
            # what tells its id is known even where it does not fit: the back end weighs it
            for k in np.flatnonzero(~seen & (detections.ids != ANONYMOUS)):
                same = np.flatnonzero(self.tracks.ids == detections.ids[k])
                if len(same):
                    matched.keys[k] = self.tracks.keys[same[0]]
        drop = self.tracks.stale(observation.stamp, p.min_sightings, p.candidate_timeout)
        if drop.any():
            self._state.remove_landmarks(~drop)
            self.tracks.keep(~drop)

    def due(self, observation: Observation, matched: Matched) -> NDArray[np.bool_]:
        """Which reflectors (m,) should have been detected; none where no one looked for them."""
        d, m = observation.detections, len(self.tracks)
        if d is None or observation.points is None or observation.origin is None:
            return np.zeros(m, dtype=np.bool_)
        used = d.points[matched.status == USED]
        if len(used):
            self._reach = max(self._reach, float(np.hypot(used[:, 0], used[:, 1]).max()))
        due: NDArray[np.bool_] = self.tracks.confirmed(self._p.reflector.min_sightings)
        due &= expected(
            self._state.pose, self._state.landmarks(), observation.points, observation.origin,
            self._reach,
        )  # fmt: skip
        return due

    def contradicts(self, belief: Belief, T_map_local: Array) -> bool:
        """Whether the back end's reflectors are not where the state has them.

        Both come from the same detections, so a difference beyond the gate is no noise: one of
        them linearised too early, or took one reflector for another, and it is not the graph.
        """
        keys, places, covs = self._distant.everything(self._state, self.tracks)
        _, mine, theirs = np.intersect1d(keys, belief.keys, return_indices=True)
        if not len(mine):
            return False
        points = se2.transform(se2.inverse(T_map_local), belief.points[theirs])
        d = points - places[mine]
        spread = covs[mine]
        d2 = np.einsum('ni,ni->n', d, np.linalg.solve(spread, d[..., None])[..., 0])
        return bool((d2 > self._contradiction).any())

    def adopt(self, belief: Belief, T_map_local: Array, bias: Array) -> None:
        """Go on from the back end's reflectors, and its covariance of them and of the pose.

        The local pose stays as it is; candidates that the back end does not know start anew.
        ``bias`` (3, 3) is the covariance that an anchor begun now has of its own.
        """
        self._distant.gather(self._state, self.tracks)
        self.tracks.rename(belief.aliases)
        _, mine, theirs = np.intersect1d(self.tracks.keys, belief.keys, return_indices=True)
        keep = np.zeros(len(self.tracks), dtype=np.bool_)
        keep[mine] = True
        order = theirs[np.argsort(mine, kind='stable')]
        self.tracks.keep(keep)
        inverse = se2.inverse(T_map_local)
        columns = np.concatenate([[0, 1, 2], np.stack([3 + 2 * order, 4 + 2 * order], 1).ravel()])
        T = np.eye(len(columns))
        R = se2.rotation(inverse[2])
        T[:2, :2] = R
        for k in range(3, len(columns), 2):
            T[k : k + 2, k : k + 2] = R
        cov = T @ belief.cov[np.ix_(columns, columns)] @ T.T
        self._state.replace(se2.transform(inverse, belief.points[order]), cov, bias)

    def forget(self, keys: Iterable[int]) -> None:
        """Drop reflectors that the back end knows to be gone."""
        gone = np.array(list(keys), dtype=np.int64)
        if self._distant.has(gone):
            self._distant.gather(self._state, self.tracks)
        keep = ~np.isin(self.tracks.keys, gone)
        if not keep.all():
            self._state.remove_landmarks(keep)
            self.tracks.keep(keep)

    def confirmed(self, T_map_local: Array) -> Reflectors:
        """The confirmed reflectors in the map frame."""
        # those out of the state come after those in it, as in everything()
        tracks = self._distant.all_tracks(self.tracks)
        _, places, covs = self._distant.everything(self._state, self.tracks)
        keep = tracks.confirmed(self._p.reflector.min_sightings)
        R = se2.rotation(T_map_local[2])
        return Reflectors(
            tracks.keys[keep],
            se2.transform(T_map_local, places[keep]),
            R @ covs[keep] @ R.T,
            tracks.ids[keep],
            tracks.sightings[keep],
            tracks.diameters[keep],
        )


def _subset(d: Detections, rows: NDArray[np.int64]) -> Detections:
    return Detections(
        d.stamp, d.frame_id, d.points[rows], d.cov[rows], d.ids[rows], d.diameters[rows]
    )
