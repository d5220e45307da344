# SPDX-License-Identifier: Apache-2.0
"""The answer to a user who asked where the robot is in the map."""

from __future__ import annotations

import math

from rlml_slam import se2
from rlml_slam.se2 import Array
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.types import Verdict

SAME_PLACE, SAME_TURN = 0.3, 0.1  # [m], [rad] of a scan from where it is believed
ADVICE = (
    'drive to a place of the map that looks like no other and call again, or set the pose on '
    'initialpose'
)


def relocalize_answer(
    found: Relocation, believed: Array | None, may_jump: bool
) -> tuple[bool, str]:
    """Success, and what was found; ``believed`` (3,) is the robot's pose until now, map frame.

    Only a robot that ``may_jump`` goes on from another pose: a map in the making cannot.
    """
    if believed is None or found.verdict is Verdict.IMPOSSIBLE or found.pose is None:
        return False, f'not found: {found.why}; {ADVICE}'
    if found.verdict is not Verdict.UNIQUE or found.cov is None:
        return False, f'not sure: {found.why}; {ADVICE}'
    x, y, theta = found.pose
    place = f'found at x = {x:.2f} m, y = {y:.2f} m, {math.degrees(theta):.1f}°: {found.why}'
    away = se2.between(believed, found.pose)
    distance = math.hypot(away[0], away[1])
    if may_jump:
        return True, f'{place}; {distance:.2f} m from where it was believed'
    if distance < SAME_PLACE and abs(away[2]) < SAME_TURN:
        return True, f'{place}; this is where it is believed to be'
    return False, (
        f'{place}, {distance:.2f} m from where it is believed; a map in the making cannot '
        f'jump: call set_localization_mode first, or reset'
    )
