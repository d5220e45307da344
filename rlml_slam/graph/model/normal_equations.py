# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a graph; errors name the node and say what is missing."""

from __future__ import annotations

import numpy as np

from rlml_slam.errors import SolverError
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.packed_system import System, pack_system


def build_system(graph: Graph) -> System:
    """The normal equations of a graph, set up but not linearised.

    Raises SolverError, naming the node, if a value is not finite or if a part is not anchored to
    the map.
    """
    for name, values in (('pose', graph.poses), ('landmark', graph.landmarks)):
        if not np.isfinite(values).all():
            i = int(np.argmin(np.isfinite(values).all(-1)))
            raise SolverError(f'{name} {i}: {values[i].tolist()} is not finite')
    unanchored, system = pack_system(graph.tables(), np.empty(0))
    if unanchored >= 0:
        n = len(graph.poses)
        name = f'pose {unanchored}' if unanchored < n else f'landmark {unanchored - n}'
        raise SolverError(
            f'{name} and what is connected to it is not anchored to the map: '
            'fix a pose, or add a prior or two fixed landmarks'
        )
    return system
