# SPDX-License-Identifier: Apache-2.0
"""What a black box wrote about itself: how the node was set that is replayed from its file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.errors import BagError
from rlml_slam.params import Parameters, declarations, from_mapping
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode

INCIDENT, POSE = '/incident', '/pose'
OWN = ('mode', 'map_directory', 'map_file_name', 'continue_map')  # a replay is given its map
LEAST = 0.01  # [m], [rad] of map_start_sigma


def about(path: Path) -> dict[str, Any] | None:
    """The message ``/incident`` of a file; None of a bag that is no incident."""
    with BagReader(path) as bag:
        if INCIDENT not in bag.topics:
            return None
        for _, _, message in bag.messages([INCIDENT]):
            try:
                found = json.loads(message.data)
            except ValueError as e:
                raise BagError(f'{path}: {INCIDENT} cannot be read: {e}') from e
            if isinstance(found, dict):
                return found
    return None


def recorded_parameters(path: Path) -> Parameters | None:
    """The parameters with which an incident was recorded; None of a bag that is no incident.

    The robot starts at the first pose that was published: the file begins while it drives.
    Parameters that this version does not have are left out. Raises ParameterError, BagError.
    """
    found = about(path)
    if found is None:
        return None
    known = {d.name for d in declarations(Parameters)} - set(OWN)
    given = found.get('parameters')
    given = given if isinstance(given, dict) else {}
    params: Parameters = from_mapping({k: v for k, v in given.items() if k in known})
    with BagReader(path) as bag:
        first = next((m for _, _, m in bag.messages([POSE])), None)
    if first is None:
        return params
    estimate = decode.pose_estimate(first)
    sigma = np.maximum(np.sqrt(np.maximum(np.diag(estimate.cov), 0.0)), LEAST)
    node = replace(
        params.node, map_start_pose=tuple(estimate.pose.tolist()),
        map_start_sigma=tuple(sigma.tolist()),
    )  # fmt: skip
    return replace(params, node=node)
