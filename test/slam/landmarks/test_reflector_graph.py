# SPDX-License-Identifier: Apache-2.0
"""Reflectors of a large plant."""

import tracemalloc

import numpy as np

from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.graph import Graph
from rlml_slam.params import Reflector
from rlml_slam.slam.keyframes import Interval, Sighting
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph


def test_pairs_of_thousands_are_merged_without_a_table_of_all():
    """Two that are one stand among five thousand; a table of all has 25 million rows."""
    x, y = np.meshgrid(np.arange(71) * 4.0, np.arange(71) * 4.0)
    posts = np.vstack([np.stack([x.ravel(), y.ravel()], -1), [[8.01, 12.0]]])
    solver = OnlineSolver(Graph())
    solver.graph.add_pose(np.zeros(3), fixed=True)
    reflectors = ReflectorGraph(Reflector(min_sightings=1), solver)
    for keys in np.array_split(np.arange(len(posts)), 72):  # each row was seen by itself
        interval = Interval(np.zeros(3))
        interval.first_stamp = interval.last_stamp = 1
        for key in keys.tolist():
            sighting = Sighting()
            sighting.add(posts[key], 1e-4 * np.eye(2))
            interval.sightings[key] = [sighting]
        reflectors.add(0, interval)
    solver.solve()
    tracemalloc.start()
    merged = reflectors.merge()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert merged
    assert len(reflectors.alive()) == len(posts) - 1
    assert reflectors.resolve(len(posts) - 1) == 3 * 71 + 2
    assert peak < 50e6
