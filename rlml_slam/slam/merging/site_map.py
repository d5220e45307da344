# SPDX-License-Identifier: Apache-2.0
"""What placing needs of sessions: reflectors, and from where one would have seen them.

A session is the map of one drive. A site has several, each at a pose, and their reflectors once.
Both are small: the scans, keyframes and factors of a session stay in its file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.survey import Survey
from rlml_slam.se2 import Array
from rlml_slam.slam.store import map_file
from rlml_slam.types import ANONYMOUS

VIEW_SPACING = 2.0  # [m] between viewpoints that are kept
# [m] per axis by which a session may be bent: its covariances are those of its own first pose
BENT_SIGMA = 0.03
GATE = 4.0  # sigmas between one reflector in two sessions
FARTHEST = 0.5  # [m] between them in any case
REQUIRED = (
    'key_detector_ran', 'key_jumped', 'reflector_removed', 'reflector_history',
    'reflector_surveyed', 'reflector_view', 'sighting',
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Session:
    """Reflectors ``points`` (k, 2), ``cov`` (k, 2, 2), ``ids`` (k,) and ``keys`` (k,), own frame.

    ``views`` (v, 2) are places from which those within ``reach`` [m] would have been seen, unless
    something stood before them. ``path`` is the file of the map, None where there is none.
    """

    name: str
    path: Path | None
    points: Array
    cov: Array
    ids: NDArray[np.int64]
    keys: NDArray[np.int64]
    views: Array
    reach: float
    survey: Survey | None = None


@dataclass(frozen=True, eq=False)
class Site:
    """``sessions`` at ``poses`` (n, 3), and their reflectors in the frame of the site.

    ``rows`` has the row of ``points`` (m, 2) of each reflector of each session.
    """

    sessions: tuple[Session, ...]
    poses: Array
    points: Array
    cov: Array
    ids: NDArray[np.int64]
    rows: tuple[NDArray[np.int64], ...]

    @cached_property
    def views(self) -> list[tuple[Array, float]]:
        """Viewpoints (v, 2) of each session in the frame of the site, with their reach [m]."""
        return [(se2.transform(T, s.views), s.reach) for s, T in self.placed]

    @property
    def placed(self) -> list[tuple[Session, Array]]:
        """The sessions, each with its pose (3,)."""
        return list(zip(self.sessions, self.poses, strict=True))

    def pose_of(self, session: Session) -> Array:
        """Where a session lies (3,)."""
        return next(T for s, T in self.placed if s.name == session.name)

    @property
    def names(self) -> list[str]:
        """Names of the sessions."""
        return [s.name for s in self.sessions]

    def without(self, name: str) -> Site:
        """The site of all other sessions."""
        return site_of([(s, T) for s, T in self.placed if s.name != name])


def session_of(name: str, content: Content, path: Path | None = None) -> Session:
    """What placing needs of a saved map. Raises MapError where parts of it are missing."""
    a = content.arrays
    if not all(part in a for part in REQUIRED):
        raise MapError(f'{name} is incomplete: continue it with a drive and save it first')
    found = map_file.saved_map(content).reflectors
    looked = a['pose'][a['key_detector_ran'].astype(np.bool_)][:, :2]
    cells, first = np.unique(np.round(looked / VIEW_SPACING), axis=0, return_index=True)
    ranges = np.hypot(*a['sighting']['z'].T)
    reach = float(np.median(ranges)) if len(ranges) else 0.0
    return Session(
        name, path, found.points, found.cov, found.ids, found.keys,
        looked[np.sort(first)] if len(cells) else np.zeros((0, 2)), reach,
        map_file.survey_of(content),
    )  # fmt: skip


def site_of(placed: Iterable[tuple[Session, Array]]) -> Site:
    """The site of sessions at poses (3,); a reflector that several have seen is there once."""
    sessions, poses, rows = [], [], []
    points, cov = np.zeros((0, 2)), np.zeros((0, 2, 2))
    ids = np.zeros(0, dtype=np.int64)
    for session, T in placed:
        at, at_cov = se2.transform(T, session.points), turned(session.cov, T[2])
        at_cov = at_cov + BENT_SIGMA**2 * np.eye(2)
        match = pairs_of(points, cov, ids, at, at_cov, session.ids)
        seen, new = np.flatnonzero(match >= 0), np.flatnonzero(match < 0)
        row = match.copy()
        row[new] = len(points) + np.arange(len(new))
        for k, i in zip(seen.tolist(), match[seen].tolist(), strict=True):
            K = cov[i] @ np.linalg.inv(cov[i] + at_cov[k])
            points[i], cov[i] = points[i] + K @ (at[k] - points[i]), cov[i] - K @ cov[i]
            ids[i] = session.ids[k] if ids[i] == ANONYMOUS else ids[i]
        points, cov = np.concatenate([points, at[new]]), np.concatenate([cov, at_cov[new]])
        ids = np.concatenate([ids, session.ids[new]])
        sessions.append(session)
        poses.append(T)
        rows.append(row)
    return Site(
        tuple(sessions), np.array(poses).reshape(-1, 3), points, cov, ids, tuple(rows)
    )  # fmt: skip


def moved(site: Site, T: Array) -> list[tuple[Session, Array]]:
    """The sessions of a site that is put to ``T`` (3,)."""
    return list(zip(site.sessions, se2.compose(T, site.poses), strict=True))


def pairs_of(
    points: Array, cov: Array, ids: NDArray[np.int64],
    seen: Array, seen_cov: Array, seen_ids: NDArray[np.int64],
) -> NDArray[np.int64]:  # fmt: skip
    """Row of ``points`` (m, 2) for each of ``seen`` (k, 2), -1 for none.

    Each is the nearest of the other, within the gate, and no ids say otherwise.
    """
    match = np.full(len(seen), -1, dtype=np.int64)
    if not len(points) or not len(seen):
        return match
    gap = np.linalg.norm(seen[:, None] - points, axis=-1)
    gap[(seen_ids[:, None] != ids) & (seen_ids[:, None] != ANONYMOUS) & (ids != ANONYMOUS)] = (
        np.inf
    )
    variance = worst(seen_cov)[:, None] + worst(cov)
    near = (gap < np.minimum(GATE * np.sqrt(variance), FARTHEST)) & np.isfinite(gap)
    near &= (gap == gap.min(axis=0)) & (gap == gap.min(axis=1)[:, None])
    k, i = np.nonzero(near)
    match[k] = i
    return match


def match_of(part: Site, site: Site) -> NDArray[np.int64]:
    """Row in a site for each reflector (k,) of another one in the same frame, -1 for none."""
    return pairs_of(site.points, site.cov, site.ids, part.points, part.cov, part.ids)


def worst(cov: Array) -> Array:
    """Variance (n,) of the worst direction of each covariance (n, 2, 2)."""
    return np.asarray(np.linalg.eigvalsh(cov)[:, -1])


def turned(cov: Array, theta: float) -> Array:
    """Covariances (n, 2, 2) turned by an angle."""
    R = se2.rotation(theta)
    return np.asarray(R @ cov @ R.T)


def in_view(points: Array, views: Sequence[tuple[Array, float]]) -> NDArray[np.bool_]:
    """Whether each of ``points`` (k, 2) lies within the reach of any viewpoint."""
    out = np.zeros(len(points), dtype=np.bool_)
    for places, reach in views:
        if len(places) and len(points):
            gap = np.linalg.norm(points[:, None] - places, axis=-1)
            out |= gap.min(axis=1) < reach
    return out
