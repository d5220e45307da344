# SPDX-License-Identifier: Apache-2.0
"""Branch of the multi-hypothesis EKF: a filter, and the associations that it assumes.

An estimator has one branch while all measurements are associated uniquely. A landmark that comes
back into view and fits several, or one that would be new, splits it into a branch for each
association; later measurements change their weights (multiple hypotheses, Reid 1979).
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.ekf.association import compatible_ids
from rlml_slam.ekf.branch_path import BranchPath
from rlml_slam.ekf.candidates import Candidates
from rlml_slam.ekf.compressed_updates import CompressedUpdates
from rlml_slam.ekf.extraction import Measured
from rlml_slam.ekf.filter import Filter
from rlml_slam.ekf.likelihood import MIN_WEIGHT, log_density
from rlml_slam.ekf.matching import Matcher
from rlml_slam.estimation.landmark_merging import MERGE_DISTANCE, MergeTest
from rlml_slam.estimation.landmark_models import POINT
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.estimation.smoother import BIAS, ROBOT, Sight, Step
from rlml_slam.matching.reflectors.multi_hypothesis import GATE, OUTLIER, TOGETHER, UNKNOWN
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Motion, Reflectors, Status

# squared Mahalanobis distance of the poses and distance [m] of landmarks below which two branches
# are equal
EQUAL_POSE, EQUAL_POINT = 0.1, 0.1
MAX_BRANCHES = 32
MAX_MEASUREMENTS = 64  # of all branches in a frame: with many at once there are fewer branches
MAX_VALUES = 2e7  # of all covariances: with very many landmarks there are fewer branches


@dataclass(frozen=True)
class Associations:
    """Result for the measurements of one frame: keys, statuses (k,) and their chi²."""

    keys: NDArray[np.int64]
    statuses: NDArray[np.int64]
    chi2: float

    @classmethod
    def none(cls) -> Associations:
        """Result of a frame without measurements."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, empty, 0.0)


@dataclass(frozen=True)
class MeasuredFrame:
    """Measurements of one frame; ``weight`` in 0 .. 1, for they are correlated with the last ones.

    ``key_of`` (measurement) is the key of the landmark that it starts, the same in all branches.
    """

    seen: Measured
    stamp: int
    weight: float
    mapping: bool
    key_of: Callable[[int], int]


class Branch:
    """``weight`` is the log likelihood of its associations, up to a common constant.

    ``distinct`` are pairs of keys that were seen at one time.
    """

    def __init__(self, params: EkfParameters, matcher: Matcher, filter_: Filter) -> None:
        self._p = params
        self._matcher = matcher
        self.filter = filter_
        self.candidates = Candidates(filter_.model)
        self.tracks = LandmarkTracks()
        self.distinct: frozenset[tuple[int, int]] = frozenset()
        self.weight = 0.0
        self.path = BranchPath()
        self.associations = Associations.none()
        self._region: Array | None = None
        self._radius = self._reach = 0.0
        self._same = MergeTest(
            matcher.gate, params.ekf.min_separation, params.reflector.match_probability,
            params.reflector.unmapped_density,
        )  # fmt: skip
        self._log_new = math.log(UNKNOWN * params.reflector.unmapped_density)

    def copy(self) -> Branch:
        """Independent copy."""
        out = copy.copy(self)
        out.filter = _copy(self.filter)
        out.candidates = _copy(self.candidates)
        out.tracks = _copy(self.tracks)
        out.path = self.path.copy()
        return out

    def use_map(self, reflectors: Reflectors) -> None:
        """Add the landmarks of a given map (map frame)."""
        self.filter.settle()
        for k in range(len(reflectors)):
            self.filter.fix(reflectors.points[k], reflectors.cov[k])
            self.tracks.append(
                0, int(reflectors.ids[k]), float(reflectors.diameters[k]), surveyed=True
            )
            self.tracks.sightings[-1] = reflectors.sightings[k]

    def reflectors(self) -> Reflectors:
        """All landmarks of the state, in the map frame."""
        self.filter.settle()
        self._region = None
        t = self.tracks
        return Reflectors(
            t.keys.copy(), self.filter.points.copy(), self.filter.point_covs(),
            t.ids.copy(), t.sightings.copy(), t.diameters.copy(),
        )  # fmt: skip

    def predict(self, motion: Motion, walk: float, kept: float) -> None:
        """Step 1: odometry; ``walk`` and ``kept`` as in :meth:`Filter.predict`."""
        self.associations = Associations.none()
        f = self.filter
        delta, gains = f.corrected(motion)
        lasting = gains @ f.P[BIAS:ROBOT, BIAS:ROBOT] @ gains.T
        used_bias = f.predict(motion, walk, kept)
        self.candidates.move(delta, motion.cov + lasting)
        # the smoother uses the same measurements as the filter
        used = motion if used_bias else dataclasses.replace(motion, bias_var=math.inf)
        self.path.step = Step(used, walk, kept)

    def update(self, frame: MeasuredFrame) -> list[Branch]:
        """Steps 2 and 3: update known landmarks, count new ones; the resulting branches."""
        seen, f = frame.seen, self.filter
        self._choose_region(seen)
        if not len(seen.z):
            self._forget_candidates(frame.stamp)
            return [self]
        found = self._matcher.match(seen, f, self.tracks, frame.stamp)
        used = found.match >= 0
        keys = np.full(len(seen.z), -1, dtype=np.int64)
        keys[used] = self.tracks.keys[f.local[found.match[used]]]
        self.associations = Associations(keys, found.status, float(found.distance2[used].sum()))
        if self._matcher.defers:
            self.weight += frame.weight * self._evidence(seen, found.match)
            if frame.mapping:
                self._matcher.learn_spread(seen, found, f.local, self.tracks)
        for i in np.flatnonzero(used):
            self._update_landmark(frame, int(i), int(found.match[i]))
        if self._matcher.defers and frame.mapping:
            self._merge(keys)
        return self._add_new(frame)

    def _choose_region(self, seen: Measured) -> None:
        """Update the landmarks near the robot only; choose them again when it leaves the region.

        The region contains the largest range measured so far. Lines have no position, so all of
        them are always updated.
        """
        e, f = self._p.ekf, self.filter
        if e.update == 'plain' or f.model is not POINT:
            return
        if len(seen.z):
            self._reach = max(self._reach, float(np.max(seen.z[:, 0])))
        here = f.x[:2]
        sigma = 3.0 * float(np.sqrt(np.trace(f.P[:2, :2])))
        needed = self._reach + sigma
        region = self._region
        if region is not None and np.hypot(*(here - region)) + needed <= self._radius:
            return
        f.settle()
        self._region = here.copy()
        self._radius = max(e.local_radius, needed) + e.local_margin
        f.choose(np.hypot(*(f.points - here).T) <= self._radius)

    def _update_landmark(self, frame: MeasuredFrame, i: int, slot: int) -> None:
        """Use measurement i for one landmark, linearised where the last one left the state."""
        seen, number = frame.seen, self.filter.local[slot]
        R = seen.R[i]
        if self._matcher.defers:
            spread2 = self.tracks.spread2[number]
            R = R + spread2 * np.diag([1.0, 1.0 / seen.z[i, 0] ** 2])
            # anonymous landmarks may be mistaken for each other
            if seen.detections.ids[i] == ANONYMOUS:
                R = R / max(frame.weight, MIN_WEIGHT)
        self.filter.update(slot, seen.z[i], R)
        self.path.add_sight(Sight(int(self.tracks.keys[number]), seen.z[i], R))
        self.tracks.see(np.array([number]), frame.stamp, seen.detections.ids[[i]])

    def _evidence(self, seen: Measured, slots: NDArray[np.int64]) -> float:
        """Log likelihood of the measurements with the associations of this branch."""
        density, _ = log_density(self.filter, self.tracks, seen)
        total = 0.0
        for i, (slot, status) in enumerate(zip(slots, self.associations.statuses, strict=True)):
            if seen.detections.ids[i] != ANONYMOUS:
                continue
            if slot < 0 and status in (Status.NEW, Status.DEFERRED):
                total += self._log_new
            else:
                fits = density[i, slot] if slot >= 0 else density[i].max(initial=OUTLIER)
                total += float(np.logaddexp(fits, OUTLIER))
        return total

    def _add_new(self, frame: MeasuredFrame) -> list[Branch]:
        """Count new measurements as candidates; those seen N times enter the state."""
        seen, ids, out = frame.seen, frame.seen.detections.ids, [self]
        new = np.flatnonzero(np.isin(self.associations.statuses, (Status.NEW, Status.DEFERRED)))
        if len(new) and frame.mapping:
            times = self.candidates.see(
                frame.stamp, seen.z[new], seen.R[new], ids[new], self._matcher.gate
            )
            for i, n in zip(new.tolist(), times.tolist(), strict=True):
                if n >= self._p.ekf.min_sightings:
                    out = [child for b in out for child in b._add_landmark(frame, i, n)]
                    most = most_branches(len(seen.z), len(self.filter.x))
                    out = sorted(out, key=lambda b: -b.weight)[:most]
        for b in out:
            b._forget_candidates(frame.stamp)
        return out

    def _forget_candidates(self, stamp: int) -> None:
        e = self._p.ekf
        self.candidates.drop(stamp, e.min_sightings, e.candidate_timeout, e.candidate_sigma)

    def _add_landmark(self, frame: MeasuredFrame, i: int, n: int) -> list[Branch]:
        """Measurement i was seen n times: new in this branch, a known landmark in others."""
        out = [self]
        for slot, log_odds in self._alternatives(frame, i):
            twin = self.copy()
            twin.weight += log_odds
            twin._set_key(i, int(twin.tracks.keys[twin.filter.local[slot]]))
            twin._update_landmark(frame, i, slot)
            out.append(twin)
        d = frame.seen.detections
        self.filter.augment(frame.seen.z[i], frame.seen.R[i])
        self.tracks.append(frame.stamp, int(d.ids[i]), float(d.diameters[i]))
        self.tracks.keys[-1], self.tracks.sightings[-1] = frame.key_of(i), n
        self._set_key(i, frame.key_of(i))
        self.path.add_sight(Sight(frame.key_of(i), frame.seen.z[i], frame.seen.R[i]))
        return out

    def _set_key(self, i: int, key: int) -> None:
        keys = self.associations.keys.copy()
        keys[i] = key
        self.associations = dataclasses.replace(self.associations, keys=keys)

    def _alternatives(self, frame: MeasuredFrame, i: int) -> list[tuple[int, float]]:
        """Slots of the landmarks that fit measurement i, with log odds against a new one."""
        if not self._matcher.defers or frame.seen.detections.ids[i] != ANONYMOUS:
            return []
        density, d2 = (v[i] for v in log_density(self.filter, self.tracks, frame.seen))
        age = frame.stamp - self.tracks.last_seen[self.filter.local]
        recent = age < self._p.reflector.track_timeout * 1e9
        odds = density + TOGETHER * recent - self._log_new
        return [(int(s), float(odds[s])) for s in np.flatnonzero(d2 < GATE)]

    def _merge(self, keys: NDArray[np.int64]) -> None:
        """Merge measured landmarks with others that are the same.

        ``keys`` (k,) of the measured ones are changed to those of the merged landmarks.
        """
        present = sorted(set(keys[keys >= 0].tolist()))
        self.distinct = self.distinct.union((i, j) for i in present for j in present if i < j)
        for key in present:
            other = self._same_as(key)
            if other is not None:
                kept, merged = min(key, other), max(key, other)
                self._join(kept, merged)
                keys[keys == merged] = kept

    def _same_as(self, key: int) -> int | None:
        """Another landmark that is the same as ``key``, None without one."""
        f = self.filter
        local_keys, ids = self.tracks.keys[f.local], self.tracks.ids[f.local]
        slot = np.flatnonzero(local_keys == key)
        if not len(slot):
            return None
        s = int(slot[0])
        may_be = compatible_ids(ids[[s]], ids)[0]
        d = f.points - f.points[s]
        gap = np.hypot(d[:, 0], d[:, 1])
        for o in np.flatnonzero(gap < MERGE_DISTANCE).tolist():
            other = int(local_keys[o])
            if o == s or not may_be[o] or (min(key, other), max(key, other)) in self.distinct:
                continue
            if self._same.is_same(d[o], float(gap[o]), f.difference_cov(s, o)):
                return other
        return None

    def _join(self, kept: int, merged: int) -> None:
        t = self.tracks
        a, b = (int(np.flatnonzero(t.keys == k)[0]) for k in (kept, merged))
        self.filter.join(a, b)
        self._region = None
        t.sightings[a] += t.sightings[b]
        t.last_seen[a] = max(t.last_seen[a], t.last_seen[b])
        t.keep(np.arange(len(t)) != b)
        self.path.renamed[merged] = kept
        renamed = (sorted(kept if k == merged else k for k in pair) for pair in self.distinct)
        self.distinct = frozenset((i, j) for i, j in renamed)

    def equals(self, other: Branch) -> bool:
        """Whether two branches differ by less than their uncertainty."""
        a, b = np.argsort(self.tracks.keys), np.argsort(other.tracks.keys)
        if len(a) != len(b) or (self.tracks.keys[a] != other.tracks.keys[b]).any():
            return False
        d = self.filter.pose - other.filter.pose
        d[2] = se2.wrap(d[2])
        cov = self.filter.pose_cov + 1e-9 * np.eye(3)
        if d @ np.linalg.solve(cov, d) > EQUAL_POSE:
            return False
        gap = self.filter.landmarks()[a] - other.filter.landmarks()[b]
        return bool((np.abs(gap) < EQUAL_POINT).all())


def most_branches(measurements: int, size: int) -> int:
    """Number of branches at most, with so many measurements and values in the state."""
    affordable = min(MAX_VALUES / size**2, MAX_MEASUREMENTS / max(measurements, 1))
    return int(np.clip(affordable, 2, MAX_BRANCHES))


def _copy(value: Any) -> Any:
    """A copy with its own arrays and lists."""
    out = copy.copy(value)
    for name, v in vars(value).items():
        if isinstance(v, np.ndarray | list | CompressedUpdates):
            setattr(out, name, v.copy())
    return out
