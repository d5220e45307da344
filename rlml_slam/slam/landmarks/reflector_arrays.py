# SPDX-License-Identifier: Apache-2.0
"""Reflectors of the graph as arrays of a saved map."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.slam.landmarks.landmark import HISTORY, SIGHTING, VIEW, DetectionHistory, Landmark


def arrays_of(reflectors: Iterable[Landmark]) -> dict[str, NDArray[Any]]:
    """Columns of the reflectors; ``reflector_seen_together`` has pairs of keys."""
    marks = list(reflectors)
    pairs = [(m.key, other) for m in marks for other in sorted(m.seen_together)]
    views = [(m.key, *cell, *counts) for m in marks for cell, counts in m.views.items()]
    sightings = [m.sightings.view for m in marks]
    return {
        'reflector_key': np.array([m.key for m in marks], dtype=np.int64),
        'reflector_node': np.array([m.index for m in marks], dtype=np.int64),
        'reflector_id': np.array([m.id for m in marks], dtype=np.int64),
        'reflector_diameter': np.array([m.diameter for m in marks], dtype=np.float64),
        'reflector_count': np.array([m.count for m in marks], dtype=np.int64),
        'reflector_history': np.array(
            [dataclasses.astuple(m.history) for m in marks], dtype=HISTORY
        ),
        'reflector_view': np.array(views, dtype=VIEW),
        'reflector_surveyed': np.array([m.surveyed for m in marks], dtype=np.int64),
        'reflector_sightings': np.array([len(s) for s in sightings], dtype=np.int64),
        'reflector_seen_together': np.array(pairs, dtype=np.int64).reshape(-1, 2),
        'sighting': np.concatenate([np.zeros(0, dtype=SIGHTING), *sightings]),
    }


def reflectors_of(a: Mapping[str, NDArray[Any]]) -> dict[int, Landmark]:
    """Reflectors by key; a map that was imported has neither surveyed ones nor a history."""
    n = len(a['reflector_key'])
    ends = np.cumsum(a['reflector_sightings'])
    surveyed = a.get('reflector_surveyed', np.full(n, -1))
    histories = a.get('reflector_history', np.zeros(n, dtype=HISTORY))
    out: dict[int, Landmark] = {}
    for k, key in enumerate(a['reflector_key'].tolist()):
        m = out[key] = Landmark(
            key, int(a['reflector_node'][k]), int(a['reflector_id'][k]),
            float(a['reflector_diameter'][k]), int(a['reflector_count'][k]),
        )  # fmt: skip
        m.surveyed = int(surveyed[k])
        m.history = DetectionHistory(*histories[k].item())
        m.sightings.append(a['sighting'][ends[k] - a['reflector_sightings'][k] : ends[k]])
    for key, other in a['reflector_seen_together'].tolist():
        out[key].seen_together.add(other)
    for key, x, y, hits, misses in a.get('reflector_view', np.zeros(0, VIEW)).tolist():
        out[key].views[x, y] = hits, misses
    return out
