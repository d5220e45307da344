# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, TinyWorld, drive, observations

from rlml_slam import se2
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.types import ANONYMOUS, Motion, Status

LOOP = drive((0.5, 0.0, 4.0), (0.5, 1.2, 5.2), (0.5, 0.0, 6.0), (0.5, 1.2, 5.2), (0.5, 0.0, 3.0))
BLIND = slice(60, 110)
SURPRISE = np.array([0.25, -0.1, 0.4])  # of the wheels while nothing is in view


def blinded(rng, surprise=SURPRISE, sigmas=(0.25, 0.15, 0.35)):
    """The loop with a stretch without a sighting, in which the wheels slip."""
    out = observations(ROOM, LOOP, scan=False, rng=rng, sigma=0.02)
    for k in range(BLIND.start, BLIND.stop):
        out[k] = replace(out[k], detections=None)
    k = BLIND.stop - 1
    delta = se2.compose(out[k].motion.delta, surprise)
    cov = out[k].motion.cov + np.diag(np.square(sigmas))
    out[k] = replace(out[k], motion=Motion(delta, cov))
    return out


def run(observed):
    """Frames of the front end and the back end, which does not correct it."""
    front_end, back_end = FrontEnd(Parameters()), BackEnd(Parameters())
    frames = []
    for o in observed:
        frames.append(front_end.process(o))
        back_end.add(frames[-1])
    back_end.finish()
    return frames, back_end


@pytest.mark.parametrize('seed', range(4))
def test_reflectors_seen_again_after_a_blind_stretch_are_told_in_the_end(seed):
    frames, back_end = run(blinded(np.random.default_rng(seed)))
    again = frames[BLIND.stop]
    assert (again.statuses == Status.DEFERRED).any()
    assert not (again.statuses == Status.USED).any()
    assert not back_end.delayed_association.pending
    mapped = back_end.reflectors().points
    assert len(mapped) == len(ROOM.reflectors)
    gap = np.linalg.norm(mapped[:, None] - ROOM.reflectors[None], axis=-1)
    assert gap.min(axis=1).max() < 0.05
    _, poses = back_end.trajectory()
    assert np.abs(poses[-1] - LOOP[-1])[:2].max() < 0.05


def test_front_end_alone_would_have_carried_the_slip_on():
    frames, _ = run(blinded(np.random.default_rng(0)))
    error = np.linalg.norm(frames[-1].T_local_base[:2] - LOOP[-1][:2])
    assert error > 0.2
    # and says so
    assert np.sqrt(np.trace(frames[-1].cov_local[:2, :2])) > 0.1


def test_nothing_is_open_where_the_pose_stays_known():
    observed = observations(ROOM, LOOP, scan=False, rng=np.random.default_rng(1))
    frames, back_end = run(observed)
    assert not any((f.statuses == Status.DEFERRED).any() for f in frames)
    assert len(back_end.reflectors()) == len(ROOM.reflectors)


def test_with_ids_nothing_is_ever_asked():
    observed = observations(ROOM, LOOP, scan=False, rng=np.random.default_rng(2), ids=True)
    frames, back_end = run(observed)
    assert not any((f.statuses == Status.DEFERRED).any() for f in frames)
    assert back_end.delayed_association.pending == frozenset()


def test_reflectors_with_ids_among_anonymous_ones_keep_their_names():
    rng = np.random.default_rng(5)
    named = observations(ROOM, LOOP, scan=False, ids=True)
    observed = []
    for o, n in zip(blinded(rng), named, strict=True):
        if o.detections is not None:
            ids = np.where(n.detections.ids < 103, n.detections.ids, ANONYMOUS)
            o = replace(o, detections=replace(o.detections, ids=ids))
        observed.append(o)
    _, back_end = run(observed)
    mapped = back_end.reflectors()
    assert sorted(mapped.ids) == [ANONYMOUS] * 3 + [100, 101, 102]
    gap = np.linalg.norm(mapped.points[:, None] - ROOM.reflectors[None], axis=-1)
    assert gap.min(axis=1).max() < 0.05


def test_different_ids_are_never_joined():
    observed = observations(ROOM, LOOP[:60], scan=False, ids=True)
    _, back_end = run(observed)
    before = back_end.reflectors()
    back_end.reflector_graph.join(int(before.keys[0]), int(before.keys[1]))
    np.testing.assert_array_equal(back_end.reflectors().ids, before.ids)


# --- groups that cannot be resolved ------------------------------------------------------------


def test_group_is_one_reflector_whose_detections_say_less():
    pair = TinyWorld(np.zeros((0, 4)), np.array([[4.0, 0.05], [4.0, -0.05], [-3.0, 1.0]]))
    poses = drive((0.3, 0.0, 3.0))
    observed = observations(pair, poses, scan=False, rng=np.random.default_rng(3), sigma=0.03)
    front_end = FrontEnd(Parameters())
    frames = [front_end.process(o) for o in observed]
    assert len(front_end.tracks) == 2
    group, single = front_end.tracks.spread2
    # half the distance of 0.1 m, with the noise of two detections
    assert group == pytest.approx(0.05**2 + 0.03**2, rel=0.3)
    assert single == 0.0
    used_detections, given = frames[-1].observation.detections, observed[-1].detections
    widened = np.trace(used_detections.cov - given.cov, axis1=1, axis2=2)
    used = frames[-1].landmarks == front_end.tracks.keys[0]
    assert (widened[used] > 0.004).all()
    assert (widened[~used] == 0.0).all()
