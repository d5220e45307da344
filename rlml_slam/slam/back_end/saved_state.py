# SPDX-License-Identifier: Apache-2.0
"""State of a back end in the arrays of a saved map, and how to continue from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.maps.survey import Survey
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.keyframes import Interval, Keyframe

Arrays = Mapping[str, NDArray[Any]]


def arrays_of(back_end: BackEnd) -> dict[str, NDArray[Any]]:
    """Submaps, closures, reflectors and trajectory, to be saved."""
    return {
        **back_end.scan_graph.arrays(), **back_end.loop_closer.arrays(),
        **back_end.reflector_graph.arrays(), **back_end.frame_trajectory.arrays(),
    }  # fmt: skip


def restore(
    back_end: BackEnd, keys: list[Keyframe], arrays: Arrays, survey: Survey | None = None
) -> None:
    """Continue a map whose graph is restored already; its frame becomes the local frame.

    The next frame has to be one that ``jumped``: no motion leads to it. ``survey`` is the one
    whose frame the map has. Raises MapError if another survey was given to the back end.
    """
    if survey is not None:
        back_end.use_survey_of_map(survey)
    last = keys[-1]
    T_map = back_end.graph.poses[last.index].copy()
    last.cov_local = se2.rotate_cov(last.cov_local, float(T_map[2] - last.T_local[2]))
    last.T_local = T_map
    for key in keys:
        if key.jumped:
            back_end.path_covariance.start(key)
    back_end.keyframes = keys
    back_end.scan_graph.restore(arrays, keys)
    back_end.loop_closer.restore(arrays)
    back_end.reflector_graph.restore(arrays)
    back_end.frame_trajectory.restore(arrays)
    back_end.interval = Interval(last.T_local)
