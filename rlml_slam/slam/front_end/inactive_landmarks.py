# SPDX-License-Identifier: Apache-2.0
"""Reflectors out of reach, left out of the joint state without losing anything.

An update costs the square of what is in the state. Nothing that is measured while they are out of
reach is of the distant reflectors b themselves: given the state s of the moment at which they were
left out, they are independent of all of it. So p(b | s) of that moment stays as it is,

    b = b_0 + W (s - s_0) + noise of covariance C,  W = P_bs P_ss^-1,  C = P_bb - W P_sb,

and s stays in the state: the reflectors in reach are there anyway, of what moves (pose, bias,
velocity, anchors) a clone is. Putting them back gives what the whole state would have, to the
accuracy of W, as the compressed filter of Guivant and Nebot (2001) does.
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

FEW = 10  # reflectors, for which it is not worth the while
# Parts of the variance below this are of what is known exactly, such as a clone of a clone
SINGULAR = 1e-12


class LeftOut:
    """The reflectors where ``away`` (m,) is true, taken out of a state; see the module."""

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
        """Append them to the state, after the reflectors that it has."""
        s = state.tied
        b = self._b + self._W @ (state.x[s] - self._s)
        WL = self._W @ _roots(state.P[np.ix_(s, s)])[0]
        self._C += WL @ WL.T
        state.put_back(b, state.P[:, s] @ self._W.T, self._C)

    def places(self, state: JointState) -> tuple[Array, Array]:
        """Where they are, (k, 2) and covariances (k, 2, 2), in view of what the state is now."""
        s, k = state.tied, np.arange(len(self._b) // 2)
        b = self._b + self._W @ (state.x[s] - self._s)
        C = self._C.reshape(len(k), 2, len(k), 2)[k, :, k, :]
        W = self._W.reshape(len(k), 2, -1)
        WP = (self._W @ state.P[np.ix_(s, s)]).reshape(W.shape)
        return b.reshape(-1, 2), C + WP @ W.transpose(0, 2, 1)


class InactiveLandmarks:
    """Keeps the confirmed reflectors beyond ``reach`` [m] out of a state and its tracks."""

    def __init__(self, reach: float, min_sightings: int) -> None:
        self._reach = reach
        self._min_sightings = min_sightings
        self._left_out: LeftOut | None = None
        self._tracks = LandmarkTracks()
        self._middle, self._sigma = np.full(2, np.inf), 0.0

    def follow(self, state: JointState, tracks: LandmarkTracks, ids: NDArray[np.int64]) -> None:
        """Exchange reflectors where the pose left the middle of the part that is in the state.

        One that tells by ``ids`` (k,) that it is seen is in reach, wherever it was believed.
        """
        at, P = state.pose[:2], state.P
        sigma = math.sqrt(P[0, 0] + P[1, 1])
        out = self._tracks.ids
        seen = len(out) > 0 and bool(np.isin(out, ids[ids != ANONYMOUS]).any())
        if np.hypot(*(at - self._middle)) + 3.0 * (sigma - self._sigma) <= MARGIN and not seen:
            return
        self.gather(state, tracks)
        self._middle, self._sigma = at, sigma
        gap = np.hypot(*(state.landmarks() - at).T)
        away = gap > self._reach + MARGIN + 3.0 * np.maximum(_sigmas_from(state), sigma)
        away &= tracks.confirmed(self._min_sightings)
        away &= (tracks.ids == ANONYMOUS) | ~np.isin(tracks.ids, ids)
        if away.sum() > FEW:
            self._left_out = LeftOut(state, away)
            self._tracks = tracks.take(away)

    def everything(
        self, state: JointState, tracks: LandmarkTracks
    ) -> tuple[NDArray[np.int64], Array, Array]:
        """Keys (n,), places (n, 2) and covariances (n, 2, 2) of those in and out of the state."""
        if self._left_out is None:
            return tracks.keys, state.landmarks(), state.landmark_covs()
        points, covs = self._left_out.places(state)
        return (
            np.concatenate([tracks.keys, self._tracks.keys]),
            np.concatenate([state.landmarks(), points]),
            np.concatenate([state.landmark_covs(), covs]),
        )

    def all_tracks(self, tracks: LandmarkTracks) -> LandmarkTracks:
        """The tracks of those in and out of the state, in the order of :meth:`everything`."""
        every = replace(tracks)
        every.extend(self._tracks)
        return every

    def has(self, keys: NDArray[np.int64]) -> bool:
        """Whether any of ``keys`` (k,) is out of the state."""
        return bool(np.isin(self._tracks.keys, keys).any())

    def gather(self, state: JointState, tracks: LandmarkTracks) -> None:
        """Put all of them back."""
        if self._left_out is not None:
            self._left_out.put_back(state)
            tracks.extend(self._tracks)
            self._left_out, self._tracks = None, LandmarkTracks()
        self._middle = np.full(2, np.inf)


def _sigmas_from(state: JointState) -> Array:
    """Sigmas (m,) [m] of where reflectors are from the pose, both directions together."""
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
