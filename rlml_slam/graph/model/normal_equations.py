# SPDX-License-Identifier: Apache-2.0
"""From a graph to its normal equations, with the refusals that a person can understand."""

from __future__ import annotations

import numpy as np

from rlml_slam.errors import SolverError
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.packed_system import System, set_up


def system_of(graph: Graph) -> System:
    """The normal equations of a graph, set up but not linearised.

    Raises SolverError, naming the node, if a value is not finite or if a part is not tied to the
    map.
    """
    for name, values in (('pose', graph.poses), ('landmark', graph.landmarks)):
        if not np.isfinite(values).all():
            i = int(np.argmin(np.isfinite(values).all(-1)))
            raise SolverError(f'{name} {i}: {values[i].tolist()} is not finite')
    loose, system = set_up(graph.tables(), np.empty(0))
    if loose >= 0:
        n = len(graph.poses)
        name = f'pose {loose}' if loose < n else f'landmark {loose - n}'
        raise SolverError(
            f'{name} and what is connected to it is not tied to the map: '
            'fix a pose, or add a prior or two fixed landmarks'
        )
    return system
