# SPDX-License-Identifier: Apache-2.0
"""A survey defines the frame of the map as soon as the reflectors determine it."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, TinyWorld, drive, errors, messages

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.maps.survey import Survey
from rlml_slam.matching.reflectors.survey_alignment import place
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import ANONYMOUS, Detections, Odometry, Reflectors, Scan

PARAMS = Parameters()
T_PLANT = np.array([12.0, -7.0, 2.1])  # of the world in the plant
CURVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 6.0), (0.5, -0.7, 4.0))
SIGMA = 0.005  # [m] of the survey


def surveyed(points, ids=True):
    noise = SIGMA * np.random.default_rng(7).standard_normal(points.shape)
    n = len(points)
    return Survey(
        50 + np.arange(n) if ids else np.full(n, ANONYMOUS),
        se2.transform(T_PLANT, points) + noise,
        np.full(n, np.nan),
    )


def run(survey, world=ROOM, slam=None, poses=CURVE, **options):
    slam = slam or Slam(PARAMS, survey=survey)
    slam.set_sensor_pose('laser', np.zeros(3))
    add = {Odometry: slam.add_odometry, Scan: slam.add_scan, Detections: slam.add_detections}
    frames = []
    for m in messages(world, poses, rng=np.random.default_rng(0), **options):
        frames += add[type(m)](m)
    return slam, frames + slam.finish()


@pytest.fixture(scope='module')
def in_survey_frame():
    return run(surveyed(ROOM.reflectors))


def test_map_gets_the_frame_of_the_survey(in_survey_frame):
    slam, frames = in_survey_frame
    truth = se2.compose(T_PLANT, CURVE)
    distance, turn = errors(slam.trajectory()[1], truth)
    # 5 mm of survey and 2 cm of detection noise, averaged over the drive
    assert distance.max() < 0.03
    assert turn.max() < 0.01
    last, _ = errors(frames[-1].T_map_base[None], truth[-1:])
    assert last[0] < 0.03


def test_reflectors_get_the_ids_and_the_places_of_the_survey(in_survey_frame):
    found = in_survey_frame[0].reflectors()
    survey = surveyed(ROOM.reflectors)
    np.testing.assert_array_equal(np.sort(found.ids), survey.ids)
    gap = found.points - survey.points[found.ids - 50]
    assert np.hypot(*gap.T).max() < 0.02
    # known at least as well as they were surveyed
    assert np.linalg.eigvalsh(found.cov).max() <= PARAMS.back_end.survey_sigma**2


def test_gauge_is_the_survey_alone(in_survey_frame):
    graph = in_survey_frame[0].back_end.graph
    assert not graph.fixed_poses.any()
    assert graph.landmark_priors.enabled.sum() == len(ROOM.reflectors)


@pytest.mark.parametrize('twins', ['symmetric', 'few', 'elsewhere'])
def test_no_frame_is_guessed(twins):
    square = np.array([[-1.5, -2.0], [1.5, -2.0], [1.5, 2.0], [-1.5, 2.0]])
    points = {
        'symmetric': square,  # looks the same turned by half a circle
        'few': ROOM.reflectors[:2],
        'elsewhere': np.random.default_rng(3).uniform(-4.0, 4.0, (6, 2)),
    }[twins]
    world = TinyWorld(ROOM.walls, square if twins == 'symmetric' else ROOM.reflectors)
    slam, frames = run(surveyed(points), world)
    survey_frame = slam.back_end.survey_frame
    assert not survey_frame.found
    assert survey_frame.why
    assert slam.back_end.graph.fixed_poses.sum() == 1
    assert errors(frames[-1].T_map_base[None], CURVE[-1:])[0][0] < 0.05


def test_moved_reflector_does_not_bend_the_map():
    survey = surveyed(ROOM.reflectors)
    survey.points[2] += [0.6, 0.0]
    slam, _ = run(survey)
    assert slam.back_end.survey_frame.found
    assert sorted(slam.back_end.reflector_graph.surveyed().values()) == [0, 1, 3, 4, 5]
    assert errors(slam.trajectory()[1], se2.compose(T_PLANT, CURVE))[0].max() < 0.03


def test_prior_that_the_sightings_contradict_is_dropped(in_survey_frame, tmp_path):
    content = map_file.content_of(in_survey_frame[0].back_end, PARAMS, None)
    rows = in_survey_frame[0].back_end.reflector_graph.surveyed()
    key = next(k for k, row in rows.items() if row == 3)
    node = content.arrays['reflector_node'][content.arrays['reflector_key'] == key]
    wrong = content.arrays['landmark_prior_measured'].copy()
    wrong[content.arrays['landmark_prior_nodes'][:, 0] == node] += [0.3, 0.0]
    again = BackEnd(PARAMS)
    arrays = {**content.arrays, 'landmark_prior_measured': wrong}
    map_file.restore(content._replace(arrays=arrays), again)
    again.optimize()
    assert sorted(again.reflector_graph.surveyed().values()) == [0, 1, 2, 4, 5]
    moved = again.reflectors().points - in_survey_frame[0].reflectors().points
    assert np.hypot(*moved.T).max() < 0.01


def test_ids_tell_the_place_where_the_constellation_does_not():
    points = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])  # four ways round
    survey = Survey(np.arange(4), points, np.full(4, np.nan))
    moved = se2.transform(se2.inverse(T_PLANT), points)
    cov = np.tile(1e-4 * np.eye(2), (4, 1, 1))
    anonymous = Reflectors(
        np.arange(4), moved, cov, np.full(4, ANONYMOUS), np.full(4, 5), np.full(4, np.nan)
    )
    assert place(anonymous, survey, 0.02).T_survey_map is None
    named = replace(anonymous, ids=np.arange(4))
    np.testing.assert_allclose(place(named, survey, 0.02).T_survey_map, T_PLANT, atol=1e-9)
    # ids at other places than surveyed give no frame
    swapped = replace(anonymous, ids=np.array([1, 0, 2, 3]))
    assert place(swapped, survey, 0.02).T_survey_map is None


def test_saved_map_keeps_its_survey(in_survey_frame, tmp_path):
    back_end = in_survey_frame[0].back_end
    content = map_file.load(map_file.save(tmp_path / 'a.rlml', back_end, PARAMS))
    again = Slam(PARAMS)
    again.continue_map(content)
    assert again.back_end.survey_frame.found
    assert again.back_end.reflector_graph.surveyed() == back_end.reflector_graph.surveyed()
    slam, _ = run(None, slam=again, poses=CURVE[40:])
    assert errors(slam.trajectory()[1][-1:], se2.compose(T_PLANT, CURVE[-1:]))[0][0] < 0.05
    other = surveyed(ROOM.reflectors + 1.0)
    with pytest.raises(MapError, match='another survey'):
        map_file.restore(content, BackEnd(PARAMS, other))
