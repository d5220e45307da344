# SPDX-License-Identifier: Apache-2.0
"""One filter with its bookkeeping, and the answers to "which landmark is it?" that it stands for.

An estimator has one branch as long as every measurement can be told. What comes back into view
and fits more than one landmark, or one that would be new, splits it into a branch for each answer;
what is measured from then on speaks for some and against others (multiple hypotheses, Reid 1979).
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
from rlml_slam.ekf.candidates import Candidates
from rlml_slam.ekf.extraction import Measured
from rlml_slam.ekf.filter import Filter
from rlml_slam.ekf.likelihood import SAME_PLACE, log_density
from rlml_slam.ekf.matching import Matcher
from rlml_slam.estimation.landmark_models import POINT
from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.estimation.smoother import BIAS, ROBOT, Sight, Step
from rlml_slam.matching.reflectors.multi_hypothesis import GATE, OUTLIER, TOGETHER, UNKNOWN
from rlml_slam.motion import STILL
from rlml_slam.params import EkfParameters
from rlml_slam.se2 import Array
from rlml_slam.types import ANONYMOUS, Motion, Reflectors, Status

MERGE_DISTANCE = 1.5  # [m] pairs farther apart are not looked at
# two branches are one whose poses differ by less than this share of their sigma, squared, and
# whose landmarks [m] by less than what tells two markers apart
EQUAL_POSE, EQUAL_POINT = 0.1, 0.1


@dataclass(frozen=True)
class Path:
    """Poses (3,) by stamp, newest first; branches share what they have in common."""

    stamp: int
    pose: Array
    before: Path | None
    step: Step | None = None


@dataclass(frozen=True)
class Looked:
    """What became of the measurements of one frame: keys, statuses (k,) and their chi²."""

    keys: NDArray[np.int64]
    statuses: NDArray[np.int64]
    chi2: float

    @classmethod
    def nothing(cls) -> Looked:
        """Of a frame in which nothing was looked for."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, 0.0)


@dataclass(frozen=True)
class Look:
    """The measurements of one frame; ``worth`` is what they tell beyond those of the last one.

    ``key_of`` (measurement) is the key of the landmark that it begins, the same in all branches.
    """

    seen: Measured
    stamp: int
    worth: float
    mapping: bool
    key_of: Callable[[int], int]


class Branch:
    """``weight`` is the logarithm of how much its answers explain, up to a common constant.

    ``apart`` are pairs of keys that were seen at one time.
    """

    def __init__(self, params: EkfParameters, matcher: Matcher, filter_: Filter) -> None:
        self._p = params
        self._matcher = matcher
        self.filter = filter_
        self.candidates = Candidates(filter_.model)
        self.tracks = LandmarkTracks()
        self.apart: frozenset[tuple[int, int]] = frozenset()
        self.weight = 0.0
        self.path: Path | None = None
        self.renamed: dict[int, int] = {}
        self._step = Step(STILL, 0.0, 1.0)
        self.looked = Looked.nothing()
        self._region: Array | None = None
        self._radius = self._reach = 0.0
        self._log_new = math.log(UNKNOWN * params.reflector.unmapped_density)

    def copy(self) -> Branch:
        """A branch of its own that knows the same."""
        out = copy.copy(self)
        out.filter = _copy(self.filter)
        out.candidates = _copy(self.candidates)
        out.tracks = _copy(self.tracks)
        out.renamed = self.renamed.copy()
        return out

    def use_map(self, reflectors: Reflectors) -> None:
        """Take over given landmarks (map frame)."""
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
        """Step 1: odometry; ``walk`` and ``kept`` as :meth:`Filter.predict` takes them."""
        self.looked = Looked.nothing()
        f = self.filter
        delta, gains = f.corrected(motion)
        lasting = gains @ f.P[BIAS:ROBOT, BIAS:ROBOT] @ gains.T
        took = f.predict(motion, walk, kept)
        self.candidates.move(delta, motion.cov + lasting)
        # the smoother shall use what the filter did
        used = motion if took else dataclasses.replace(motion, bias_var=math.inf)
        self._step = Step(used, walk, kept)

    def log(self, stamp: int, steps: bool) -> None:
        """Remember the pose, and ``steps``, what it comes from."""
        step = self._step if steps else None
        self.path = Path(stamp, self.filter.pose, self.path, step)

    def steps(self) -> list[Step]:
        """What the path comes from, the first one first, with the keys that landmarks have now."""
        out, node = [], self.path
        while node is not None and node.step is not None:
            now = (dataclasses.replace(s, key=self._key_now(s.key)) for s in node.step.sights)
            out.append(dataclasses.replace(node.step, sights=tuple(now)))
            node = node.before
        out.reverse()
        return out

    def _key_now(self, key: int) -> int:
        while key in self.renamed:
            key = self.renamed[key]
        return key

    def _log_sight(self, key: int, z: Array, R: Array) -> None:
        sights = (*self._step.sights, Sight(key, z, R))
        self._step = dataclasses.replace(self._step, sights=sights)

    def look(self, look: Look) -> list[Branch]:
        """Steps 2 and 3: update with what is known, count what is new; the branches after it."""
        seen, f = look.seen, self.filter
        self._choose_region(seen)
        if not len(seen.z):
            self._forget_candidates(look.stamp)
            return [self]
        matches = self._matcher.match(seen, f, self.tracks, look.stamp)
        used = matches.slots >= 0
        keys = np.full(len(seen.z), -1, dtype=np.int64)
        keys[used] = self.tracks.keys[f.local[matches.slots[used]]]
        self.looked = Looked(keys, matches.statuses, float(matches.distance2[used].sum()))
        if self._matcher.defers:
            self.weight += look.worth * self._evidence(seen, matches.slots)
            if look.mapping:
                self._matcher.learn_spread(seen, matches, f.local, self.tracks)
        for i in np.flatnonzero(used):
            self._update(look, int(i), int(matches.slots[i]))
        if self._matcher.defers and look.mapping:
            self._merge(keys)
        return self._grow(look)

    def _choose_region(self, seen: Measured) -> None:
        """Work on the landmarks near the robot; choose them anew when it has gone on.

        The region holds whatever the sensor has been seen to reach. Lines have no place, so all
        of them are always worked on.
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

    # --- step 2: re-observed landmarks -------------------------------------------------------

    def _update(self, look: Look, i: int, slot: int) -> None:
        """Use measurement i for one landmark, linearised where the last one left the state."""
        seen, number = look.seen, self.filter.local[slot]
        R = seen.R[i]
        if self._matcher.defers:
            spread2 = self.tracks.spread2[number]
            R = R + spread2 * np.diag([1.0, 1.0 / seen.z[i, 0] ** 2])
            # who tells its id is taken at its word; others may be each other
            if seen.detections.ids[i] == ANONYMOUS:
                R = R / max(look.worth, SAME_PLACE)
        self.filter.update(slot, seen.z[i], R)
        self._log_sight(int(self.tracks.keys[number]), seen.z[i], R)
        self.tracks.see(np.array([number]), look.stamp, seen.detections.ids[[i]])

    def _evidence(self, seen: Measured, slots: NDArray[np.int64]) -> float:
        """Log likelihood of a look by the answers of this branch."""
        density, _ = log_density(self.filter, self.tracks, seen)
        total = 0.0
        for i, (slot, status) in enumerate(zip(slots, self.looked.statuses, strict=True)):
            if seen.detections.ids[i] != ANONYMOUS:
                continue
            if slot < 0 and status in (Status.NEW, Status.DEFERRED):
                total += self._log_new
            else:
                fits = density[i, slot] if slot >= 0 else density[i].max(initial=OUTLIER)
                total += float(np.logaddexp(fits, OUTLIER))
        return total

    # --- step 3: new landmarks -----------------------------------------------------------------

    def _grow(self, look: Look) -> list[Branch]:
        """Count what is new as candidates; those seen N times enter the state."""
        seen, ids, out = look.seen, look.seen.detections.ids, [self]
        new = np.flatnonzero(np.isin(self.looked.statuses, (Status.NEW, Status.DEFERRED)))
        if len(new) and look.mapping:
            times = self.candidates.see(
                look.stamp, seen.z[new], seen.R[new], ids[new], self._matcher.gate
            )
            for i, n in zip(new.tolist(), times.tolist(), strict=True):
                if n >= self._p.ekf.min_sightings:
                    out = [child for b in out for child in b._enter(look, i, n)]
        for b in out:
            b._forget_candidates(look.stamp)
        return out

    def _forget_candidates(self, stamp: int) -> None:
        e = self._p.ekf
        self.candidates.drop(stamp, e.min_sightings, e.candidate_timeout, e.candidate_sigma)

    def _enter(self, look: Look, i: int, n: int) -> list[Branch]:
        """Measurement i was seen n times: new here, and one that is known in other branches."""
        out = [self]
        for slot, log_odds in self._answers(look, i):
            twin = self.copy()
            twin.weight += log_odds
            twin._note(i, int(twin.tracks.keys[twin.filter.local[slot]]))
            twin._update(look, i, slot)
            out.append(twin)
        d = look.seen.detections
        self.filter.augment(look.seen.z[i], look.seen.R[i])
        self.tracks.append(look.stamp, int(d.ids[i]), float(d.diameters[i]))
        self.tracks.keys[-1], self.tracks.sightings[-1] = look.key_of(i), n
        self._note(i, look.key_of(i))
        self._log_sight(look.key_of(i), look.seen.z[i], look.seen.R[i])
        return out

    def _note(self, i: int, key: int) -> None:
        keys = self.looked.keys.copy()
        keys[i] = key
        self.looked = dataclasses.replace(self.looked, keys=keys)

    def _answers(self, look: Look, i: int) -> list[tuple[int, float]]:
        """Slots of the landmarks that measurement i may be of, with log odds against a new one."""
        if not self._matcher.defers or look.seen.detections.ids[i] != ANONYMOUS:
            return []
        density, d2 = (v[i] for v in log_density(self.filter, self.tracks, look.seen))
        age = look.stamp - self.tracks.last_seen[self.filter.local]
        recent = age < self._p.reflector.track_timeout * 1e9
        odds = density + TOGETHER * recent - self._log_new
        return [(int(s), float(odds[s])) for s in np.flatnonzero(d2 < GATE)]

    # --- landmarks that turn out to be one -----------------------------------------------------

    def _merge(self, keys: NDArray[np.int64]) -> None:
        """Make one of what was seen and what is close, statistically equal, never seen with it.

        ``keys`` (k,) of what was seen; they are changed to the key that goes on.
        """
        present = sorted(set(keys[keys >= 0].tolist()))
        self.apart = self.apart.union((i, j) for i in present for j in present if i < j)
        for key in present:
            other = self._same_as(key)
            if other is not None:
                known, gone = min(key, other), max(key, other)
                self._join(known, gone)
                keys[keys == gone] = known

    def _same_as(self, key: int) -> int | None:
        """The landmark that ``key`` is as well; where both are uncertain, it could be two."""
        f, p = self.filter, self._p
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
            if o == s or not may_be[o] or (min(key, other), max(key, other)) in self.apart:
                continue
            cov = f.difference_cov(s, o) + 1e-6 * np.eye(2)
            peak = 1.0 / (2.0 * math.pi * math.sqrt(np.linalg.det(cov)))
            if peak < p.reflector.match_probability * (peak + p.reflector.unmapped_density):
                continue
            near = gap[o] < p.ekf.min_separation
            if near or d[o] @ np.linalg.solve(cov, d[o]) < self._matcher.gate:
                return other
        return None

    def _join(self, known: int, gone: int) -> None:
        t = self.tracks
        a, b = (int(np.flatnonzero(t.keys == k)[0]) for k in (known, gone))
        self.filter.join(a, b)
        self._region = None
        t.sightings[a] += t.sightings[b]
        t.last_seen[a] = max(t.last_seen[a], t.last_seen[b])
        t.keep(np.arange(len(t)) != b)
        self.renamed[gone] = known
        renamed = (sorted(known if k == gone else k for k in pair) for pair in self.apart)
        self.apart = frozenset((i, j) for i, j in renamed)

    def equals(self, other: Branch) -> bool:
        """Whether this one and another differ in nothing that matters."""
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


def _copy(value: Any) -> Any:
    """A copy with arrays and lists of its own."""
    out = copy.copy(value)
    for name, v in vars(value).items():
        if isinstance(v, np.ndarray | list):
            setattr(out, name, v.copy())
    return out
