# SPDX-License-Identifier: Apache-2.0
"""What the front end makes of a time in which nothing was seen."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import OTHER_ROOM, ROOM, SECOND, TinyWorld, drive, observations

from rlml_slam import se2
from rlml_slam.motion import motion_of
from rlml_slam.params import Parameters
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.relocalization.local_recovery import may_have_left
from rlml_slam.types import Level, Motion


@pytest.mark.parametrize('wheels_turned', [True, False])
def test_robot_that_drove_on_unseen_maps_at_once_where_it_is(wheels_turned):
    """Wheels that turned say that it left; those that stood, that it was carried."""
    there = OTHER_ROOM.walls + np.tile([30.0, 4.0], 2)
    world = TinyWorld(np.vstack([ROOM.walls, there]), np.zeros((0, 2)))
    before, after = drive((0.3, 0.2, 3.0)), drive((0.2, 0.3, 2.0), start=(30.0, 4.0, 0.8))
    seen = observations(world, np.vstack([before, after]), reflectors=False)
    front_end, frames, noise = FrontEnd(Parameters()), [], Parameters().motion
    for k, o in enumerate(seen):
        if k >= len(before):
            o = replace(o, stamp=o.stamp + 20 * SECOND)
            if not wheels_turned:  # its wheels have not seen the way
                way = se2.between(seen[len(before)].odom_pose, o.odom_pose)
                o = replace(o, odom_pose=se2.compose(seen[len(before) - 1].odom_pose, way))
        if k == len(before):
            stood = Motion(np.zeros(3), 1e-4 * np.eye(3))
            o = replace(
                o, motion=motion_of(o.motion.delta, 20.0, noise) if wheels_turned else stood
            )
        frames.append(front_end.process(o))
    levels = [f.health.level for f in frames[len(before) :]]
    assert (Level.LOST in levels) is not wheels_turned
    assert [f.scan_used for f in frames[len(before) + 1 :]] == 20 * [wheels_turned]
    if wheels_turned:
        assert frames[-1].T_map_base == pytest.approx(after[-1], abs=0.05)
        assert (np.sqrt(np.diag(frames[-1].cov_map))[:2] > 0.3).all()


@pytest.mark.parametrize(('lasted', 'left'), [(1.0, False), (20.0, True)])
def test_only_a_gap_takes_a_robot_elsewhere(lasted, left):
    """A slow laser on a fast robot shows too little as well, but each second."""
    wide = Motion(np.array([3.0, 0.0, 0.0]), np.diag([0.2, 0.2, 0.01]))
    assert may_have_left(wide, lasted, Parameters()) is left
    assert not may_have_left(replace(wide, known=False), lasted, Parameters())
    assert not may_have_left(replace(wide, cov=1e-4 * np.eye(3)), lasted, Parameters())


def test_filter_finds_no_heading_in_what_comes_after_a_gap():
    """The heading that the gap lost is known to nobody until the graph closes a loop."""
    rng = np.random.default_rng(3)
    before, after = drive((0.5, 0.0, 3.0)), drive((0.5, 0.25, 8.0), start=(1.0, 1.0, 2.0))
    first = observations(ROOM, before, reflectors=False, rng=rng)
    then = observations(OTHER_ROOM, after, reflectors=False, rng=rng)
    late = first[-1].stamp + 30 * SECOND
    lost = np.diag([1.0, 1.0, 0.6]) ** 2
    then = [replace(o, stamp=o.stamp - then[0].stamp + late, odom_pose=None) for o in then]
    then[0] = replace(then[0], motion=Motion(np.array([8.0, 2.0, 1.0]), lost))
    front_end = FrontEnd(Parameters())
    for o in first:
        front_end.process(o)
    frames = [front_end.process(o) for o in then]
    sigma = np.sqrt([f.cov_local[2, 2] for f in frames])
    assert sigma.min() > 0.6
    # where it is linearized, the heading since the gap is known
    assert front_end.state.pose_cov[2, 2] < 0.02**2
    grown = sigma[-1] ** 2 - sigma[1] ** 2
    assert grown == pytest.approx(front_end.state.pose_cov[2, 2], abs=1e-4)
