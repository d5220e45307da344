# SPDX-License-Identifier: Apache-2.0
"""Where a session lies in a site, by the constellation of its reflectors, or that nobody knows.

How far two partial maps overlap is not known, so a pose with fewer matches may be the true one:
sites repeat their aisles. A pose is accepted only where every other one that chance does not
explain is refuted by what should have been seen there and was not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from rlml_slam import se2
from rlml_slam.matching.reflectors.constellation import Constellation, locate
from rlml_slam.matching.reflectors.pair_votes import MAX_TESTS, MIN_MATCHES
from rlml_slam.params import Relocalization
from rlml_slam.se2 import Array
from rlml_slam.slam.merging.site_map import Session, Site, in_view, match_of, moved, site_of
from rlml_slam.types import Verdict

# most reflectors of a session may be in places that the site does not cover
UNMATCHED_SHARE = 0.95
TEST_FACTOR = 50  # times the tests of a relocalization: no robot waits, a minute is allowed
RIVAL_CHANCE = 1e-2  # expected number of random poses below which a pose is a rival
WINDOW = 10  # neighbours that are searched by themselves
MAX_WINDOWS = 16
SAME = np.array([1.0, 1.0, 0.05])  # [m, m, rad] two votes for a pose agree within this


@dataclass(frozen=True)
class Placement:
    """``pose`` (3,) in the frame of the site, None where it is not determined, and why.

    ``matches`` reflectors speak for it. ``rivals`` (r, 3) are poses that may be meant as well.
    """

    pose: Array | None
    why: str
    matches: int = 0
    rivals: Array = field(default_factory=lambda: np.zeros((0, 3)))


class Fit(NamedTuple):
    """A pose (3,) of a session with the row in the site of each reflector (k,), -1 for none.

    Of ``expected`` reflectors that both should have seen, ``unseen`` are in one only.
    """

    pose: Array
    match: NDArray[np.int64]
    unseen: int
    expected: int

    @property
    def num_matches(self) -> int:
        """Reflectors that both have."""
        return int((self.match >= 0).sum())


def place_session(session: Session, site: Site, p: Relocalization) -> Placement:
    """Search a session in the reflectors of a site."""
    stars = _search(session, site, p, np.arange(len(session.points)))
    if not stars.candidates or stars.chance > p.false_positive_probability:
        return Placement(None, stars.why)
    if stars.verdict is Verdict.AMBIGUOUS and len(stars.candidates) == 1:
        return Placement(None, stars.why, 0, stars.candidates[0].pose[None])
    poses = _poses(stars)
    for rows in _windows(session.points):
        poses += _poses(_search(session, site, p, rows))
    standing, fits = _standing(_different(poses), session, site, p)
    rivals = np.array([f.pose for f in fits]).reshape(-1, 3)
    if not standing:
        why = f'{stars.why}, but too many reflectors that both should have seen are in one only'
        return Placement(None, why, 0, rivals)
    best, count = standing[0], len(session.points)
    if len(standing) > 1:
        why = (
            f'{len(standing)} poses fit: {best.num_matches} of {count} reflectors match at the '
            f'first, {standing[1].num_matches} at the next'
        )
        return Placement(None, why, 0, rivals)
    why = f'{best.num_matches} of {count} reflectors match at one pose'
    return Placement(best.pose, why, best.num_matches)


def _search(
    session: Session, site: Site, p: Relocalization, rows: NDArray[np.int64]
) -> Constellation:
    """Reflectors ``rows`` (k,) of a session in a site."""
    return locate(
        session.points[rows], session.cov[rows], site.points, site.cov,
        replace(p, false_share=UNMATCHED_SHARE, max_range=0.0),
        max_tests=TEST_FACTOR * MAX_TESTS,
    )  # fmt: skip


def _poses(stars: Constellation) -> list[Array]:
    """All poses found that chance does not explain."""
    return [c.pose for c in (*stars.candidates, *stars.rivals) if c.chance < RIVAL_CHANCE]


def _windows(points: Array) -> list[NDArray[np.int64]]:
    """Rows of WINDOW neighbours around places that lie far apart, all over ``points`` (k, 2).

    The search of all reflectors keeps the poses at which nearly as many match as at the best one.
    What repeats may be a part of them: it is found by searching each part.
    """
    if len(points) <= WINDOW:
        return []
    centres = [0]
    gap = np.linalg.norm(points - points[0], axis=1)
    while len(centres) < min(MAX_WINDOWS, 2 * len(points) // WINDOW):
        centres.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[centres[-1]], axis=1))
    away = np.linalg.norm(points[centres][:, None] - points, axis=-1)
    return list(np.argsort(away, axis=1, kind='stable')[:, :WINDOW])


def _different(poses: Sequence[Array]) -> list[Array]:
    """The first of all poses (3,) that are nearly the same."""
    out: list[Array] = []
    for pose in poses:
        if not out or not _near(np.array(out), pose).any():
            out.append(pose)
    return out


def _standing(
    poses: Sequence[Array], session: Session, site: Site, p: Relocalization
) -> tuple[list[Fit], list[Fit]]:
    """Fits that nothing unseen refutes, the best first; and all of them."""
    fits = [_fit(pose, session, site) for pose in poses]
    fits = [f for f in fits if f.num_matches >= MIN_MATCHES]
    possible = [f for f in fits if not is_contradicted(f.unseen, f.expected, p)]
    possible.sort(key=lambda f: (-f.num_matches, f.unseen))
    if not possible:
        return [], fits
    least = possible[0].unseen
    likely = [
        f for f in possible
        if p.missed_share ** max(0, f.unseen - least) >= p.false_positive_probability
    ]  # fmt: skip
    return likely, fits


def _fit(pose: Array, session: Session, site: Site) -> Fit:
    """What matches at a pose, fitted to it."""
    there = site_of([(session, pose)])
    match = match_of(there, site)
    seen = match >= 0
    if seen.sum() >= MIN_MATCHES:
        pose = se2.compose(se2.align(there.points[seen], site.points[match[seen]]), pose)
        match = match_of(site_of([(session, pose)]), site)
    return Fit(pose, match, *unseen_at(pose, session, site, match))


def unseen_at(
    pose: Array, session: Session, site: Site, match: NDArray[np.int64]
) -> tuple[int, int]:
    """Reflectors of either that the other one should have seen and has not; of how many.

    ``match`` (k,) is the row in the site of each reflector of the session, -1 for none.
    """
    there = in_view(se2.transform(pose, session.points), site.views)
    back = se2.transform(se2.inverse(pose), site.points)
    here = in_view(back, [(session.views, session.reach)])
    matched = match >= 0
    of_site = np.zeros(len(site.points), dtype=np.bool_)
    of_site[match[matched]] = True
    unseen = int((there & ~matched).sum() + (here & ~of_site).sum())
    return unseen, unseen + int(matched.sum())


def is_contradicted(unseen: int, expected: int, p: Relocalization) -> bool:
    """Whether more of the expected reflectors are unseen than are ever missed."""
    return bool(bdtrc(unseen - 1, expected, p.missed_share) < p.false_positive_probability)


def place_site(part: Site, site: Site, p: Relocalization) -> Placement:
    """Search a site in another one: each session of it by itself, and all have to agree."""
    votes: list[tuple[Array, Placement]] = []
    doubts: list[tuple[Array, Placement]] = []
    for session, T in zip(part.sessions, part.poses, strict=True):
        found, back = place_session(session, site, p), se2.inverse(T)
        if found.pose is not None:
            votes.append((se2.compose(found.pose, back), found))
        elif len(found.rivals):
            doubts.append((se2.compose(found.rivals, back), found))
    if not votes:
        why = doubts[0][1].why if doubts else 'too few reflectors in common'
        return Placement(None, why)
    pose, best = max(votes, key=lambda vote: vote[1].matches)
    others = [T[None] for T, _ in votes] + [T for T, _ in doubts]
    if not all(_near(T, pose).any() for T in others):
        return Placement(None, f'its sessions do not agree where it lies: {best.why}')
    pose = _fitted(part, site, pose)
    return Placement(pose, best.why, best.matches)


def _near(poses: Array, pose: Array) -> Array:
    """Whether each pose (n, 3) is nearly the same as another one."""
    return np.asarray((np.abs(se2.between(pose, poses)) < SAME).all(axis=-1))


def _fitted(part: Site, site: Site, pose: Array) -> Array:
    """Least squares over all reflectors that both have."""
    there = site_of(moved(part, pose))
    match = match_of(there, site)
    seen = match >= 0
    if seen.sum() < MIN_MATCHES:
        return pose
    return se2.compose(se2.align(there.points[seen], site.points[match[seen]]), pose)


def joined(site: Site, part: Site, pose: Array) -> Site:
    """One site of two, the second at ``pose`` (3,) in the first."""
    return site_of([*site.placed, *moved(part, pose)])
