# SPDX-License-Identifier: Apache-2.0
"""The reflector term: association of detections and update with them (e_R of eq. 2)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.estimation.kidnapping_detection import FEW, RECENT, agree_with_map
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.matching.reflectors import association
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.inactive_landmarks import InactiveLandmarks
from rlml_slam.slam.front_end.joint_state import JointState
from rlml_slam.slam.front_end.map_window import MapWindow
from rlml_slam.slam.front_end.reflector_update import use_reflectors
from rlml_slam.slam.landmarks.visibility import expected, sectors
from rlml_slam.types import ANONYMOUS, Belief, Detections, Observation, Reflectors, Status

NONE = np.zeros(0, dtype=np.int64)
# as plain integers: comparing arrays with members of an enumeration is slow
USED, GHOST = int(Status.USED), int(Status.GHOST)
SLIP = 1.0  # 1 sigma, as a share of the motion, of wheels that spin or are locked
WIDTH = 1.0  # [m] of a robot, which one wheel that slips turns
KNOWN = 0.5  # [rad] 1 sigma of a heading
AGREEING = 2.0 / 3.0  # share of the detections that have to match; of a carried robot, some do
NEW, DEFERRED, AMBIGUOUS = int(Status.NEW), int(Status.DEFERRED), int(Status.AMBIGUOUS)


@dataclass(frozen=True)
class Matches:
    """Association of the detections (k,) of one observation.

    ``index``: reflector in the state, -1 if none; ``keys``: its key; ``status``: a Status;
    ``distance2``: squared Mahalanobis distance of the innovation, NaN if unmatched.
    """

    index: NDArray[np.int64]
    keys: NDArray[np.int64]
    status: NDArray[np.int64]
    distance2: Array

    @classmethod
    def none(cls, k: int) -> Matches:
        """No detection is matched yet."""
        return cls(
            np.full(k, -1, dtype=np.int64), np.full(k, -1, dtype=np.int64),
            np.full(k, NEW, dtype=np.int64), np.full(k, np.nan),
        )  # fmt: skip

    @property
    def num_used(self) -> int:
        """Number of detections that updated the estimate."""
        return int(np.count_nonzero(self.status == USED))

    @property
    def agree_with_map(self) -> bool:
        """Whether enough detections match to confirm the map."""
        return agree_with_map(len(self.status), self.num_used)

    @property
    def unmatched(self) -> NDArray[np.bool_]:
        """(k,): detections without a reflector."""
        return self.index < 0

    def num_unmatched_ids(self, detections: Detections | None) -> int:
        """Number of unmatched detections that have an id."""
        if detections is None:
            return 0
        return int(((detections.ids != ANONYMOUS) & self.unmatched).sum())


class Slip:
    """Motion since reflectors last agreed with the map: wheels may have slipped (eq. 60).

    ``cov`` (3, 3) is that of the slip which the newest observation showed, zeros for none.
    """

    def __init__(self) -> None:
        # stamps [ns] of the last observation at which they did, and of the newest
        self._agreed = self._stamp = -(2**62)
        self._way = np.zeros(2)  # distance [m] and turn [rad] since
        self.cov = np.zeros((3, 3))

    def move(self, observation: Observation, velocity: Array) -> None:
        """Begin an observation; ``velocity`` (3,) until then: wheels that are locked slide."""
        dt = min((observation.stamp - self._stamp) * 1e-9, RECENT)
        way = np.maximum(np.abs(observation.motion.delta), dt * np.abs(velocity))
        self._way += math.hypot(way[0], way[1]), way[2]
        self._stamp, self.cov = observation.stamp, np.zeros((3, 3))

    def possible(self, match: NDArray[np.int64]) -> Array | None:
        """Covariance (3, 3) of slip where reflectors agreed shortly before, and do not now.

        ``match`` (k,) is the association without slip, -1 for none.
        """
        if agrees(match):
            self.agree(self.cov)
            return None
        if not 0 <= self._stamp - self._agreed <= RECENT * 1e9 or len(match) < FEW:
            return None
        distance, turn = self._way
        return np.diag((SLIP * np.array([distance, distance, turn + distance / WIDTH])) ** 2)

    def agree(self, cov: Array) -> None:
        """Reflectors agree with the map after slip of ``cov`` (3, 3)."""
        self.cov, self._agreed, self._way = cov, self._stamp, np.zeros(2)


def agrees(match: NDArray[np.int64]) -> bool:
    """Whether so many detections (k,) match that the motion was right, not some by chance."""
    return int(np.count_nonzero(match >= 0)) >= max(FEW, AGREEING * len(match))


class ReflectorTerm:
    """Reflectors of a joint state; ``tracks`` has their identities, row by row."""

    def __init__(self, params: Parameters, state: JointState) -> None:
        self._p = params
        self._state = state
        self.tracks = LandmarkTracks()
        self._associator = association.Associator(params.reflector)
        self._gate2 = association.gate(params.reflector.new_gate)
        self._window: MapWindow | None = None
        r = params.reflector
        self._inactive = InactiveLandmarks(r.max_range, r.min_sightings)
        self._max_range_seen = 0.0
        self._slip = Slip()
        self._muted = sectors(self._p.reflector.muted_sectors)

    def use_map(self, reflectors: Reflectors) -> None:
        """Use the reflectors of a saved map (map frame), and no others."""
        self._window = MapWindow(reflectors, self._p.reflector.max_range)
        self._window.update(self._state, self.tracks)

    def begin(self, observation: Observation, velocity: Array) -> Matches:
        """Keep only the reflectors in range in the state; update it with the detections.

        Wheels may have slipped, at the ``velocity`` (3,) of the robot until now.
        """
        detections = observation.detections
        self._slip.move(observation, velocity)
        if self._window is not None:
            self._window.update(self._state, self.tracks)
        elif self._p.node.mode == 'mapping':
            ids = NONE if detections is None else detections.ids
            self._inactive.update(self._state, self.tracks, ids)
        none = Matches.none(0 if detections is None else len(detections))
        return self.update(observation, none, may_slip=True)

    def update(
        self, observation: Observation, matches: Matches, may_slip: bool = False
    ) -> Matches:
        """Associate the unmatched detections and update the state with them (e_R of eq. 2).

        With ``may_slip``, detections that agree with the map only if the wheels slipped widen the
        pose by as much.
        """
        detections = observation.detections
        rows = np.flatnonzero(matches.unmatched)
        if detections is None or not len(rows):
            return matches
        is_first = len(rows) == len(detections)
        given = detections if is_first else _subset(detections, rows)
        result = self._associate(given, observation.stamp, np.zeros((3, 3)))
        slip = self._slip.possible(result.match) if may_slip else None
        if slip is not None:
            again = self._associate(given, observation.stamp, slip)
            if agrees(again.match):
                self._state.widen(slip)
                self._slip.agree(slip)
                result = again
        index, status, distance2 = (
            matches.index.copy(), matches.status.copy(), matches.distance2.copy()
        )  # fmt: skip
        used = result.match >= 0
        status[rows] = result.status
        if not is_first:
            taken = used & (result.match[:, None] == index).any(axis=1)
            status[rows[taken]] = AMBIGUOUS
            used &= ~taken
        if used.any():
            k, landmarks = rows[used], result.match[used]
            index[k], distance2[k] = landmarks, result.distance2[used]
            use_reflectors(
                self._state.x, self._state.P, landmarks, detections.points[k], detections.cov[k],
                self.tracks.spread2[landmarks], distance2[k], self._p.reflector.robust_scale,
            )  # fmt: skip
            self.tracks.see(landmarks, observation.stamp, detections.ids[k])
        return Matches(index, matches.keys, status, distance2)

    def _associate(
        self, detections: Detections, stamp: int, cov: Array
    ) -> association.Association:
        """Detections and reflectors, for a pose that is uncertain by ``cov`` (3, 3) besides."""
        joint = self._state.pose_and_landmarks_cov()
        joint[:3, :3] += cov
        believed = association.Believed(
            self._state.pose, self._state.landmarks(), self.tracks.ids, joint,
            self._recent(stamp), self.tracks.spread2,
        )  # fmt: skip
        return self._associator.associate(detections, believed)

    def _recent(self, stamp: int) -> NDArray[np.bool_] | None:
        """(m,): reflectors seen within ``track_timeout``; None in a saved map, which is fixed."""
        if self._p.node.mode != 'mapping':
            return None
        return stamp - self.tracks.last_seen < self._p.reflector.track_timeout * 1e9

    def forget_slip(self) -> None:
        """The pose was moved: reflectors did not agree there before."""
        self._slip = Slip()

    def widen(self, observation: Observation, matches: Matches) -> Observation:
        """Add slip to the noise of the motion, and spread of groups to that of their detections.

        A group are several reflectors that are closer than they can be distinguished. It is one
        reflector of the state; two detections of it at once show that it is a group.
        """
        detections = observation.detections
        if detections is None or not len(detections):
            return observation
        if self._slip.cov.any():
            observation = observation.with_noise(self._slip.cov)
        seen = np.flatnonzero(matches.index >= 0)
        spread2 = np.zeros(len(detections))
        spread2[seen] = self.tracks.spread2[matches.index[seen]]
        if self._p.node.mode == 'mapping' and 0 < len(seen) < len(detections):
            double = self._associator.doubles(detections, matches.index)
            for k in np.flatnonzero(double >= 0):
                gap = detections.points[k] - detections.points[double[k]]
                self.tracks.see_double(int(matches.index[double[k]]), float(np.linalg.norm(gap)))
        if not spread2.any():
            return observation
        cov = detections.cov + spread2[:, None, None] * np.eye(2)
        return replace(observation, detections=replace(detections, cov=cov))

    def grow(self, observation: Observation, matches: Matches, contradicted: bool) -> Matches:
        """Add new reflectors as candidates, drop stale candidates; matches with keys."""
        p, detections = self._p.reflector, observation.detections
        index, keys, status = matches.index.copy(), matches.keys.copy(), matches.status.copy()
        if self._p.node.mode != 'mapping':
            status[status == NEW] = GHOST  # a saved map does not grow
        elif detections is not None and not contradicted:
            for k in np.flatnonzero((status == NEW) | (status == DEFERRED)):
                index[k] = self._state.add_landmark(detections.points[k], detections.cov[k])
                self.tracks.append(
                    observation.stamp, int(detections.ids[k]), float(detections.diameters[k])
                )
        seen = index >= 0
        keys[seen] = self.tracks.keys[index[seen]]
        if detections is not None:
            # an id is known even if the detection does not match: the back end decides
            for k in np.flatnonzero(~seen & (detections.ids != ANONYMOUS)):
                same = np.flatnonzero(self.tracks.ids == detections.ids[k])
                if len(same):
                    keys[k] = self.tracks.keys[same[0]]
        drop = self.tracks.stale(observation.stamp, p.min_sightings, p.candidate_timeout)
        if drop.any():
            self._state.remove_landmarks(~drop)
            self.tracks.keep(~drop)
        return Matches(index, keys, status, matches.distance2)

    def expected_and_seen(self, observation: Observation, matches: Matches) -> tuple[int, int]:
        """Number of reflectors that should be in view, and how many of these were matched."""
        d = observation.detections
        if d is None or observation.points is None or observation.origin is None:
            return 0, 0
        used = matches.status == USED
        points = d.points[used]
        if len(points):
            farthest = float(np.hypot(points[:, 0], points[:, 1]).max())
            self._max_range_seen = max(self._max_range_seen, farthest)
        due: NDArray[np.bool_] = self.tracks.confirmed(self._p.reflector.min_sightings)
        due &= expected(
            self._state.pose, self._state.landmarks(), observation.points, observation.origin,
            self._max_range_seen, self._muted,
        )  # fmt: skip
        seen = set(self.tracks.keys[due].tolist()).intersection(matches.keys[used].tolist())
        return int(due.sum()), len(seen)

    def contradicts(self, belief: Belief, T_map_local: Array) -> bool:
        """Whether the reflectors of the back end are outside the gates of those of the state.

        Both have the same detections, so that a larger difference is no noise: the state
        linearized too early, or has a wrong association, which the graph has corrected. But not
        while the graph does not know the heading of the robot: no filter can be linearized there.
        """
        if belief.cov[2, 2] > KNOWN**2:
            return False
        keys, places, covs = self._inactive.all_landmarks(self._state, self.tracks)
        _, mine, theirs = np.intersect1d(keys, belief.keys, return_indices=True)
        if not len(mine):
            return False
        points = se2.transform(se2.inverse(T_map_local), belief.points[theirs])
        d = points - places[mine]
        spread = covs[mine]
        d2 = np.einsum('ni,ni->n', d, np.linalg.solve(spread, d[..., None])[..., 0])
        return bool((d2 > self._gate2).any())

    def adopt(self, belief: Belief, T_map_local: Array, bias: Array) -> None:
        """Replace reflectors and their joint covariance with the pose by those of the back end.

        The local pose stays; candidates that the back end does not have are dropped. ``bias``
        (3, 3) is the covariance of the error of a submap that starts now.
        """
        self._inactive.restore(self._state, self.tracks)
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
        """Drop reflectors that the back end has removed."""
        removed = np.array(list(keys), dtype=np.int64)
        if self._inactive.has(removed):
            self._inactive.restore(self._state, self.tracks)
        keep = ~np.isin(self.tracks.keys, removed)
        if not keep.all():
            self._state.remove_landmarks(keep)
            self.tracks.keep(keep)

    def forget_anonymous(self) -> None:
        """Drop those without ids: a robot that may be anywhere sees any of them."""
        self._inactive.restore(self._state, self.tracks)
        self.forget(self.tracks.keys[self.tracks.ids == ANONYMOUS])

    def confirmed(self, T_map_local: Array) -> Reflectors:
        """The confirmed reflectors in the map frame."""
        # inactive reflectors come after those of the state, as in all_landmarks()
        tracks = self._inactive.all_tracks(self.tracks)
        _, places, covs = self._inactive.all_landmarks(self._state, self.tracks)
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
