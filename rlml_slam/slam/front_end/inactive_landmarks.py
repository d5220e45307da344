# SPDX-License-Identifier: Apache-2.0
"""Reflectors out of range, removed from the joint state without loss of information.

An update costs the square of the size of the state. While reflectors b are out of range, no
measurement is of them: given the state s at which they were removed, they are independent of
all later measurements. So the conditional density p(b | s) stays,

    b = b_0 + W (s - s_0) + noise of covariance C,  W = P_bs P_ss^-1,  C = P_bb - W P_sb,

and s stays in the state: its reflectors are there anyway, and of what changes (pose, bias,
velocity, anchors) a clone is. Restoring b gives the estimate of the full state, to the accuracy of
W, as the compressed filter of Guivant and Nebot (2001).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam.estimation.landmark_tracks import LandmarkTracks
from rlml_slam.se2 import Array
from rlml_slam.slam.front_end.joint_state import LANDMARKS, JointState
from rlml_slam.slam.front_end.map_window import MARGIN
from rlml_slam.types import ANONYMOUS

MIN_INACTIVE = 10  # removing fewer reflectors saves less time than it takes
SINGULAR = 1e-12  # relative eigenvalue of an exact dependence, such as a clone of a clone


class InactivePart:
    """The reflectors where ``away`` (m,) is true, removed from a state; see the module."""

    def __init__(self, state: JointState, away: NDArray[np.bool_]) -> None:
        b = _rows(np.flatnonzero(away))
        s = np.r_[0:LANDMARKS, _rows(np.flatnonzero(~away))]
        self._s, self._b = state.x[s], state.x[b]
        _, inverse = _roots(state.P[np.ix_(s, s)])
        Y = inverse @ state.P[np.ix_(s, b)]
        self._W = Y.T @ inverse
        self._C = state.P[np.ix_(b, b)]
        self._C -= Y.T @ Y
        state.leave_out(away)

    def put_back(self, state: JointState) -> None:
        """Append them to the state, after its reflectors."""
        s = state.tied
        b = self._b + self._W @ (state.x[s] - self._s)
        WL = self._W @ _roots(state.P[np.ix_(s, s)])[0]
        self._C += WL @ WL.T
        state.put_back(b, state.P[:, s] @ self._W.T, self._C)

    def positions(self, state: JointState) -> tuple[Array, Array]:
        """Positions (k, 2) and covariances (k, 2, 2), given the current state."""
        s, k = state.tied, np.arange(len(self._b) // 2)
        b = self._b + self._W @ (state.x[s] - self._s)
        C = self._C.reshape(len(k), 2, len(k), 2)[k, :, k, :]
        W = self._W.reshape(len(k), 2, -1)
        WP = (self._W @ state.P[np.ix_(s, s)]).reshape(W.shape)
        return b.reshape(-1, 2), C + WP @ W.transpose(0, 2, 1)


class InactiveLandmarks:
    """Keeps the confirmed reflectors beyond ``max_range`` [m] out of a state and its tracks."""

    def __init__(self, max_range: float, min_sightings: int) -> None:
        self._max_range = max_range
        self._min_sightings = min_sightings
        self._part: InactivePart | None = None
        self._tracks = LandmarkTracks()
        self._centre, self._sigma = np.full(2, np.inf), 0.0

    def update(self, state: JointState, tracks: LandmarkTracks, ids: NDArray[np.int64]) -> None:
        """Exchange reflectors if the pose is far from the centre of the part in the state.

        A reflector whose id is among the detected ``ids`` (k,) is always in the state.
        """
        at, P = state.pose[:2], state.P
        sigma = math.sqrt(P[0, 0] + P[1, 1])
        out = self._tracks.ids
        seen = len(out) > 0 and bool(np.isin(out, ids[ids != ANONYMOUS]).any())
        if np.hypot(*(at - self._centre)) + 3.0 * (sigma - self._sigma) <= MARGIN and not seen:
            return
        self.restore(state, tracks)
        self._centre, self._sigma = at, sigma
        gap = np.hypot(*(state.landmarks() - at).T)
        away = gap > self._max_range + MARGIN + 3.0 * np.maximum(_sigmas_from(state), sigma)
        away &= tracks.confirmed(self._min_sightings)
        away &= (tracks.ids == ANONYMOUS) | ~np.isin(tracks.ids, ids)
        if away.sum() > MIN_INACTIVE:
            self._part = InactivePart(state, away)
            self._tracks = tracks.take(away)

    def all_landmarks(
        self, state: JointState, tracks: LandmarkTracks
    ) -> tuple[NDArray[np.int64], Array, Array]:
        """Keys (n,), positions (n, 2) and covariances (n, 2, 2), inactive reflectors last."""
        if self._part is None:
            return tracks.keys, state.landmarks(), state.landmark_covs()
        points, covs = self._part.positions(state)
        return (
            np.concatenate([tracks.keys, self._tracks.keys]),
            np.concatenate([state.landmarks(), points]),
            np.concatenate([state.landmark_covs(), covs]),
        )

    def all_tracks(self, tracks: LandmarkTracks) -> LandmarkTracks:
        """Tracks of all reflectors, in the order of :meth:`all_landmarks`."""
        every = replace(tracks)
        every.extend(self._tracks)
        return every

    def has(self, keys: NDArray[np.int64]) -> bool:
        """Whether any of ``keys`` (k,) is inactive."""
        return bool(np.isin(self._tracks.keys, keys).any())

    def restore(self, state: JointState, tracks: LandmarkTracks) -> None:
        """Put all inactive reflectors back into the state."""
        if self._part is not None:
            self._part.put_back(state)
            tracks.extend(self._tracks)
            self._part, self._tracks = None, LandmarkTracks()
        self._centre = np.full(2, np.inf)


def _sigmas_from(state: JointState) -> Array:
    """Sigmas (m,) [m] of the positions of reflectors relative to the pose, of both axes."""
    x = slice(LANDMARKS, LANDMARKS + 2 * state.num_landmarks, 2)
    y = slice(x.start + 1, x.stop, 2)
    P = state.P
    own = P.diagonal()[x] + P.diagonal()[y] + P[0, 0] + P[1, 1]
    out: Array = np.sqrt(np.maximum(own - 2.0 * (P[0, x] + P[1, y]), 0.0))
    return out


def _rows(landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
    first = LANDMARKS + 2 * landmarks
    return np.stack([first, first + 1], -1).ravel()


def _roots(P: Array) -> tuple[Array, Array]:
    """L (n, r) and M (r, n) of a covariance P = L L^T that may be singular; M^T M inverts it."""
    scale = np.sqrt(np.diag(P))
    scale[scale == 0.0] = 1.0
    value, vector = np.linalg.eigh(P / np.outer(scale, scale))
    keep = value > SINGULAR
    V, sigma = vector[:, keep], np.sqrt(value[keep])
    return V * sigma * scale[:, None], (V / sigma / scale[:, None]).T
