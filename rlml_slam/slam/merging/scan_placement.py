# SPDX-License-Identifier: Apache-2.0
"""Where a session lies in a site, by its scans: several of them must find it, and none elsewhere.

For sessions that have too few reflectors in common with the others. The grid of the site is drawn
from the scans of the sessions that are placed; it is not complete, so a scan that may fit where
nothing is mapped yet does not vote.
"""

from __future__ import annotations

import numpy as np

from rlml_slam import se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.keyframe_selection import draw
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.slam.merging.placement import Placement, unseen_at
from rlml_slam.slam.merging.site_map import Session, Site, match_of, site_of
from rlml_slam.slam.relocalization.scan_relocalization import SPREAD, relocalize
from rlml_slam.slam.store import map_file
from rlml_slam.types import Verdict

SCANS = 8  # searched of a session, evenly over its drive
VOTES = 4  # that have to agree


def grid_of(site: Site, p: Parameters) -> OccupancyGrid | None:
    """What the scans of all sessions of a site show together, None without any."""
    keys: list[Keyframe] = []
    poses = [np.zeros((0, 3))]
    for session, T in site.placed:
        if session.path is None:
            continue
        content = map_file.load(session.path)
        for key in map_file.keyframes_of(content):
            key.index += sum(map(len, poses))
            keys.append(key)
        poses.append(se2.compose(T, content.arrays['pose']))
    return draw(np.concatenate(poses), keys, p.back_end.resolution)


def place_by_scans(session: Session, site: Site, grid: OccupancyGrid, p: Parameters) -> Placement:
    """Search scans of a session in the grid of a site; its reflectors may not contradict."""
    if session.path is None:
        return Placement(None, 'no scans')
    content = map_file.load(session.path)
    keys = [k for k in map_file.keyframes_of(content) if k.points is not None and len(k.points)]
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(SCANS, len(keys))).round().astype(int))
    votes = []
    for key in (keys[k] for k in chosen):
        found = relocalize(grid, np.asarray(key.points, dtype=np.float64), p, complete=False)
        if found.verdict is Verdict.UNIQUE and found.pose is not None:
            votes.append((content.arrays['pose'][key.index], found.pose))
    if len(votes) < VOTES:
        return Placement(None, f'{len(votes)} of {len(chosen)} scans fit, {VOTES} are needed')
    own, there = (np.array(v) for v in zip(*votes, strict=True))
    T = se2.compose(there, se2.inverse(own))  # (n, 3), each by one scan
    off = se2.between(se2.compose(T[:, None], own), there)  # (n, n, 3) at each other's scans
    agree = np.asarray((np.abs(off) < SPREAD).all(axis=-1))
    best = int(agree.sum(axis=1).argmax())
    if not agree[best].all():
        return Placement(None, f'{len(votes)} scans fit, at places that contradict each other')
    alone = site_of([(session, T[best])])
    unseen, expected = unseen_at(T[best], session, site, match_of(alone, site))
    if 2 * unseen > expected:
        why = f'{len(votes)} scans fit where {unseen} of {expected} reflectors do not'
        return Placement(None, why)
    return Placement(T[best], f'{len(votes)} of {len(chosen)} scans fit at one pose', len(votes))
