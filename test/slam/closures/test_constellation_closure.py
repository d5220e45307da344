# SPDX-License-Identifier: Apache-2.0
"""Loops are closed by how reflectors lie, however far the pose has drifted, and by that alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_maps import whole
from made_worlds import TinyWorld, drive, observations

from rlml_slam import se2
from rlml_slam.matching.reflectors.constellation import Constellation
from rlml_slam.params import LoopClosure, Parameters
from rlml_slam.slam.closures import constellation_closure
from rlml_slam.types import Detections, Motion, Verdict

# a yard of 45 by 30 m: posts stand where the drive begins and ends, and none on the way
POSTS = np.array(
    [[-3.0, -2.1], [1.5, 4.2], [4.8, -3.3], [8.2, 3.1], [11.0, -2.4], [-1.2, 2.7], [6.1, 1.2]]
)
LAP = [(1.0, 0.0, 30.0), (0.8, np.pi / 8, 4.0), (1.0, 0.0, 16.0), (0.8, np.pi / 8, 4.0)] * 2
SEEN = 9.0  # [m] less than the laser of the tiny worlds sees
SCALE, TURN = 1.08, 1.1  # of the odometry on the way: at the end it is off by metres
STATED = 0.1  # of its covariance: what good wheels have, on a floor where they slip


def seen_within(o, reach):
    """The observation without detections from farther off."""
    d = o.detections
    near = np.hypot(d.points[:, 0], d.points[:, 1]) < reach
    near = Detections(
        d.stamp, d.frame_id, d.points[near], d.cov[near], d.ids[near], d.diameters[near]
    )
    return replace(o, detections=near)


def misled(observed):
    """The same behind odometry that is wrong where no post is in view, and does not know it."""
    out, pose = [], observed[0].odom_pose
    for k, o in enumerate(observed):
        o = seen_within(o, SEEN)
        off = np.ones(3) if len(o.detections) else np.array([SCALE, SCALE, TURN])
        delta = se2.exp(se2.log(o.motion.delta) * off) if k else np.zeros(3)
        pose = se2.compose(pose, delta)
        motion = Motion(delta, STATED * o.motion.cov)
        out.append(replace(o, motion=motion, odom_pose=pose))
    return out


def mapped(posts, path, parameters, seed=0):
    rng = np.random.default_rng(seed)
    world = TinyWorld(np.zeros((0, 4)), posts)
    return whole(misled(observations(world, path, scan=False, rng=rng)), parameters)


PATH = drive(*LAP, (1.0, 0.0, 12.0))


@pytest.mark.parametrize('seed', range(2))
def test_loop_of_metres_of_drift_is_closed_by_reflectors_without_ids(seed):
    back_end = mapped(POSTS, PATH, Parameters(), seed)
    assert len(back_end.reflectors()) == len(POSTS)
    closed = [c for c in back_end.loop_closer.records if c.accepted]
    assert closed
    assert all('reflectors' in c.why for c in closed)
    # the end of the drive lies where it does, seen from its beginning
    end = se2.between(PATH[0], PATH[-1])
    estimate = back_end.trajectory()[1]
    off = se2.between(end, se2.between(estimate[0], estimate[-1]))
    assert np.hypot(off[0], off[1]) < 0.15
    assert abs(off[2]) < 0.03


def test_without_it_the_posts_are_mapped_twice():
    """That the loop above is out of reach of all else."""
    never = Parameters(loop_closure=LoopClosure(enabled=False))
    back_end = mapped(POSTS, PATH, never)
    assert len(back_end.reflectors()) > len(POSTS)


def test_posts_of_another_place_are_not_taken_for_known_ones():
    rng = np.random.default_rng(5)
    path = drive(*LAP[:3])
    there = se2.transform(path[-1], rng.uniform((-8.0, -4.0), (2.0, 4.0), (7, 2)))
    posts = np.vstack([POSTS, there])
    back_end = mapped(posts, path, Parameters())
    assert len(back_end.reflectors()) == 14
    assert not any(c.accepted for c in back_end.loop_closer.records)


def test_what_could_not_be_searched_is_counted_and_closes_nothing(monkeypatch):
    def never(*_, **__):
        return Constellation(Verdict.NOT_SEARCHED, 'too many')

    monkeypatch.setattr(constellation_closure, 'locate', never)
    back_end = mapped(POSTS, PATH, Parameters())
    assert back_end.constellation_search.not_searched > 0
    assert not any(c.accepted for c in back_end.loop_closer.records)


def test_racks_that_are_all_alike_are_not_one():
    """Every bay has its posts where all others have, so reflectors alone propose wrong places."""
    bay = np.array([[0.0, -2.1], [2.2, 2.4], [4.1, -2.6], [5.3, 2.0], [7.4, -2.3], [8.3, 2.6]])
    aisle = np.vstack([bay + np.array([10.0 * k, 0.0]) for k in range(4)])
    posts = np.vstack([aisle, aisle + np.array([0.0, 14.0])])
    turn = (0.8, np.pi / 8, 4.0)
    path = drive((1.0, 0.0, 38.0), turn, (1.0, 0.0, 10.0), turn, (1.0, 0.0, 38.0))
    world = TinyWorld(np.zeros((0, 4)), posts)
    observed = [
        seen_within(o, 8.0)
        for o in observations(world, path, scan=False, rng=np.random.default_rng(3))
    ]
    back_end = whole(observed, Parameters())
    proposed = [c for c in back_end.loop_closer.records if 'reflectors' in c.why]
    assert proposed
    assert not any(c.accepted for c in proposed)
    assert len(back_end.reflectors()) == len(posts)
