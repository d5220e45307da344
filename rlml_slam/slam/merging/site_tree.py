# SPDX-License-Identifier: Apache-2.0
"""Sessions become one site: a tree of merges, then every session is searched in all others.

A node of the tree merges what its children could place, and passes on what nobody could: with
more sessions it may fit. The largest site at the root is the map. Two aisles that look alike may
have been taken for one before the session came that has seen both; so each session of the map is
searched again in all others, and leaves it where more than one pose fits.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.survey_alignment import place as place_in_survey
from rlml_slam.params import Parameters, Relocalization
from rlml_slam.se2 import Array
from rlml_slam.slam.merging.placement import SAME, Placement, joined, place_session, place_site
from rlml_slam.slam.merging.scan_placement import grid_of, place_by_scans
from rlml_slam.slam.merging.site_map import Session, Site, site_of
from rlml_slam.types import Reflectors

# function and its arguments, one sequence for each; the results in order, as a list
Mapper = Callable[..., list[Any]]
SURVEYED = 'placed by the survey'
SURVEY = '(survey)'  # its name among the sessions


class Placed(NamedTuple):
    """The site, by what each of its sessions is held, and why others are left out; by name."""

    site: Site
    why: dict[str, str]
    left_out: dict[str, Placement]
    is_in_survey_frame: bool = False


def in_this_process(function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
    """Results of a function for each of the arguments."""
    return list(map(function, *arguments))


def place_sessions(
    sessions: Sequence[Session], params: Parameters, survey: Survey | None = None,
    run: Mapper = in_this_process,
) -> Placed:  # fmt: skip
    """Place sessions in one frame: that of the survey, else of the first session in the map."""
    leaves, why = _leaves(sessions, params, survey, run)
    p = params.relocalization
    while len(leaves) > 1:
        left, right = leaves[::2], leaves[1::2]
        last = [leaves[-1]] if len(leaves) % 2 else []
        leaves = run(merge_node, left[: len(right)], right, [p] * len(right)) + last
    pieces = leaves[0]
    main = max(
        pieces,
        key=lambda s: (bool(why) and SURVEY in s.names, len({*s.names} - {SURVEY}), len(s.points)),
    )
    others = [s for piece in pieces if piece is not main for s in piece.sessions]
    others = [s for s in others if s.name != SURVEY]
    placed = _by_scans(_verified(main, others, why, p, run), sessions, params)
    if SURVEY not in placed.site.names:
        return placed
    return placed._replace(site=placed.site.without(SURVEY), is_in_survey_frame=True)


def _leaves(
    sessions: Sequence[Session], params: Parameters, survey: Survey | None, run: Mapper
) -> tuple[list[list[Site]], dict[str, str]]:
    """Every session by itself, and the survey with the sessions that it places."""
    alone = [[site_of([(s, np.zeros(3))])] for s in sessions]
    if survey is None:
        return alone, {}
    n, sigma = len(sessions), params.back_end.survey_sigma
    found = run(in_survey, sessions, [survey] * n, [sigma] * n)
    held = [(s, T) for s, (T, _) in zip(sessions, found, strict=True) if T is not None]
    why = {s.name: w for s, (T, w) in zip(sessions, found, strict=True) if T is not None}
    left = [leaf for leaf in alone if leaf[0].sessions[0].name not in why]
    return [[site_of([(session_of_survey(survey, sigma), np.zeros(3)), *held])], *left], why


def session_of_survey(survey: Survey, sigma: float) -> Session:
    """A survey as a session that has seen its reflectors, from nowhere."""
    n = len(survey.points)
    return Session(
        SURVEY, None, survey.points, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), survey.ids,
        np.arange(n), np.zeros((0, 2)), 0.0,
    )  # fmt: skip


def in_survey(session: Session, survey: Survey, sigma: float) -> tuple[Array | None, str]:
    """Pose (3,) of a session in the frame of a survey, None where it does not give one; why."""
    if session.survey is not None:  # it is in that frame
        return np.zeros(3), f'{SURVEYED} of its map'
    n = len(session.points)
    found = Reflectors(
        session.keys, session.points, session.cov, session.ids,
        np.ones(n, dtype=np.int64), np.full(n, np.nan),
    )  # fmt: skip
    placed = place_in_survey(found, survey, sigma)
    return placed.T_survey_map, f'{SURVEYED}: {placed.why}'


def merge_node(left: list[Site], right: list[Site], p: Relocalization) -> list[Site]:
    """Sites of two children; those that fit are one, the most certain first."""
    sites = [*left, *right]
    untried = set(itertools.product(range(len(left)), range(len(left), len(sites))))
    found: dict[tuple[int, int], Placement] = {}
    alive = set(range(len(sites)))
    while untried:
        for i, j in sorted(untried):
            found[i, j] = place_site(*_ordered(sites, i, j)[::-1], p)
        fits = {pair: f for pair, f in found.items() if f.pose is not None}
        if not fits:
            break
        pair = max(fits, key=lambda k: (fits[k].matches, -k[0], -k[1]))
        pose = fits[pair].pose
        assert pose is not None
        site, part = _ordered(sites, *pair)
        alive -= set(pair)
        untried = {(k, len(sites)) for k in alive}
        found = {k: f for k, f in found.items() if alive.issuperset(k)}
        alive.add(len(sites))
        sites.append(joined(site, part, pose))
    return [sites[k] for k in sorted(alive)]


def _ordered(sites: Sequence[Site], i: int, j: int) -> tuple[Site, Site]:
    """Two sites, the one first whose frame is kept: that of more sessions, else the earlier."""
    a, b = sites[i], sites[j]
    return (b, a) if len(b.sessions) > len(a.sessions) else (a, b)


def _verified(
    site: Site, others: Sequence[Session], why: dict[str, str], p: Relocalization, run: Mapper
) -> Placed:
    """The site without what does not fit it in exactly one way; others where they do.

    What was left out is tried once more: a wrong neighbour may have been the reason.
    """
    left_out: dict[str, Placement] = {}
    waiting, removed = list(others), set[str]()
    while True:
        site, wrong = _checked(site, why, p, run)
        left_out |= {s.name: doubt for s, doubt in wrong}
        waiting += [s for s, _ in wrong if s.name not in removed]
        removed |= {s.name for s, _ in wrong}
        found = run(place_session, waiting, [site] * len(waiting), [p] * len(waiting))
        fits = list(zip(waiting, found, strict=True))
        new = [(s, f.pose) for s, f in fits if f.pose is not None]
        left_out |= {s.name: f for s, f in fits}
        left_out = {n: f for n, f in left_out.items() if n not in {s.name for s, _ in new}}
        if not new:
            return Placed(site, why, left_out)
        waiting = [s for s, f in fits if f.pose is None]
        site = site_of([*site.placed, *new])


def _checked(
    site: Site, why: dict[str, str], p: Relocalization, run: Mapper
) -> tuple[Site, list[tuple[Session, Placement]]]:
    """The site of the sessions that fit all others in one way, and those that do not.

    Written to ``why`` is what holds each; what a survey holds is there already.
    """
    wrong: list[tuple[Session, Placement]] = []
    held = {n for n in site.names if n == SURVEY or why.get(n, '').startswith(SURVEYED)}
    while len(site.sessions) > 1:
        free = [s for s in site.sessions if s.name not in held]
        found = run(verify, free, [site] * len(free), [p] * len(free))
        why |= {s.name: f.why for s, f in zip(free, found, strict=True)}
        out = [(s, f) for s, f in zip(free, found, strict=True) if f.pose is None]
        if not out:
            break
        if len(out) == len(site.sessions):  # nothing but the largest is sure
            out.remove(max(out, key=lambda o: len(o[0].points)))
        wrong += out
        names = {s.name for s, _ in out}
        site = site_of([(s, T) for s, T in site.placed if s.name not in names])
    for s, _ in wrong:
        why.pop(s.name, None)
    if len(site.sessions) == 1 and not held:
        why[site.sessions[0].name] = 'no other session lies beside it'
    return site, wrong


def verify(session: Session, site: Site, p: Relocalization) -> Placement:
    """Where a session of a site lies among all others: where it is, or nowhere."""
    alone = site_of([(session, site.pose_of(session))])
    found = place_site(alone, site.without(session.name), p)
    if found.pose is None:
        return replace(found, why=f'among all other sessions: {found.why}')
    if (np.abs(found.pose) > SAME).any():
        why = f'among all other sessions it would lie elsewhere: {found.why}'
        return Placement(None, why, 0, found.pose[None])
    return found


def _by_scans(placed: Placed, sessions: Sequence[Session], params: Parameters) -> Placed:
    """More sessions, by their scans, where their reflectors do not say that it is ambiguous."""
    site, why, left_out, _ = placed
    while True:
        trial = [s for s in sessions if s.name in left_out and not len(left_out[s.name].rivals)]
        grid = grid_of(site, params) if trial else None
        if grid is None:
            return Placed(site, why, left_out)
        new = []
        for session in trial:
            found = place_by_scans(session, site, grid, params)
            if found.pose is not None:
                new.append((session, found.pose))
                why[session.name] = found.why
                del left_out[session.name]
            elif not left_out[session.name].why.endswith(found.why):
                both = f'{left_out[session.name].why}; {found.why}'
                left_out[session.name] = Placement(None, both)
        if not new:
            return Placed(site, why, left_out)
        site = site_of([*site.placed, *new])
