# SPDX-License-Identifier: Apache-2.0
"""Scan matching against the grid of a saved map: the scan term of eq. 2 with a fixed map.

Between two matches, the front end's own submaps hold the pose. One match per keyframe distance is
enough: closer ones would have the same errors of the same walls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rlml_slam import se2
from rlml_slam.estimation.kidnapping_detection import UsualScore
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.matching.reflectors.association import gate
from rlml_slam.matching.scans import scan_information, voxel_filter
from rlml_slam.matching.scans.scan_match import match
from rlml_slam.matching.scans.submap import Submap
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.sensing.velocity_deskew import Sweep
from rlml_slam.slam.front_end.joint_state import VELOCITY, JointState
from rlml_slam.slam.relocalization.grid_submap import may_be, submap_of, unmapped_share

GATE_PROBABILITY = 0.9999  # of the gate of a match against the prior
WEAK = 0.75  # of the usual score; walls of another place may fit as well as that
BEAM_STEP = 4  # of a scan that does not match, every n-th beam is traced through the grid
MARGIN = 1e-4  # of a covariance that is never taken as shared
LEAST = 1e-9  # information relative to that of the prior, below which there is none
KNOWN = 1e-12  # [m², rad²] smallest eigenvalue of the covariance of a pose that is given
POSE_AND_SWEEP = np.r_[0:3, VELOCITY : VELOCITY + 3]


@dataclass(frozen=True)
class GridMatch:
    """Result of a match with the grid; ``score`` is NaN if there was none.

    ``used``: it holds the pose; ``is_complete``: in every direction. ``contradicts``: the scan
    does not fit the known part of the grid; ``is_weak``: it does, but worse than scans did lately;
    ``is_elsewhere``: it fits, beyond the gate.
    """

    score: float
    used: bool = False
    is_complete: bool = False
    contradicts: bool = False
    is_weak: bool = False
    is_elsewhere: bool = False

    @property
    def refutes(self) -> bool:
        """Whether the scan does not fit the grid near this pose as it should, unknown cells aside.

        Submaps of the drive learn a new place within a few scans, a saved grid does not. Walls of
        other places are alike, so that a weak fit does not overrule reflectors.
        """
        return self.contradicts or self.is_weak or self.is_elsewhere


def map_information(submap: Submap, points: Array, pose: Array, params: Parameters) -> Array:
    """Information (3, 3) of a match with the grid of a saved map, in the frame of the submap.

    The error of the map at this place is one that more beams do not lower.
    """
    information = scan_information.information(submap, points, pose, params.scan_match)
    floor = np.diag(params.submap.grid_bias_variance)
    out = np.linalg.solve(np.eye(3) + information @ floor, information)
    return np.asarray(0.5 * (out + out.T), dtype=np.float64)


def at_most(shared: Array, cov: Array) -> Array:
    """The part (3, 3) of a shared covariance that a covariance may contain, less MARGIN."""
    if not shared.any() or np.linalg.eigvalsh(cov)[0] < KNOWN:
        return np.zeros_like(cov)
    L = np.linalg.cholesky(cov)
    values, axes = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, shared).T))
    root = L @ axes * np.sqrt(np.clip(values, 0.0, 1.0 - MARGIN))
    return np.asarray(root @ root.T, dtype=np.float64)


def relative_update(cov: Array, shared: Array, root: Array, v: Array) -> tuple[Array, Array]:
    """Rows (m, 3) and their values (m,) of unit variance that update a pose as a match does.

    A match with ``root`` and ``v`` measures the pose relative to a map that is off by an error of
    covariance ``shared``, which ``cov`` (3, 3) contains and which no match lowers:
    cov' = ((cov - shared)^-1 + I)^-1 + shared (a consider state, Schmidt 1966). What is returned
    has the same mean and covariance of the pose, and keeps that of all else positive definite.
    """
    L = np.linalg.cholesky(cov)  # from here on relative to cov, which is then the unit matrix
    unit, inside = np.eye(3), np.linalg.solve(L, np.linalg.solve(L, shared).T)
    H = root @ L
    relative = np.linalg.inv(np.linalg.inv(unit - inside) + H.T @ H)
    inverse = np.linalg.inv(relative + inside)
    moved = inverse @ (relative @ (H.T @ v))
    values, axes = np.linalg.eigh(0.5 * (inverse + inverse.T) - unit)
    values, axes = values[-len(v) :], axes[:, -len(v) :]
    if values[-1] < LEAST:  # the match tells nothing that was not known
        return np.zeros_like(root), np.zeros_like(v)
    scale = np.sqrt(np.maximum(values, 1e-9 * values[-1]))
    return np.linalg.solve(L.T, axes * scale).T, (axes.T @ moved) / scale


class GridLocalizer:
    """Matches scans with a grid.

    All matches share the error of the cells: the filter runs relative to a map that is off by it,
    so that no number of matches makes the pose surer than the cells are.
    """

    def __init__(self, grid: OccupancyGrid, params: Parameters) -> None:
        self._p = params
        self._saved = submap_of(grid, params.submap)
        self._floor = np.diag(params.submap.grid_bias_variance)
        self._gate = [gate(GATE_PROBABILITY, dof) for dof in (1, 2, 3)]
        self._last: Array | None = None
        self._is_refuted = False
        self._scores = UsualScore()

    def is_due(self, pose: Array) -> bool:
        """Whether the pose (3,) is at least a keyframe distance from the last match, or refuted.

        One bad scan is no verdict on a robot that stands.
        """
        return self._is_refuted or self._is_far(pose)

    def _is_far(self, pose: Array) -> bool:
        if self._last is None:
            return True
        step, p = se2.between(self._last, pose), self._p.back_end
        far = math.hypot(step[0], step[1]) >= p.minimum_travel_distance
        return far or abs(float(step[2])) >= p.minimum_travel_heading

    def update(self, state: JointState, points: Array, sweep: Sweep) -> GridMatch:
        """Match end points (n, 2), base frame, and update the state if the match is accepted.

        They constrain the pose at the middle of the ``sweep``, as in the scan term. Less than a
        keyframe distance from the last match, the state stays as it is.
        """
        found = self._match(state, points, sweep)
        self._is_refuted = found.refutes
        return found

    def _match(self, state: JointState, points: Array, sweep: Sweep) -> GridMatch:
        p = self._p.scan_match
        points = voxel_filter.thin(points, p.voxel_size, p.max_points)
        submap, yaw = self._saved.submap, self._saved.yaw
        J = np.hstack([np.eye(3), se2.rotation3(float(state.x[2])) * sweep.half])
        middle = state.pose + J[:, 3:] @ (state.velocity - sweep.velocity)
        prior = self._saved.from_map(middle)
        cov = J @ state.P[np.ix_(POSE_AND_SWEEP, POSE_AND_SWEEP)] @ J.T
        strength = np.asarray(np.linalg.inv(cov + self._floor), dtype=np.float64)
        strength = se2.rotate_cov(strength, -yaw)
        found = match(submap, points, prior, strength, p, searched=False)
        if found.score < p.search_threshold:
            searched = match(submap, points, prior, strength, p)
            found = searched if searched.score > found.score else found
        usual = self._scores.mean if self._scores.is_settled else 0.0
        is_weak = is_misfit = False
        if found.score < max(WEAK * usual, p.min_score):
            open_share = unmapped_share(submap, points[::BEAM_STEP], found.pose)
            is_weak = may_be(found.score, open_share, usual) < WEAK * usual
            is_misfit = may_be(found.score, open_share, p.search_threshold) < p.min_score
        if found.score < p.min_score:
            return GridMatch(found.score, contradicts=is_weak or is_misfit)
        information = map_information(submap, points, found.pose, self._p)
        values, axes = np.linalg.eigh(information)
        keep = values > 1e-6
        root = (axes[:, keep] * np.sqrt(values[keep])).T
        offset = found.pose - prior
        offset[2] = se2.wrap(offset[2])
        v = root @ offset
        root = root @ se2.rotation3(yaw).T  # from here on in the axes of the map
        S = root @ (cov + self._saved.cov_cell) @ root.T + np.eye(len(v))
        d2 = float(v @ np.linalg.solve(S, v))
        if not len(v) or d2 > self._gate[len(v) - 1]:
            return GridMatch(found.score, is_weak=is_weak, is_elsewhere=True)
        if self._is_far(state.pose):
            shared = at_most(self._saved.cov_cell, cov)
            if shared.any():
                root, v = relative_update(cov, shared, root, v)
            state.apply(POSE_AND_SWEEP, root @ J, np.eye(len(v)), v)
            self._last = state.pose
            self._scores.learn(found.score)
        weakest = self._p.health.degeneracy_sigma**-2
        is_complete = len(v) == 3 and float(values[0]) >= weakest
        return GridMatch(found.score, True, is_complete, is_weak=is_weak)
