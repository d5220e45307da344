# SPDX-License-Identifier: Apache-2.0
"""Measured against planned accuracy, and health, area by area of the plan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.params import Reflector
from rlml_slam.planning.audit.displacement import Displacement
from rlml_slam.planning.audit.evidence import Evidence
from rlml_slam.planning.audit.findings import Finding, Kind
from rlml_slam.planning.audit.sightings import Sightings
from rlml_slam.planning.bound import bound
from rlml_slam.types import Level

FEW = 10  # scans below which nothing is said about an area
ENOUGH = 3  # reflectors in view, with which more of them are not what an area lacks
BAD_SHARE = 0.1  # of the scans of an area that are not OK
BAD_RATIO = 1.5  # of the residuals to their sigma


def measured(
    e: Evidence, shift: Displacement, plan: Mapping[str, Any], p: Reflector
) -> list[dict[str, Any]]:
    """A row for each area of the plan with scans in it; sigmas [m] are medians, None if open.

    ``planned`` is the bound of one scan by the reflectors that the plan has in view, ``measured``
    by those that were seen, times ``residual_ratio``, the root of chi2 per degree of freedom.
    ``published`` is the front end's.
    """
    site, lasers = e.site, e.sightings.lasers
    bounds = [bound(lasers, seen, site.reflectors.points, site.cov, p).position
              for seen in (e.planned, e.seen >= 0)]  # fmt: skip
    published = np.sqrt(np.linalg.eigvalsh(e.sightings.covs[:, :2, :2])[:, -1])
    hits = e.expected & (e.seen >= 0)
    rows = []
    for area in plan['areas']:
        mine = _inside(e, area, plan['area_size_m'])
        if not mine.any():
            continue
        dof = float(shift.dof[mine].sum())
        ratio = math.sqrt(shift.chi2[mine].sum() / dof) if dof else None
        sigma = _median(bounds[1][mine])
        level = e.sightings.levels[mine]
        rows.append({
            'area': area['area'], 'x_m': area['x_m'], 'y_m': area['y_m'],
            'scans': int(mine.sum()), 'expected': int(e.expected[mine].sum()),
            'seen': int(hits[mine].sum()), 'planned_sigma_m': _median(bounds[0][mine]),
            'measured_sigma_m': None if ratio is None or sigma is None else sigma * ratio,
            'published_sigma_m': _median(published[mine]), 'residual_ratio': ratio,
            'dof': dof, 'ok_share': float(np.mean(level == Level.OK)),
        })  # fmt: skip
    return rows


def _inside(e: Evidence, area: Mapping[str, Any], size: float) -> NDArray[np.bool_]:
    low = np.array([area['x_m'], area['y_m']])
    at = e.sightings.poses[:, :2]
    inside: NDArray[np.bool_] = np.all((at >= low) & (at < low + size), axis=1)
    return inside


def of_areas(
    e: Evidence, rows: Sequence[Mapping[str, Any]], plan: Mapping[str, Any]
) -> list[Finding]:
    """Areas in which the robot was DEGRADED, or the residuals are larger than planned."""
    found = []
    for row in rows:
        mine = _inside(e, row, plan['area_size_m'])
        share, name = float(mine.mean()), f'area {row["area"]}'
        x, y = e.sightings.poses[mine, :2].mean(axis=0).tolist()
        bad: NDArray[np.bool_] = mine & np.asarray(e.sightings.levels != Level.OK)
        if bad.sum() >= FEW and row['ok_share'] <= 1.0 - BAD_SHARE:
            reason = e.sightings.texts[np.bincount(e.sightings.reasons[bad]).argmax()]
            in_view = np.median(e.planned[bad].sum(axis=1))
            u, v = np.median(e.sightings.poses[bad, :2], axis=0).tolist()
            what = (
                f'{name}: DEGRADED in {1.0 - row["ok_share"]:.0%} of {row["scans"]} scans, mostly '
                f'near ({u:.1f}, {v:.1f}): {reason}'
            )
            advice = f'{in_view:.0f} reflectors are planned in view there'
            advice += (
                ', which are enough: see to the reason'
                if in_view >= ENOUGH
                else '; see rlml plan --suggest'
            )
            found.append(Finding(Kind.DEGRADED, -1, u, v, what, advice, share))
        ratio = row['residual_ratio']
        if ratio is not None and row['scans'] >= FEW and ratio > BAD_RATIO:
            what = f'{name}: residuals are {ratio:.1f} times their sigma'
            advice = 'see sigma_range and sigma_bearing, the mounting of the laser, and the floor'
            found.append(Finding(Kind.RESIDUALS, -1, x, y, what, advice, share))
    return found


def of_lost(s: Sightings) -> list[Finding]:
    """Where the robot was LOST after it knew its place: beside the last place that it knew."""
    known = np.flatnonzero(s.levels < Level.LOST)
    lost = np.flatnonzero(s.levels == Level.LOST)
    lost = lost[lost > known[0]] if len(known) else lost[:0]
    if not len(lost):
        return []
    last = known[np.searchsorted(known, lost) - 1]
    spells, count = np.unique(last, return_counts=True)
    longest = spells[count.argmax()]
    x, y = s.poses[longest, :2].tolist()
    reason = s.texts[np.bincount(s.reasons[lost[last == longest]]).argmax()]
    what = (
        f'LOST in {len(lost)} of {len(s.levels)} scans, {len(spells)} times, longest after '
        f'({x:.1f}, {y:.1f}): {reason}'
    )
    advice = 'see there whether the place is unique in the plan, and what is above'
    return [Finding(Kind.LOST, -1, x, y, what, advice, len(lost) / len(s.levels))]


def _median(values: Any) -> float | None:
    middle = float(np.percentile(values, 50, method='lower'))
    return middle if math.isfinite(middle) else None
