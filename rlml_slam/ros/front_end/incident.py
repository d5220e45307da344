# SPDX-License-Identifier: Apache-2.0
"""What a black box keeps, and where it goes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from rlml_slam.se2 import Array
from rlml_slam.types import Health

PREFIX = 'incident-'


@dataclass(frozen=True, slots=True)
class Received:
    """A serialized message that came at a ``time`` [ns] of the wall clock."""

    time: int
    topic: str
    kind: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Published:
    """What was published of a frame at a ``time`` [ns]: its stamp, pose, covariance, health."""

    time: int
    stamp: int
    T_map_base: Array
    cov_map: Array
    health: Health


def free_name(folder: Path, why: str) -> Path:
    """A path that does not exist yet, by date and reason."""
    name = f'{PREFIX}{time.strftime("%Y%m%d-%H%M%S")}-{why}'
    path, k = folder / f'{name}.mcap', 1
    while path.exists():
        path, k = folder / f'{name}-{k}.mcap', k + 1
    return path
