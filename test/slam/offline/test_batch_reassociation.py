# SPDX-License-Identifier: Apache-2.0
"""Looking back on a run on reflectors and odometry alone."""

import functools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from made_worlds import ROOM, TinyWorld, detections_of, drive, errors, observations

from rlml_slam import se2
from rlml_slam.params import MotionNoise, Parameters
from rlml_slam.slam.offline import batch_reassociation
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file

ROUND = drive(*[(0.5, 0.4, 15.7)] * 3)  # three times round a circle of 1.25 m
TWICE = ROUND[: len(ROUND) * 2 // 3]
SINGLE = np.array([[4.0, 0.0], [0.0, 4.5], [-3.5, 1.0], [1.0, -2.5]])
BESIDE = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])


def world(*groups):
    return TinyWorld(np.zeros((0, 4)), np.concatenate(groups))


def only(o, kept):
    """An observation with some of its detections."""
    d = o.detections
    d = replace(
        d, points=d.points[kept], cov=d.cov[kept], ids=d.ids[kept], diameters=d.diameters[kept]
    )
    return replace(o, detections=d)


def run(place, seed=None, seen=1.0, way=TWICE, **kwargs):
    """The system before it looks back; of the reflectors in view, a share is ``seen``."""
    rng = None if seed is None else np.random.default_rng(seed)
    made = observations(place, way, rng=rng, **kwargs)
    if seen < 1.0:
        for k, o in enumerate(made):
            made[k] = only(o, rng.random(len(o.detections)) < seen)
    slam = Slam(Parameters())
    slam.process(made)
    slam.back_end.finish()
    return slam


def rmse(slam):
    """Of the position [m]."""
    poses = slam.back_end.trajectory()[1]
    assert len(poses) in (len(TWICE), len(ROUND))
    return float(np.sqrt(((poses[:, :2] - ROUND[: len(poses), :2]) ** 2).sum(axis=1).mean()))


def test_noiseless_run_stays_exact():
    slam = run(ROOM, scan=False)
    slam.finish()
    assert np.abs(errors(slam.trajectory()[1], TWICE)).max() < 1e-4
    assert len(slam.reflectors()) == len(ROOM.reflectors)


class LookedBack(NamedTuple):
    """A run among groups that has looked back, and what it was before."""

    slam: Slam
    reflectors: int  # before
    rmse: float  # before
    least: list[float]  # variances of what the path is smoothed by, from turn to turn


@functools.cache
def among_groups(seed, apart, sigma):
    slam = run(world(SINGLE, SINGLE + apart * BESIDE), seed, scan=False, sigma=sigma)
    before = LookedBack(slam, len(slam.reflectors()), rmse(slam), [])
    smooth = batch_reassociation.smooth

    def spy(start, steps, *args):
        sigmas = np.sqrt(np.diag(start.P)[4:])
        np.testing.assert_allclose(sigmas, MotionNoise().first_scale_errors)
        sights = [q for s in steps for q in s.sights]
        before.least.append(min(q.R[0, 0] for q in sights))
        return smooth(start, steps, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch_reassociation, 'smooth', spy)
        slam.finish()
    return before


@pytest.mark.parametrize(('apart', 'sigma'), [(0.15, 0.03), (0.25, 0.08)])
@pytest.mark.parametrize('seed', [0, 1])
def test_reflectors_of_a_group_are_told_apart_in_the_end(seed, apart, sigma):
    """Too close to be resolved during the run, which takes a group for one reflector."""
    place = world(SINGLE, SINGLE + apart * BESIDE)
    slam, before, rmse_before, _ = among_groups(seed, apart, sigma)
    assert before < len(place.reflectors)
    found = slam.reflectors()
    gap = np.linalg.norm(found.points[:, None] - place.reflectors, axis=-1)
    assert sorted(gap.argmin(axis=1)) == list(range(len(place.reflectors)))
    assert gap.min(axis=1).max() < 0.5 * apart
    assert rmse(slam) < rmse_before


def rows_beside_a_circle():
    """Rows of three, 18 cm apart, in and outside of a circle of 4 m; (15, 2)."""
    out = []
    for k, a in enumerate((0.3, 1.6, 2.7, 4.0, 5.2)):
        along = np.array([-np.sin(1.4 * a), np.cos(1.4 * a)])
        middle = np.array([0.0, 4.0]) + (4.0 + 1.5 * (-1) ** k) * np.array([np.cos(a), np.sin(a)])
        out.append(middle + 0.18 * np.outer([-1.0, 0.0, 1.0], along))
    return np.concatenate(out)


@pytest.mark.parametrize('seed', [0, 1])
def test_rows_are_told_apart_though_the_path_is_off_by_their_gaps(seed):
    """Of each row some are seen ahead from nearby, and no other on the way to the next row."""
    rng = np.random.default_rng(seed)
    place, way = world(rows_beside_a_circle()), drive((0.5, 0.125, 150.6))
    made, truth = [], []
    for k, o in enumerate(observations(place, way, scan=False, rng=rng)):
        z = se2.transform(se2.inverse(way[k]), place.reflectors)
        near = (np.linalg.norm(z, axis=1) < 3.0) & (np.abs(np.arctan2(z[:, 1], z[:, 0])) < 1.0)
        seen = np.flatnonzero(near & (rng.random(len(near)) < 0.8 * (k % 3 == 0)))
        d = o.detections
        kept = replace(
            d, points=d.points[seen], cov=d.cov[seen], ids=d.ids[seen],
            diameters=d.diameters[seen],
        )  # fmt: skip
        made.append(replace(o, detections=kept))
        truth.append(seen)
    slam = Slam(Parameters())
    slam.process(made)
    slam.back_end.finish()
    frames = slam.batch_reassociation.reassociate(slam.back_end.trajectory()[1], slam.reflectors())
    keys, of = np.concatenate([f.landmarks for f in frames]), np.concatenate(truth)
    pairs = np.unique(np.stack([of, keys])[:, keys >= 0], axis=1, return_counts=True)[1]
    assert np.sort(pairs)[-15:].sum() > 0.9 * len(of)  # one of the associations for each of the 15


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_reflector_by_itself_stays_one_however_it_scatters(seed):
    slam = run(world(SINGLE), seed, seen=0.6, way=ROUND, scan=False, sigma=0.15)
    before = rmse(slam)
    slam.finish()
    assert len(slam.reflectors()) == len(SINGLE)
    # in these runs there is nothing to be gained
    assert rmse(slam) < 1.2 * before


def test_what_is_told_apart_is_as_sure_as_it_was_measured():
    """While it was taken for one, where it stands within its group was extra_variance besides."""
    place = world(SINGLE, SINGLE + 0.25 * BESIDE)
    made = observations(place, TWICE, rng=np.random.default_rng(1), scan=False, sigma=0.08)
    slam = Slam(Parameters())
    extra_variance = [
        np.abs(f.observation.detections.cov - o.detections.cov).max()
        for f, o in zip(slam.process(made), made, strict=True)
    ]
    assert max(extra_variance) > 0.05**2
    slam.back_end.finish()
    frames = slam.batch_reassociation.reassociate(slam.back_end.trajectory()[1], slam.reflectors())
    for frame, o in zip(frames, made, strict=True):
        np.testing.assert_array_equal(frame.observation.detections.cov, o.detections.cov)


def test_what_is_granted_the_path_its_answers_are_not_surer_than():
    least = among_groups(0, 0.15, 0.03).least
    extra_variance = Parameters().reflector.min_separation ** 2 * 0.5 ** np.arange(len(least))
    extra_variance[batch_reassociation.ANNEALED :] = 0.0
    assert len(least) > batch_reassociation.ANNEALED
    assert (np.array(least) >= extra_variance).all()
    assert least[-1] < 2.0 * 0.03**2


def test_the_graph_has_its_minimum_where_the_run_turned_out_to_be():
    slam = run(world(SINGLE, SINGLE + 0.5 * BESIDE), 5, scan=False, sigma=0.05)
    slam.finish()
    poses = slam.back_end.graph.poses.copy()
    assert slam.back_end.graph.chi2() < 1e-6
    slam.back_end.optimize(final=True)
    np.testing.assert_allclose(slam.back_end.graph.poses, poses, atol=1e-9)


def pillar(gap, seed, sigma):
    """The system after it looked back: in the circle, a reflector on either side of a pillar."""
    middle = np.array([0.0, 1.25])
    place = world(SINGLE, middle + gap * np.array([[0.5, 0.0], [-0.5, 0.0]]))
    made = observations(place, ROUND, rng=np.random.default_rng(seed), scan=False, sigma=sigma)
    for k, (o, pose) in enumerate(zip(made, ROUND, strict=True)):
        made[k] = only(o, [0, 1, 2, 3, 4 if pose[0] > 0.0 else 5])
    slam = Slam(Parameters())
    slam.process(made)
    slam.finish()
    return slam, place


@pytest.mark.parametrize(
    ('gap', 'seed', 'sigma'), [(0.15, 0, 0.02), (0.2, 0, 0.02), (0.3, 1, 0.04), (0.3, 2, 0.04)]
)
def test_what_was_told_apart_the_graph_does_not_take_for_one_again(gap, seed, sigma):
    """Never seen together, and too close for the front end to resolve."""
    slam, place = pillar(gap, seed, sigma)
    found = slam.reflectors()
    off = np.linalg.norm(found.points[:, None] - place.reflectors, axis=-1)
    assert len(found) == 6
    assert off.min(axis=1).max() < 0.03
    assert found.sightings.min() > 200
    assert slam.back_end.graph.chi2() < 1e-6
    assert not slam.back_end.associations_are_final


def test_a_person_who_stands_is_not_taken_for_many():
    """Somebody with a reflecting vest, 0.15 m wide, of which the front end makes some."""
    rng = np.random.default_rng(0)
    made = observations(world(SINGLE), ROUND, rng=rng, scan=False, sigma=0.05)
    for k, (o, pose) in enumerate(zip(made, ROUND, strict=True)):
        vest = np.array([-1.0, 4.0]) + 0.15 * rng.standard_normal(2)
        points = np.vstack([o.detections.points, se2.transform(se2.inverse(pose), vest)])
        made[k] = replace(o, detections=detections_of(points, o.stamp, None, 0.05))
    slam = Slam(Parameters())
    slam.process(made)
    slam.finish()
    off = np.linalg.norm(slam.reflectors().points[:, None] - SINGLE, axis=-1).min(axis=1)
    assert (off < 0.05).sum() == len(SINGLE)
    assert (off > 0.3).sum() < 8


def test_a_run_that_no_reflector_explains_keeps_its_map():
    """One that is seen at the start, and ghosts, each once."""
    rng, way = np.random.default_rng(0), drive((1.0, 0.0, 60.0))
    made = observations(TinyWorld(np.zeros((0, 4)), np.array([[2.0, 3.0]])), way, rng=rng,
                        scan=False)  # fmt: skip
    for k, o in enumerate(made):
        points = o.detections.points if k < 30 else rng.uniform(-12.0, 12.0, (int(k % 4 == 0), 2))
        made[k] = replace(o, detections=detections_of(points, o.stamp, None, 0.02))
    slam = Slam(Parameters())
    slam.process(made)
    slam.finish()
    assert len(slam.reflectors()) == 1
    assert (
        slam.batch_reassociation.reassociate(slam.back_end.trajectory()[1], slam.reflectors())
        == []
    )


def test_ids_are_kept():
    slam = run(ROOM, 3, scan=False, ids=True)
    slam.finish()
    assert sorted(slam.reflectors().ids) == list(range(100, 100 + len(ROOM.reflectors)))


def test_with_scans_there_is_nothing_to_look_back_on():
    slam = run(ROOM, 4)
    assert (
        slam.batch_reassociation.reassociate(slam.back_end.trajectory()[1], slam.reflectors())
        == []
    )


def test_map_that_is_gone_on_with_stays_what_it_was():
    """It has seen what this run has not: it is not rebuilt from this run alone."""
    slam = run(world(SINGLE), 6, scan=False, sigma=0.02)
    slam.finish()
    content = map_file.content_of(slam.back_end, Parameters(), None)
    again = Slam(Parameters())
    again.continue_map(content)
    keyframes = len(again.back_end.keyframes)
    made = observations(world(SINGLE), ROUND[:60], rng=np.random.default_rng(7), scan=False)
    again.process([replace(o, stamp=o.stamp + 10**12) for o in made])
    again.finish()
    assert len(again.back_end.keyframes) >= keyframes
    assert again.batch_reassociation.reassociate(np.zeros((60, 3)), again.reflectors()) == []
