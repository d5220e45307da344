# SPDX-License-Identifier: Apache-2.0
"""The deformable-feature estimator for real use: a sliding window of constant cost.

A robot works beside a carrier (a cart train, a trailer, a conveyor) whose reflectors move with a
known nominal velocity and deform. Each update adds a step; once the window is full the oldest is
marginalised. Features appear and disappear; they are identified by id, or by association.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.deformable.window_equations import (
    Prior,
    Steps,
    carry,
    marginalize_oldest,
    motion_covariance,
    optimize_window,
)
from rlml_slam.errors import InputError, SolverError
from rlml_slam.matching.reflectors.association import Associator, Believed
from rlml_slam.params import Deformable, Reflector
from rlml_slam.se2 import Array, rotation, transform, wrap
from rlml_slam.types import ANONYMOUS, Detections, Motion, Status

SLOTS = 4  # features are given room in steps of this many
# candidates at one time; each takes room in every step of the window, and ghosts are many
MAX_CANDIDATES = 8
SMALLEST_SIGMA = 1e-4  # [m] of a detection along any axis


@dataclass(frozen=True)
class CarrierVelocity:
    """Nominal velocity of the carrier in the axes of the estimate's frame [m/s, rad/s].

    The linear part is that of the centroid of its features. ``sigma`` [m/s] is by how much a
    feature's velocity may differ from it all the time, 0 where the velocity is as announced.
    ``base_linear`` (2,) is the part that is known in the robot's axes; it is added.
    """

    linear: Array  # (2,)
    angular: float = 0.0
    sigma: float = 0.0
    base_linear: Array = field(default_factory=lambda: np.zeros(2))

    def in_map(self, heading: float) -> CarrierVelocity:
        """The same velocity in the axes of the map, for this heading of the robot."""
        linear = self.linear + rotation(heading) @ self.base_linear
        return CarrierVelocity(linear, self.angular, self.sigma)


@dataclass(frozen=True)
class Features:
    """Confirmed features: ``points`` (m, 2), ``cov`` (m, 2, 2) in the estimate's frame.

    ``keys`` (m,) are never reused; ``ids`` (m,) are ANONYMOUS where the feature has none.
    """

    keys: NDArray[np.int64]
    ids: NDArray[np.int64]
    points: Array
    cov: Array


@dataclass(frozen=True)
class WindowEstimate:
    """The newest step: ``pose`` (3,), ``cov`` (3, 3), features, and how it came about.

    ``joint_cov`` (3 + 2m, 3 + 2m) is of the pose and the confirmed features in their order.
    ``keys`` (k,) and ``statuses`` (k,) say what became of each detection, key -1 for none.
    """

    stamp: int
    pose: Array
    cov: Array
    features: Features
    joint_cov: Array
    keys: NDArray[np.int64]
    statuses: NDArray[np.int64]
    iterations: int
    chi2: float


@dataclass
class _Track:
    """Book-keeping of one slot in use."""

    key: int
    id: int = ANONYMOUS
    sightings: int = 0
    last_seen: int = 0  # stamp


class DeformableWindow:
    """Estimate of the robot and its carrier's features, update by update.

    ``start`` (3,) is the first pose and ``start_cov`` (3, 3) its covariance; the parameter
    ``start_sigma`` where none is given, and added to one that is.
    """

    def __init__(
        self,
        params: Deformable,
        reflector: Reflector,
        start: Array | None = None,
        start_cov: Array | None = None,
    ) -> None:
        self._p, self._reflector = params, reflector
        self._associator = Associator(reflector)
        self._tracks: dict[int, _Track] = {}  # by slot
        self._next_key = 0
        self._stamp: int | None = None
        self._length = 0  # steps in the window
        self._allocate(SLOTS)
        self._w.mean[0, :3] = 0.0 if start is None else start
        self._prior.at[:3] = self._w.mean[0, :3]
        cov = np.diag(np.array(params.start_sigma) ** 2)
        self._cov[:3, :3] = cov if start_cov is None else cov + start_cov
        self._prior.info[:3, :3] = _inverse(self._cov[:3, :3])

    def update(
        self, stamp: int, motion: Motion, detections: Detections, velocity: CarrierVelocity
    ) -> WindowEstimate:
        """Add one step: the robot's ``motion`` since the last, and detections in the base frame.

        ``velocity`` held since the last update. The first update's motion is not used. Raises
        InputError for a stamp that does not advance or a measurement that is no number.
        """
        self._check(stamp, motion, detections, velocity)
        detections = replace(detections, cov=_with_floor(detections.cov))
        if self._stamp is None:
            self._length = 1
        else:
            self._advance((stamp - self._stamp) * 1e-9, motion, velocity)
        self._stamp = stamp
        self._forget(stamp)
        keys, statuses = self._sight(stamp, detections)
        self._lead()
        iterations, chi2 = self._optimize()
        return self._estimate(stamp, keys, statuses, iterations, chi2)

    def _check(
        self, stamp: int, motion: Motion, detections: Detections, velocity: CarrierVelocity
    ) -> None:
        if self._stamp is not None and stamp <= self._stamp:
            raise InputError(f'deformable window: stamp {stamp} is not after {self._stamp}')
        for what, value in (
            ('motion', motion.delta), ('motion covariance', motion.cov),
            ('carrier velocity', velocity.linear + velocity.base_linear),
            ('carrier turn rate', velocity.angular),
            ('detections', detections.points), ('detection covariances', detections.cov),
        ):  # fmt: skip
            if not np.all(np.isfinite(value)):
                raise InputError(f'deformable window: {what} at {stamp} is not finite')
        if not _are_covariances(motion.cov) or not _are_covariances(detections.cov):
            raise InputError(
                f'deformable window: a covariance at {stamp} is not positive definite'
            )

    def _allocate(self, slots: int) -> None:
        """Arrays of the window with room for ``slots`` features, all empty."""
        K, n = self._p.window, 3 + 2 * slots
        self._w = Steps(
            mean=np.zeros((K, n)), active=np.zeros((K, slots), np.bool_),
            leads=np.zeros((K, slots), np.bool_), delta=np.zeros((K, 3)),
            motion_info=np.zeros((K, 3, 3)), carrier=np.zeros((K, 3)),
            shift=np.zeros((K, 3)), own=np.ones(K), common=np.zeros(K),
            z=np.full((K, slots, 2), np.nan), z_info=np.zeros((K, slots, 2, 2)),
        )  # fmt: skip
        self._prior = Prior(np.zeros(n), np.zeros((n, n)), np.zeros(n))
        self._cov = np.zeros((n, n))

    def _grow(self) -> None:
        """Room for SLOTS more features; what is there stays where it is."""
        old = (*self._w, *self._prior, self._cov)
        self._allocate(self._w.active.shape[1] + SLOTS)
        for source, target in zip(old, (*self._w, *self._prior, self._cov), strict=True):
            target[tuple(slice(0, size) for size in source.shape)] = source

    def _advance(self, dt: float, motion: Motion, velocity: CarrierVelocity) -> None:
        """Predict a new newest step; the oldest is marginalised where the window is full."""
        w = self._w
        if self._length == self._p.window:
            if not marginalize_oldest(w, self._prior):
                raise SolverError('deformable window: the oldest step cannot be marginalised')
            for array in w:
                array[:-1] = array[1:]
            self._length -= 1
        k = self._length - 1
        w.delta[k], w.motion_info[k] = motion.delta, _inverse(motion.cov)
        w.carrier[k] = np.array([*velocity.linear, velocity.angular]) * dt
        w.shift[k, :2] = velocity.base_linear * dt
        lasting = (velocity.sigma * dt) ** 2  # not a random walk: it grows with the time squared
        w.own[k] = self._p.drift**2 * dt + lasting
        w.common[k] = self._p.common_drift**2 * dt + lasting
        lives, F = w.active[k], np.empty_like(self._cov)
        carry(
            w.mean[k], lives, w.leads[k], w.delta[k], w.carrier[k], w.shift[k],
            w.mean[k + 1], F,
        )  # fmt: skip
        Q = motion_covariance(w.mean[k, 2], motion.cov, lives, w.own[k], w.common[k])
        self._cov = F @ self._cov @ F.T + Q
        w.active[k + 1], w.leads[k + 1] = lives, False
        w.z[k + 1] = np.nan
        self._length += 1

    def _sight(
        self, stamp: int, detections: Detections
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Give each detection to its feature, or to a new one; keys and statuses."""
        near = np.linalg.norm(detections.points, axis=-1) <= self._reflector.max_range
        slots = sorted(self._tracks)
        association = self._associator.associate(detections, self._believed(slots))
        status = np.where(near, association.status, Status.GHOST).astype(np.int64)
        info = _inverse(detections.cov)
        keys = np.full(len(detections), -1, dtype=np.int64)
        for i in np.flatnonzero((status == Status.USED) | (status == Status.NEW)).tolist():
            point, id = detections.points[i], int(detections.ids[i])
            new = status[i] == Status.NEW
            if new and len(self._tracks) - len(self._confirmed()) >= MAX_CANDIDATES:
                status[i] = Status.GHOST
                continue
            slot = self._start_track(point) if new else slots[association.match[i]]
            keys[i] = self._see(slot, stamp, id, point, info[i])
        return keys, status

    def _believed(self, slots: list[int]) -> Believed:
        """The newest step as association needs it."""
        state = self._w.mean[self._length - 1]
        rows = _rows(slots)
        ids = np.array([self._tracks[s].id for s in slots], dtype=np.int64)
        return Believed(
            state[:3], state[rows[3:]].reshape(-1, 2), ids, self._cov[np.ix_(rows, rows)]
        )

    def _see(self, slot: int, stamp: int, id: int, point: Array, info: Array) -> int:
        """Enter a sighting of the feature in ``slot``; its key."""
        k, track = self._length - 1, self._tracks[slot]
        self._w.z[k, slot], self._w.z_info[k, slot] = point, info
        track.sightings += 1
        track.last_seen = stamp
        if track.id == ANONYMOUS:
            track.id = id
        return track.key

    def _start_track(self, point: Array) -> int:
        """A new feature in a slot that no step of the window uses; its slot."""
        free = np.flatnonzero(~self._w.active[: self._length].any(axis=0))
        if len(free) == 0:
            free = np.array([self._w.active.shape[1]])
            self._grow()
        slot, state = int(free[0]), self._w.mean[self._length - 1]
        self._tracks[slot] = _Track(self._next_key)
        self._next_key += 1
        self._w.active[self._length - 1, slot] = True
        state[3 + 2 * slot : 5 + 2 * slot] = transform(state[:3], point[None])[0]
        return slot

    def _forget(self, stamp: int) -> None:
        """Drop features that have not been seen for long, candidates sooner.

        Before the sightings: after a gap in the data, nobody knows where the carrier went.
        """
        k = self._length - 1
        for slot, track in list(self._tracks.items()):
            patience = (
                self._p.feature_timeout if self._is_confirmed(track) else self._p.candidate_timeout
            )
            if (stamp - track.last_seen) * 1e-9 > patience:
                del self._tracks[slot]
                self._w.active[k, slot] = False
                self._w.mean[k, 3 + 2 * slot : 5 + 2 * slot] = 0.0

    def _lead(self) -> None:
        """The carrier turns about its confirmed features."""
        leads = self._w.leads[self._length - 1]
        leads[:] = False
        leads[self._confirmed()] = True

    def _confirmed(self) -> list[int]:
        """Slots of the features that are no candidates any more."""
        return [slot for slot in sorted(self._tracks) if self._is_confirmed(self._tracks[slot])]

    def _is_confirmed(self, track: _Track) -> bool:
        return track.sightings >= self._reflector.min_sightings

    def _optimize(self) -> tuple[int, float]:
        iterations, cost = optimize_window(
            self._w, self._length, self._prior, self._p.max_iterations, self._p.tolerance,
            self._cov,
        )  # fmt: skip
        if iterations < 0:
            raise SolverError('deformable window: the normal equations cannot be solved')
        return int(iterations), float(cost)

    def _estimate(
        self,
        stamp: int,
        keys: NDArray[np.int64],
        statuses: NDArray[np.int64],
        iterations: int,
        chi2: float,
    ) -> WindowEstimate:
        state = self._w.mean[self._length - 1]
        slots = self._confirmed()
        rows = _rows(slots)
        joint = self._cov[np.ix_(rows, rows)]
        blocks = [joint[k : k + 2, k : k + 2] for k in range(3, len(rows), 2)]
        features = Features(
            np.array([self._tracks[s].key for s in slots], dtype=np.int64),
            np.array([self._tracks[s].id for s in slots], dtype=np.int64),
            state[rows[3:]].reshape(-1, 2).copy(),
            np.array(blocks).reshape(-1, 2, 2),
        )
        pose = np.append(state[:2], wrap(state[2]))
        return WindowEstimate(
            stamp, pose, joint[:3, :3].copy(), features, joint, keys, statuses, iterations, chi2
        )


def _rows(slots: list[int]) -> NDArray[np.int64]:
    """Entries of a step's state: the pose, then the features of ``slots``."""
    features = [3 + 2 * s + r for s in slots for r in range(2)]
    return np.array([0, 1, 2, *features], dtype=np.int64)


def _are_covariances(cov: Array) -> bool:
    """Whether all of (..., n, n) are symmetric and positive definite."""
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return False
    return bool(np.allclose(cov, cov.swapaxes(-1, -2)))


def _with_floor(cov: Array) -> Array:
    """Covariances (n, 2, 2), those larger by SMALLEST_SIGMA^2 I that are smaller along an axis."""
    small = np.linalg.eigvalsh(cov)[:, 0] < SMALLEST_SIGMA**2
    floored: Array = cov + small[:, None, None] * (SMALLEST_SIGMA**2 * np.eye(2))
    return floored


def _inverse(cov: Array) -> Array:
    """Information of covariances (..., n, n), symmetric."""
    inverse = np.linalg.inv(cov)
    symmetric: Array = 0.5 * (inverse + inverse.swapaxes(-1, -2))
    return symmetric


def warm_up() -> None:
    """Compile the kernels: a window that fills, turns and marginalises."""
    window = DeformableWindow(Deformable(window=2), Reflector(min_sightings=1))
    none = np.full(1, np.nan)
    for k in range(4):
        seen = Detections(k, '', np.ones((1, 2)), np.eye(2)[None], np.zeros(1, np.int64), none)
        window.update(k, Motion(np.zeros(3), np.eye(3)), seen, CarrierVelocity(np.zeros(2), 0.1))
