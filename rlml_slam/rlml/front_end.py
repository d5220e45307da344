# SPDX-License-Identifier: Apache-2.0
"""The RLML front end: the MAP pose of every scan over odometry, reflectors and submap (eq. 1-11).

The state is the joint Gaussian of pose, submap anchors and reflectors (:mod:`joint_state`); with
the latter two known exactly, the update below is eq. 3 and its covariance eq. 11 to the letter.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved import SavedMap
from rlml_slam.matching import association, observability, thinning
from rlml_slam.matching.scan_match import ScanMatchResult, match
from rlml_slam.matching.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.rlml.coasting import Coasting
from rlml_slam.rlml.confirmation import START_SIGMA, Confirmation
from rlml_slam.rlml.correction import Correction, Known
from rlml_slam.rlml.distant import Distant
from rlml_slam.rlml.doubt import Doubt, consents
from rlml_slam.rlml.free_sweep import Sweep, deskewed
from rlml_slam.rlml.grid_fix import Fix, SavedGrid
from rlml_slam.rlml.health import Evidence, HealthMonitor, ends_of, weak_direction
from rlml_slam.rlml.joint_state import BIAS, JointState
from rlml_slam.rlml.map_window import MapWindow
from rlml_slam.rlml.reflector_update import use_reflectors
from rlml_slam.rlml.relocalize import is_mapped
from rlml_slam.rlml.scan_update import fuse, prior_of
from rlml_slam.rlml.second_look import AS_USUAL, TURN, second_look
from rlml_slam.rlml.submaps import Submaps
from rlml_slam.rlml.tracks import Tracks
from rlml_slam.rlml.unseen import expected
from rlml_slam.se2 import Array
from rlml_slam.types import (
    ANONYMOUS,
    Belief,
    Detections,
    Frame,
    Health,
    Observation,
    Reflectors,
    Status,
)

NONE = np.zeros(0, dtype=np.int64)
BURST = 50_000_000  # [ns] between two scans that tell a velocity
FAR = 3.0  # [sigma] a search without odometry reaches


class FrontEnd:
    """Localises every observation in the local frame, which starts at ``map_start_pose``.

    ``process`` is the system: same object for the live node, the replay and the tests. All state
    is here; results are frozen values.
    """

    def __init__(self, params: Parameters) -> None:
        self._p = params
        self._associator = association.Associator(params.reflector)
        self._contradiction = association.gate(params.reflector.new_gate)
        self.reset(np.array(params.node.map_start_pose), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array) -> None:
        """Forget everything and start at a pose (3,) of the map with covariance (3, 3)."""
        self.state = JointState(pose, cov, self._p.motion.imu_bias, self._p.motion.free_speeds)
        self.tracks = Tracks()
        self.submaps = Submaps(self._p.submap)
        self.health = HealthMonitor(self._p.health)
        self.doubt = Doubt(self._p.health)
        self._grid: SavedGrid | None = None
        self._fix = Fix(math.nan)
        self._jumped = False
        self._correction = Correction(np.zeros(3))
        self._velocity = np.zeros(3)
        self._since: tuple[int, Array] | None = None
        self._has_odometry = False
        self._coasting = Coasting(self._p.motion)
        self._map: SavedMap | None = None
        self._window: MapWindow | None = None
        r = self._p.reflector
        self._distant = Distant(r.max_range, r.min_sightings)
        self.confirmation = Confirmation(self._p)
        self._last_fit = 0
        self._reach = 0.0
        self._last_stamp: int | None = None

    def use_map(self, reflectors: Reflectors, grid: OccupancyGrid | None = None) -> None:
        """Localise against given reflectors and grid (map frame); nothing is added to them.

        The estimate of a reflector moves with its detections, within the covariance given for it.
        A start pose that is only assumed, with no covariance, is as good as a person's guess; and
        it stays unconfirmed until what is seen agrees with the map.
        """
        self._map = SavedMap(reflectors)
        self.use_grid(grid)
        if not self.state.pose_cov.any():
            self.state.widen(np.diag(START_SIGMA**2))
        self.confirmation.begin()
        self._window = MapWindow(reflectors, self._p.reflector.max_range)
        self._window.follow(self.state, self.tracks)

    def use_grid(self, grid: OccupancyGrid | None) -> None:
        """Localise against a grid as well, or no longer."""
        assert self._map is not None
        self._map = replace(self._map, grid=grid)
        self._grid = None
        if grid is not None and is_mapped(grid):
            self._grid = SavedGrid(grid, self._p)

    def relocate(self, T_map_base: Array, cov: Array) -> None:
        """Go on from another place (3,), (3, 3) of the map.

        A submap begun where the robot was lies elsewhere; reflectors stay where they are.
        """
        T_local_map = se2.inverse(self.T_map_local)
        pose, R = se2.compose(T_local_map, T_map_base), np.eye(3)
        R[:2, :2] = se2.rotation(T_local_map[2])
        cov = R @ cov @ R.T
        if self._map is not None:
            bias, variance = self.state.x[BIAS], self.state.P[BIAS, BIAS]
            T_map_local, last = self.T_map_local, self._last_stamp
            known = self._map
            self.reset(pose, cov)
            self.use_map(known.reflectors, known.grid)
            self.state.x[BIAS], self.state.P[BIAS, BIAS] = bias, variance
            self._last_stamp = last
        else:
            self.state.place(pose, cov)
            self.submaps = Submaps(self._p.submap)
            self.doubt = Doubt(self._p.health)
            self._since = None
            T_map_local = self.T_map_local
        # what the graph knows is of where the robot was
        self._correction = Correction(T_map_local)
        self._jumped = True

    def correct(self, T_map_local: Array, known: Known | None = None) -> None:
        """Take over the back end's newest correction of the local frame.

        Without what is ``known`` of a pose by the graph, what was known before goes on.
        """
        known = self._correction.known if known is None else known
        self._correction = Correction(np.array(T_map_local, dtype=np.float64), known)

    def in_map(self, pose: Array, cov: Array) -> tuple[Array, Array]:
        """A pose (3,) of the local frame and its covariance (3, 3), both in the map frame."""
        return self._correction.apply(pose, cov)

    @property
    def T_map_local(self) -> Array:
        """The local frame's pose (3,) in the map, as the back end corrected it last."""
        return self._correction.T_map_local

    @property
    def newest(self) -> int | None:
        """Stamp of the newest observation, None before the first."""
        return self._last_stamp

    def contradicts(self, belief: Belief) -> bool:
        """Whether the back end's reflectors are not where this end's estimate has them.

        Both come from the same detections, so a difference beyond the gate is no noise: one of
        them linearised too early, or took one reflector for another, and it is not the graph.
        """
        keys, places, covs = self._distant.everything(self.state, self.tracks)
        _, mine, theirs = np.intersect1d(keys, belief.keys, return_indices=True)
        if not len(mine):
            return False
        points = se2.transform(se2.inverse(self.T_map_local), belief.points[theirs])
        d = points - places[mine]
        spread = covs[mine]
        d2 = np.einsum('ni,ni->n', d, np.linalg.solve(spread, d[..., None])[..., 0])
        return bool((d2 > self._contradiction).any())

    def adopt(self, belief: Belief) -> None:
        """Go on from the back end's reflectors, and its covariance of them and of the pose.

        The local pose stays as it is; candidates that the back end does not know start anew.
        Call it for the frame that became the newest keyframe, after :meth:`correct`.
        """
        self._distant.gather(self.state, self.tracks)
        self.tracks.rename(belief.aliases)
        _, mine, theirs = np.intersect1d(self.tracks.keys, belief.keys, return_indices=True)
        keep = np.zeros(len(self.tracks), dtype=np.bool_)
        keep[mine] = True
        order = theirs[np.argsort(mine, kind='stable')]
        self.tracks.keep(keep)
        inverse = se2.inverse(self.T_map_local)
        columns = np.concatenate([[0, 1, 2], np.stack([3 + 2 * order, 4 + 2 * order], 1).ravel()])
        T = np.eye(len(columns))
        R = se2.rotation(inverse[2])
        T[:2, :2] = R
        for k in range(3, len(columns), 2):
            T[k : k + 2, k : k + 2] = R
        cov = T @ belief.cov[np.ix_(columns, columns)] @ T.T
        self.state.replace(se2.transform(inverse, belief.points[order]), cov, self.submaps.bias)
        # the state has the covariance of the graph now
        self._correction = Correction(self.T_map_local)

    def forget(self, keys: Iterable[int]) -> None:
        """Drop reflectors that the back end knows to be gone."""
        gone = np.array(list(keys), dtype=np.int64)
        if self._distant.has(gone):
            self._distant.gather(self.state, self.tracks)
        keep = ~np.isin(self.tracks.keys, gone)
        if not keep.all():
            self.state.remove_landmarks(keep)
            self.tracks.keep(keep)

    def process(self, observation: Observation) -> Frame:
        """The pose at the observation's stamp; never raises for what was measured."""
        began = time.perf_counter()
        coasts = self._predict(observation)
        sweep = Sweep()
        if coasts:
            observation, sweep = self._deskewed(observation)
        self._follow_map(observation.detections)
        matched = _Matched.none(observation.detections)
        self._use_reflectors(observation, matched)
        evidence = self._use_scan(observation, matched, sweep)
        self._use_grid(observation)
        self._use_reflectors(observation, matched)
        doubtful = self._is_doubtful(observation, matched, evidence)
        if coasts:
            motion = self._coasting.found(self.state, observation.motion)
            observation = replace(observation, motion=motion)
        observation = self._with_spread(observation, matched)
        self._map_reflectors(observation, matched, doubtful)
        self._map_scan(observation, evidence, doubtful and evidence.misfit)
        self._remember_velocity(observation.stamp)
        moved = observation.motion.delta
        self.confirmation.judge(
            observation.stamp, math.hypot(moved[0], moved[1]), len(matched.status),
            matched.num_used, matched.agrees, self._fix,
        )  # fmt: skip
        health = self._judge(observation, matched, evidence)
        frame = self._frame(observation, matched, evidence, health, doubtful, began)
        self._jumped = False
        return frame

    def _follow_map(self, detections: Detections | None) -> None:
        """Only reflectors in reach are in the state."""
        if self._window is not None:
            self._window.follow(self.state, self.tracks)
        elif self._p.node.mode == 'mapping':
            ids = NONE if detections is None else detections.ids
            self._distant.follow(self.state, self.tracks, ids)

    # --- prior -----------------------------------------------------------------------------

    def _predict(self, observation: Observation) -> bool:
        """Move the pose as odometry says; whether the robot has none and goes on as it went."""
        stamp, last = observation.stamp, self._last_stamp
        self._last_stamp = stamp
        self._has_odometry |= observation.odom_pose is not None
        dt = 0.0 if last is None else (stamp - last) * 1e-9
        coasts = not self._has_odometry and last is not None
        if coasts:
            self._coasting.predict(self.state, dt, observation.motion)
        else:
            # the variance that the gyro's bias gains until now
            self.state.predict(observation.motion, self._p.motion.imu_bias_walk**2 * dt)
        return coasts

    def _remember_velocity(self, stamp: int) -> None:
        """Velocity over BURST at least: scans of one burst are too close to divide by."""
        pose, since = self.state.pose, self._since
        if since is None:
            self._since = (stamp, pose)
        elif stamp - since[0] >= BURST:
            dt = (stamp - since[0]) * 1e-9
            self._velocity = se2.log(se2.between(since[1], pose)) / dt
            self._since = (stamp, pose)

    # --- reflector term ----------------------------------------------------------------------

    def _use_reflectors(self, observation: Observation, matched: _Matched) -> None:
        """Associate what is not yet associated and update with it (e_R of eq. 2)."""
        detections = observation.detections
        if detections is None or not matched.open.any():
            return
        rows = np.flatnonzero(matched.open)
        result = self._associator.associate(
            _subset(detections, rows),
            association.Believed(
                self.state.pose,
                self.state.landmarks(),
                self.tracks.ids,
                self.state.pose_and_landmarks_cov(),
                self._recent(observation.stamp),
                self.tracks.spread2,
            ),
        )
        taken = (result.match >= 0) & (result.match[:, None] == matched.index).any(axis=1)
        used = (result.match >= 0) & ~taken
        matched.status[rows] = np.where(taken, Status.AMBIGUOUS, result.status)
        if not used.any():
            return
        k, index = rows[used], result.match[used]
        matched.index[k] = index
        matched.distance2[k] = result.distance2[used]
        R = detections.cov[k] + self.tracks.spread2[index][:, None, None] * np.eye(2)
        # Huber on the innovation: beyond the scale a detection pulls no harder than at it
        excess = matched.distance2[k] / self._p.reflector.robust_scale**2
        R *= np.maximum(excess, 1.0)[:, None, None]
        use_reflectors(self.state.x, self.state.P, index, detections.points[k], R)
        self.tracks.see(index, observation.stamp, detections.ids[k])

    def _with_spread(self, observation: Observation, matched: _Matched) -> Observation:
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
        if self._p.node.mode == 'mapping':
            double = self._associator.doubles(detections, matched.index)
            for k in np.flatnonzero(double >= 0):
                gap = detections.points[k] - detections.points[double[k]]
                self.tracks.see_double(int(matched.index[double[k]]), float(np.linalg.norm(gap)))
        if not spread2.any():
            return observation
        cov = detections.cov + spread2[:, None, None] * np.eye(2)
        return replace(observation, detections=replace(detections, cov=cov))

    def _recent(self, stamp: int) -> NDArray[np.bool_] | None:
        """(m,): reflectors that were in view a moment ago; a given map needs no such care."""
        if self._p.node.mode != 'mapping':
            return None
        return stamp - self.tracks.last_seen < self._p.reflector.track_timeout * 1e9

    def _map_reflectors(self, observation: Observation, matched: _Matched, doubtful: bool) -> None:
        """New reflectors enter as candidates, candidates not seen again leave."""
        p, detections = self._p.reflector, observation.detections
        if self._p.node.mode != 'mapping':
            # a map that never changes has all reflectors that there are
            matched.status[matched.status == Status.NEW] = Status.GHOST
        elif detections is not None and not doubtful:
            fresh = (matched.status == Status.NEW) | (matched.status == Status.DOUBTFUL)
            for k in np.flatnonzero(fresh):
                matched.index[k] = self.state.add_landmark(detections.points[k], detections.cov[k])
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
            self.state.remove_landmarks(~drop)
            self.tracks.keep(~drop)

    # --- scan term ---------------------------------------------------------------------------

    def _deskewed(self, observation: Observation) -> tuple[Observation, Sweep]:
        """The sweep at its stamp by the robot's own velocity: as it was, then as this tells it."""
        p, reach = self._p.scan_match, self._p.submap.max_laser_range
        first, sweep = deskewed(observation, self.state.velocity, reach)
        submap = self.submaps.target
        if not sweep.half.any() or submap is None or first.points is None:
            return first, sweep
        if len(first.points) < p.min_points:
            return first, sweep
        points = thinning.thin(first.points, p.voxel, p.max_points)
        state = copy.deepcopy(self.state)
        prior, strength = self._prior(sweep)
        found = match(submap, points, prior, strength, p, searched=False)
        if found.score < max(p.good_score, AS_USUAL * self.doubt.usual):
            return first, sweep
        self._fuse(state, found, self._information(submap, points, found), sweep)
        return deskewed(observation, state.velocity, reach)

    def _prior(self, sweep: Sweep) -> tuple[Array, Array]:
        """Where a match is expected in the submap (3,), and its information (3, 3)."""
        floor2 = np.array(self._p.scan_match.floor2)
        return prior_of(self.state.x, self.state.P, floor2, sweep.half, sweep.velocity)

    def _information(self, submap: Submap, points: Array, found: ScanMatchResult) -> Array:
        """What a match is worth (3, 3)."""
        alone = None if self._has_odometry else found.information
        return observability.information(submap, points, found.pose, self._p.scan_match, alone)

    def _fuse(
        self, state: JointState, found: ScanMatchResult, information: Array, sweep: Sweep
    ) -> None:
        """Update a state with a match.

        A speed is less sure than odometry: what it leads wrong by must not make a new one, and
        what it holds the match back by is made up for.
        """
        gate, pull = self._p.scan_match.prior_scale, np.zeros(3)
        if not self._has_odometry:
            gate, pull = gate / math.sqrt(3.0), found.pull
        fuse(
            state.x, state.P, found.pose, information, gate, pull, found.information,
            sweep.half, sweep.velocity,
        )  # fmt: skip

    def _matched_freely(
        self, submap: Submap, points: Array, prior: Array, strength: Array
    ) -> ScanMatchResult:
        """The match of a robot that only its speed leads to where it is: searched as far."""
        p = self._p.scan_match
        spread: Array = np.asarray(np.linalg.inv(strength), dtype=np.float64)
        reach = FAR * math.sqrt(ends_of(spread[:2, :2])[1])
        turn = min(FAR * math.sqrt(spread[2, 2]), p.wide_angle)
        window = (min(max(reach, p.search_window), p.wide_window), turn)
        return match(submap, points, prior, strength, p, window=window, usual=self.doubt.usual)

    def _use_scan(self, observation: Observation, matched: _Matched, sweep: Sweep) -> Evidence:
        """Match against the submap and update with the scan term (e_s of eq. 2)."""
        p = self._p.scan_match
        submap = self.submaps.target
        if observation.points is None:
            return Evidence(scan=False)
        if submap is None or len(observation.points) < p.min_points:
            return Evidence(scan=submap is None, beams=len(observation.points))
        points = thinning.thin(observation.points, p.voxel, p.max_points)
        prior, strength = self._prior(sweep)
        if self._has_odometry:
            found = match(submap, points, prior, strength, p, searched=False)
        else:
            found = self._matched_freely(submap, points, prior, strength)
        # where nothing but the speed leads to the start, a fit that is worse is of another place
        least = 0.0 if self._has_odometry else AS_USUAL * self.doubt.usual
        if found.score < max(p.good_score, least) or found.prior_weight < 0.5:
            searched = match(submap, points, prior, strength, p)
            found = searched if searched.score > found.score else found
        misfit = self.doubt.misfits(found.score, submap.insertions)
        if misfit and not matched.agrees and not self._lasts(observation.stamp):
            turn = TURN if self._has_odometry else math.pi
            found = second_look(submap, points, prior, self.doubt.usual, self._p, turn) or found
            misfit = self.doubt.misfits(found.score, submap.insertions)
        if found.score < p.min_score or (misfit and not matched.agrees):
            return Evidence(scan=True, misfit=misfit, beams=len(points), score=found.score)
        self.doubt.learn(found.score)
        information = self._information(submap, points, found)
        self._fuse(self.state, found, information, sweep)
        heading = float(self.state.anchor(0)[2])
        return Evidence(
            scan=True,
            used=True,
            misfit=misfit,
            beams=len(points),
            score=found.score,
            weak=weak_direction(information, heading, self._p.health.weak_sigma),
            prior_weight=found.prior_weight,
            iterations=found.iterations,
        )

    def _use_grid(self, observation: Observation) -> None:
        """Match against the grid of a saved map, where there is one."""
        points = observation.points
        if self._grid is None or points is None or len(points) < self._p.scan_match.min_points:
            return
        if self._grid.is_due(self.state.pose):
            self._fix = self._grid.fix(self.state, points)

    def _map_scan(self, observation: Observation, evidence: Evidence, elsewhere: bool) -> None:
        """Insert the scan into the submaps; a submap that is begun clones the pose.

        A single scan that does not fit is more likely a bad scan (a wrong stamp) than a new
        place, and would mislead all that follow; only where none fits for a while, it is new.
        Where it was taken ``elsewhere``, it would hide that the robot is lost.
        """
        if observation.points is None or observation.origin is None or elsewhere:
            return
        if len(observation.points) < self._p.scan_match.min_points:
            return
        if evidence.used or self.submaps.target is None:
            self._last_fit = observation.stamp
        elif observation.stamp - self._last_fit < self._p.health.patience * 1e9:
            return
        self.submaps.insert(self.state, observation.points, observation.origin)

    # --- result --------------------------------------------------------------------------------

    def _is_doubtful(
        self, observation: Observation, matched: _Matched, evidence: Evidence
    ) -> bool:
        """Whether the frame contradicts the map; while mapping, a new place does not forever."""
        d = observation.detections
        # one that tells who it is tells the back end more than that it does not fit here
        told = 0 if d is None else int(((d.ids != ANONYMOUS) & matched.open).sum())
        contradicted = self.doubt.judge(
            observation.stamp,
            evidence.misfit,
            evidence.used and evidence.weak is None,
            len(matched.status) - told,
            matched.num_used,
            bool(self.tracks.surveyed.any()),
        )
        p = self._p.health
        if self._map is None and self.doubt.lasts(observation.stamp, p.new_place_time):
            self.doubt, self.submaps = Doubt(p), Submaps(self._p.submap)
            return False
        return contradicted

    def _lasts(self, stamp: int) -> bool:
        """Whether the contradiction lasts for so long that the robot is lost."""
        return self.doubt.lasts(stamp, self._p.health.lost_time)

    def _judge(self, observation: Observation, matched: _Matched, evidence: Evidence) -> Health:
        due = self._due(observation, matched)
        used = matched.keys[matched.status == Status.USED]
        return self.health.judge(
            observation.stamp,
            evidence,
            odometry=observation.motion.known or not self._p.node.use_odom,
            detections=None if observation.detections is None else len(observation.detections),
            used=matched.num_used,
            cov=self.in_map(self.state.pose, self.state.pose_cov)[1],
            unconfirmed=self.confirmation.reason,
            lost=self.confirmation.is_lost,
            contradicted=self._lasts(observation.stamp) and not self.confirmation.is_pending,
            expected=int(due.sum()),
            seen=len(set(self.tracks.keys[due].tolist()).intersection(used.tolist())),
        )

    def _due(self, observation: Observation, matched: _Matched) -> NDArray[np.bool_]:
        """Which reflectors (m,) should have been detected; none where no one looked for them."""
        d, m = observation.detections, len(self.tracks)
        if d is None or observation.points is None or observation.origin is None:
            return np.zeros(m, dtype=np.bool_)
        used = d.points[matched.status == Status.USED]
        if len(used):
            self._reach = max(self._reach, float(np.hypot(used[:, 0], used[:, 1]).max()))
        due: NDArray[np.bool_] = self.tracks.confirmed(self._p.reflector.min_sightings)
        due &= expected(
            self.state.pose, self.state.landmarks(), observation.points, observation.origin,
            self._reach,
        )  # fmt: skip
        return due

    def _frame(
        self,
        observation: Observation,
        matched: _Matched,
        evidence: Evidence,
        health: Health,
        doubtful: bool,
        began: float,
    ) -> Frame:
        pose, cov = self.state.pose, self.state.pose_cov
        T_map_base, cov_map = self.in_map(pose, cov + self.late(observation.stamp_sigma))
        used = matched.status == Status.USED
        return Frame(
            stamp=observation.stamp,
            observation=observation,
            T_local_base=pose,
            cov_local=cov,
            T_map_base=T_map_base,
            cov_map=cov_map,
            landmarks=matched.keys,
            statuses=matched.status,
            health=health,
            scan_score=evidence.score,
            scan_used=evidence.used,
            chi2=float(np.nansum(matched.distance2[used])) if used.any() else 0.0,
            iterations=evidence.iterations,
            wall_ms=(time.perf_counter() - began) * 1e3,
            doubtful=doubtful or self.confirmation.is_pending,
            jumped=self._jumped,
        )

    def late(self, sigma: float) -> Array:
        """Covariance (3, 3) of how far the robot goes in the error ``sigma`` [s] of a stamp.

        It is published alone: one stamp's error is nearly that of the next, and of the map's.
        """
        if sigma == 0.0:
            return np.zeros((3, 3))
        R = np.eye(3)
        R[:2, :2] = se2.rotation(self.state.pose[2])
        gone = R @ self._velocity * sigma
        return np.outer(gone, gone)

    def reflectors(self) -> Reflectors:
        """The confirmed reflectors in the map frame."""
        # those out of the state come after those in it, as in everything()
        tracks = self._distant.all_tracks(self.tracks)
        _, places, covs = self._distant.everything(self.state, self.tracks)
        keep = tracks.confirmed(self._p.reflector.min_sightings)
        R = se2.rotation(self.T_map_local[2])
        return Reflectors(
            tracks.keys[keep],
            se2.transform(self.T_map_local, places[keep]),
            R @ covs[keep] @ R.T,
            tracks.ids[keep],
            tracks.sightings[keep],
            tracks.diameters[keep],
        )


class _Matched:
    """What became of each detection (k) so far in one step."""

    def __init__(self, k: int) -> None:
        self.index = np.full(k, -1, dtype=np.int64)
        self.keys = np.full(k, -1, dtype=np.int64)
        self.status = np.full(k, Status.NEW, dtype=np.int64)
        self.distance2 = np.full(k, np.nan)

    @classmethod
    def none(cls, detections: Detections | None) -> _Matched:
        return cls(0 if detections is None else len(detections))

    @property
    def num_used(self) -> int:
        """Detections that moved the estimate."""
        return int((self.status == Status.USED).sum()) if len(self.status) else 0

    @property
    def agrees(self) -> bool:
        """Whether enough of them match to speak for the map."""
        return consents(len(self.status), self.num_used)

    @property
    def open(self) -> NDArray[np.bool_]:
        """Detections without a reflector."""
        return self.index < 0


def _subset(d: Detections, rows: NDArray[np.int64]) -> Detections:
    return Detections(
        d.stamp, d.frame_id, d.points[rows], d.cov[rows], d.ids[rows], d.diameters[rows]
    )
