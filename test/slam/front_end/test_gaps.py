# SPDX-License-Identifier: Apache-2.0
"""What the front end makes of a time in which nothing was seen."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import OTHER_ROOM, ROOM, SECOND, TinyWorld, drive, observations

from rlml_slam.maps.occupancy import render
from rlml_slam.motion import motion_of
from rlml_slam.params import Node, Parameters
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import Level, Motion, Reflectors

NO_REFLECTORS = Reflectors(
    np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2, 2)),
    np.zeros(0, int), np.zeros(0, int), np.zeros(0),
)  # fmt: skip


def test_robot_that_drove_on_unseen_maps_at_once_where_it_is():
    """Wheels that turned say that it left; those that stood, that it was carried."""
    there = OTHER_ROOM.walls + np.tile([30.0, 4.0], 2)
    world = TinyWorld(np.vstack([ROOM.walls, there]), np.zeros((0, 2)))
    before = drive((0.3, 0.2, 3.0))
    after = drive((0.2, 0.3, 2.0), start=(30.0, 4.0, 0.8))
    seen = observations(world, np.vstack([before, after]), reflectors=False)
    for wheels_turned in (True, False):
        front_end = FrontEnd(Parameters())
        frames = []
        for k, o in enumerate(seen):
            if k >= len(before):
                o = replace(o, stamp=o.stamp + 20 * SECOND)
            if k == len(before) and wheels_turned:
                o = replace(o, motion=motion_of(o.motion.delta, 20.0, Parameters().motion))
            elif k == len(before):
                o = replace(o, motion=Motion(np.zeros(3), 1e-4 * np.eye(3), gap=20.0))
            frames.append(front_end.process(o))
        levels = [f.health.level for f in frames[len(before) :]]
        assert (Level.LOST in levels) is not wheels_turned
        assert [f.scan_used for f in frames[len(before) + 1 :]] == 20 * [wheels_turned]
        if wheels_turned:
            assert frames[-1].T_map_base == pytest.approx(after[-1], abs=0.05)
            sigma = np.sqrt(np.diag(frames[-1].cov_map))
            assert (sigma[:2] > 0.3).all()


def test_robot_in_a_saved_map_that_does_not_fit_after_a_gap_is_lost():
    """Wheels turned, and it is in another room of the map: it has to be searched."""
    there = OTHER_ROOM.walls + np.tile([30.0, 4.0], 2)
    world = TinyWorld(np.vstack([ROOM.walls, there]), np.zeros((0, 2)))
    before = drive((0.3, 0.2, 3.0))
    after = drive((0.2, 0.3, 2.0), start=(30.0, 4.0, 0.8))
    path = np.vstack([before, after])
    seen = observations(world, path, reflectors=False)
    front_end = FrontEnd(Parameters(node=Node(mode='localization')))
    grid = render(path, [o.points for o in seen], [np.zeros(2)] * len(path))
    front_end.use_map(NO_REFLECTORS, grid)
    levels = []
    for k, o in enumerate(seen):
        if k >= len(before):
            o = replace(o, stamp=o.stamp + 20 * SECOND)
        if k == len(before):
            o = replace(o, motion=motion_of(np.array([1.2, 0.0, 0.1]), 20.0, Parameters().motion))
        levels.append(front_end.process(o).health.level)
    assert Level.LOST not in levels[: len(before)]
    assert Level.LOST in levels[len(before) :]
