# SPDX-License-Identifier: Apache-2.0
"""What /diagnostics show of a running back end."""

from __future__ import annotations

from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.diagnostics import map_id
from rlml_slam.slam.closures.closure_table import state_counts


def figures(mapper: Mapper) -> dict[str, object]:
    """Figures by name."""
    back_end, system = mapper.back_end, mapper.system
    entry = system.entry
    survey_frame = back_end.survey_frame
    return {
        'keyframes': len(back_end.graph.poses),
        'edges': len(back_end.graph.edges),
        'closures accepted': back_end.loop_closer.tried[True],
        'closures rejected': back_end.loop_closer.tried[False],
        **state_counts(back_end.loop_closer.records),
        'map id': map_id(system.map if entry is None else entry.saved),
        **({} if entry is None else {'saved map not entered': entry.why}),
        **({} if survey_frame is None else {'survey': survey_frame.why}),
        'constellations not searched': back_end.constellation_search.not_searched,
        'frames waiting for the worker': mapper.worker.backlog,
    }
