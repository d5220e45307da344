# SPDX-License-Identifier: Apache-2.0
"""What is not as planned, and what to do about it, the most important first."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from rlml_slam.planning.audit.displacement import Displacement
from rlml_slam.planning.audit.evidence import Evidence
from rlml_slam.planning.audit.ghosts import Ghost
from rlml_slam.planning.audit.presence import LEAST, Presence
from rlml_slam.se2 import Array

GONE = 0.05  # share of the usual rate below which a reflector was not seen
MOST_MOVED = 3.0  # [m] a reflector that is not seen and a ghost may be one that was moved
CLEAR, POOR = 0.8, 0.3  # shares of the usual rate: from here it is seen, from there it is not
SIDES = ('east', 'north-east', 'north', 'north-west', 'west', 'south-west', 'south', 'south-east')


class Kind(Enum):
    """What was found, the most important first."""

    MOVED = 'moved'
    HIDDEN = 'hidden'
    TURNED = 'turned'
    DIRTY = 'dirty'
    MIRROR = 'mirror'
    GHOST = 'ghost'
    LOST = 'lost'
    DEGRADED = 'degraded'
    RESIDUALS = 'residuals'


@dataclass(frozen=True)
class Finding:
    """``subject``: row of the reflector, -1 for none. ``share`` of the scans that it concerns.

    ``shift`` (2,) [m] of one that was moved, ``wall`` (2, 2) of a mirror image, else NaN.
    """

    kind: Kind
    subject: int
    x: float
    y: float
    what: str
    advice: str
    share: float
    shift: Array = field(default_factory=lambda: np.full(2, np.nan))
    wall: Array = field(default_factory=lambda: np.full((2, 2), np.nan))


def name_of(e: Evidence, k: int) -> str:
    """A reflector with its id and place."""
    x, y = e.site.reflectors.points[k]
    return f'reflector {e.site.reflectors.ids[k]} at ({x:.2f}, {y:.2f})'


def ranked(found: list[Finding]) -> list[Finding]:
    """By kind, then by how many scans it concerns."""
    order = list(Kind)
    return sorted(found, key=lambda f: (order.index(f.kind), -f.share))


def of_reflectors(
    e: Evidence, there: Presence, shift: Displacement, others: list[Ghost]
) -> list[Finding]:
    """Findings about each reflector and each ghost."""
    found: list[Finding] = []
    used: set[int] = set()
    num = len(e.sightings.stamps)
    for k in range(len(e.site.reflectors)):
        share = float(there.expected[k]) / num
        if not np.isnan(shift.delta[k, 0]):
            found.append(_displaced(e, k, shift.delta[k], float(shift.sigma[k]), share))
        elif there.is_low[k]:
            missing = there.seen[k] < GONE * there.usual * there.expected[k]
            near = _nearest(e.site.reflectors.points[k], others, used) if missing else -1
            if near >= 0:
                used.add(near)
                d = others[near].place - e.site.reflectors.points[k]
                found.append(_displaced(e, k, d, 0.0, share))
            else:
                found.append(_missed(e, there, k, missing, share))
    found += [_ghost(e, g, num) for k, g in enumerate(others) if k not in used]
    return found


def _nearest(place: Array, others: list[Ghost], used: set[int]) -> int:
    gaps = [math.inf if k in used or g.mirrored >= 0 else float(np.hypot(*(g.place - place)))
            for k, g in enumerate(others)]  # fmt: skip
    best = int(np.argmin(gaps)) if gaps else -1
    return best if best >= 0 and gaps[best] < MOST_MOVED else -1


def _displaced(e: Evidence, k: int, d: Array, sigma: float, share: float) -> Finding:
    x, y = e.site.reflectors.points[k]
    by = f'{100.0 * np.hypot(*d):.1f} cm'
    spread = f' ± {100.0 * sigma:.1f} cm' if sigma else ''
    what = f'{name_of(e, k)} stands {by}{spread} from there, at ({x + d[0]:.3f}, {y + d[1]:.3f})'
    advice = 'mount it where the layout has it, or correct the layout and the map'
    return Finding(Kind.MOVED, k, x, y, what, advice, share, shift=d)


def _missed(e: Evidence, there: Presence, k: int, missing: bool, share: float) -> Finding:
    x, y = e.site.reflectors.points[k]
    n, s = there.expected[k], there.seen[k]
    what = f'{name_of(e, k)} was seen {s:.0f} of {n:.0f} times, others {there.usual:.0%}'
    if missing:
        advice = 'see whether it was removed or something stands before it'
        return Finding(Kind.HIDDEN, k, x, y, what, advice, share)
    good, bad = _sides(e, there.usual, k)
    if good and bad:
        what += f'; it is seen from {", ".join(good)}, not from {", ".join(bad)}'
        advice = 'see what stands there in the way; turn it if it is flat'
        return Finding(Kind.TURNED, k, x, y, what, advice, share)
    advice = 'clean or replace it'
    return Finding(Kind.DIRTY, k, x, y, what, advice, share)


def _sides(e: Evidence, usual: float, k: int) -> tuple[list[str], list[str]]:
    """Sides of a reflector from which it is seen as usual, and those from which it is not."""
    due = np.flatnonzero(e.expected[:, k])
    d = e.sightings.lasers[due] - e.site.reflectors.points[k]
    side = np.rint(np.arctan2(d[:, 1], d[:, 0]) / (0.25 * np.pi)).astype(int) % len(SIDES)
    good: list[str] = []
    bad: list[str] = []
    for j, name in enumerate(SIDES):
        mine = due[side == j]
        if len(mine) < LEAST:
            continue
        rate = np.mean(e.seen[mine, k] >= 0) / usual
        (good if rate > CLEAR else bad if rate < POOR else []).append(name)
    return good, bad


def _ghost(e: Evidence, g: Ghost, num: int) -> Finding:
    x, y = g.place.tolist()
    share = len(g.scans) / num
    what = f'{g.count} detections at ({x:.2f}, {y:.2f}), where the layout has no reflector'
    if g.mirrored < 0:
        advice = 'see what shines there, or add it to the layout if it is a reflector'
        return Finding(Kind.GHOST, -1, x, y, what, advice, share)
    (ax, ay), (bx, by) = g.wall.tolist()
    what += (
        f': mirror image of {name_of(e, g.mirrored)} in the wall from ({ax:.1f}, {ay:.1f}) to '
        f'({bx:.1f}, {by:.1f})'
    )
    advice = 'make that wall dull, or move the reflector out of its sight'
    return Finding(Kind.MIRROR, g.mirrored, x, y, what, advice, share, wall=g.wall)
