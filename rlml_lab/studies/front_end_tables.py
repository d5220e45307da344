# SPDX-License-Identifier: Apache-2.0
"""What ``rlml-lab study front-end`` tabulates, for the terminal and the page alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SENSORS: dict[str, dict[str, bool]] = {
    'odometry': {'use_scan': False, 'use_reflectors': False},
    'scan': {'use_reflectors': False},
    'scan alone': {'use_reflectors': False, 'use_odom': False, 'use_imu': False},
    'reflectors': {'use_scan': False},
    'both': {},
}
FAULTS = ('slip', 'worn', 'ghosts', 'missed', 'dropout', 'jitter')
COLUMNS: dict[str, tuple[str, float, int]] = {
    'ate_m': ('ATE [cm]', 100.0, 2),
    'max_m': ('largest [cm]', 100.0, 1),
    'along_m': ('along x, largest [cm]', 100.0, 1),
    'heading_deg': ('heading [°]', 1.0, 3),
    'nees': ('NEES (3)', 1.0, 2),
    'coverage': ('95 % coverage [%]', 100.0, 1),
    'lost': ('LOST [%]', 100.0, 2),
}
FAULT_HEADER = ['world, fault', 'ATE / clean', 'worst seed', 'largest [cm]']


def drive_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """A row of cells per world and system or fault: mean (worst)."""
    return [
        [name, *(f'{c * s[k]["mean"]:.{d}f} ({c * s[k]["max"]:.{d}f})'
                 for k, (_, c, d) in COLUMNS.items())]
        for name, s in summary['drives'].items()
    ]  # fmt: skip


def fault_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """A row of cells per world and fault."""
    return [
        [name, f'{f["ratio"]:.2f}', f'{f["worst"]:.2f}', f'{100 * f["max_m"]:.1f}']
        for name, f in summary['robustness'].items()
    ]


def kidnap_text(summary: Mapping[str, Any]) -> str:
    """What became of the carried robots, in words."""
    rows = summary['kidnaps']
    if not rows:
        return 'no robot was carried away'
    found = [r for r in rows if r['found_s'] is not None]
    out = f'{len(found)} of {len(rows)} carried robots found themselves'
    if found:
        out += (
            f'; LOST after {max(r["lost_s"] for r in found):.2f} s at most, OK after '
            f'{max(r["found_s"] for r in found):.2f} s, from then on within '
            f'{100 * max(r["max_m"] for r in found):.1f} cm'
        )
    return f'{out}; {sum(r["false_alarms"] for r in rows)} false alarms before'
