# SPDX-License-Identifier: Apache-2.0
"""The Python API, as a notebook uses it."""

from __future__ import annotations

import dataclasses
import re
import runpy
import subprocess
import sys
import typing
from pathlib import Path

import numpy as np
import pytest

import rlml_slam
from rlml_slam.datasets.tum import Trajectory, write_tum
from rlml_slam.types import Detections, Imu, Odometry, Scan

ROOT = Path(__file__).resolve().parents[1]
ROOM = ROOT / 'bags' / 'room'


@pytest.fixture(scope='module')
def bag():
    return rlml_slam.read_bag(ROOM)


@pytest.fixture(scope='module')
def result(bag):
    return rlml_slam.replay(bag)


def test_import_is_cheap():
    code = 'import sys, rlml_slam; print(*sys.modules)'
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert not {'numpy', 'numba', 'rosbags', 'rlml_slam.api'} & set(done.stdout.split())


def test_names_are_listed_and_typed():
    assert len(rlml_slam.__all__) <= 10
    for name in rlml_slam.__all__:
        assert name in dir(rlml_slam)
        value = getattr(rlml_slam, name)
        assert value.__doc__
        if not isinstance(value, type):
            hints = typing.get_type_hints(value)
            assert 'return' in hints
            assert len(hints) == value.__code__.co_argcount + value.__code__.co_kwonlyargcount + 1
    with pytest.raises(AttributeError, match='no attribute'):
        _ = rlml_slam.optimise


def test_notebook_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    names = runpy.run_path('docs/examples/notebook.py')
    out = capsys.readouterr().out
    assert 'bags/kitchen: no such bag' in out
    assert len(names['result'].poses) == len(names['localized'].poses)
    assert names['walls'].shape[1] == 2


def test_result_has_arrays(bag, result):
    n = len(result.stamps)
    assert bag.start <= result.stamps[0] < result.stamps[-1] <= bag.end
    assert result.poses.shape == (n, 3)
    assert result.live.poses.shape == (n, 3)
    assert result.covariances.shape == (n, 3, 3)
    assert result.map.reflectors.points.shape == (7, 2)
    assert result.map.grid.cells.dtype == np.int8
    assert result.problem == ''
    assert result.metrics['reflectors_spurious'] == 0


def test_measurement_by_measurement_gives_the_result_of_a_replay(bag, result):
    slam = rlml_slam.Slam(bag.parameters, bag.sensor_poses)
    frames = [frame for measurement in bag for frame in slam.add(measurement)]
    ended = slam.finish()
    # the frames of finish() come without an add
    np.testing.assert_array_equal([f.T_map_base for f in frames], ended.live.poses[: len(frames)])
    np.testing.assert_array_equal(ended.poses, result.poses)
    np.testing.assert_array_equal(ended.map.reflectors.points, result.map.reflectors.points)
    assert slam.map().grid.cells.tobytes() == result.map.grid.cells.tobytes()
    assert bag.skipped == {}


def test_result_stays_as_it_is_while_the_run_goes_on(bag):
    slam, measurements = rlml_slam.Slam(bag.parameters, bag.sensor_poses), list(bag)
    for measurement in measurements[:800]:
        slam.add(measurement)
    first = slam.finish()
    n = len(first.live.poses)
    for measurement in measurements[800:]:
        slam.add(measurement)
    assert len(slam.finish().live.poses) > n == len(first.live.poses) == len(first.poses)


def test_map_is_saved_loaded_and_localized_in(bag, result, tmp_path):
    whole = rlml_slam.load_map(rlml_slam.save_map(result.map, tmp_path / 'room.rlml'))
    plain = rlml_slam.load_map(rlml_slam.save_map(result.map, tmp_path / 'folder'))
    assert plain.graph is None
    other = dataclasses.replace(plain, grid=None)
    result.save(tmp_path / 'folder')
    again = rlml_slam.load_map(rlml_slam.save_map(other, tmp_path / 'folder'))
    assert again.graph is again.grid is None  # those of the map before are set aside
    assert len(rlml_slam.load_map(result.save(tmp_path / 'out')).graph.arrays) > 0
    for map_ in (whole, plain):
        np.testing.assert_allclose(map_.reflectors.points, result.map.reflectors.points, atol=1e-6)
        found = rlml_slam.replay(bag, localize_in=map_)
        assert rlml_slam.evaluate(found)['rmse_m'] < 0.02
    with pytest.raises(rlml_slam.RlmlError, match='no graph'):
        rlml_slam.replay(bag, continue_from=plain)
    with pytest.raises(rlml_slam.RlmlError, match='save it to a folder'):
        rlml_slam.save_map(plain, tmp_path / 'plain.rlml')
    with pytest.raises(rlml_slam.RlmlError, match='exclude each other'):
        rlml_slam.replay(bag, localize_in=whole, continue_from=whole)


def test_map_is_continued(bag, result):
    slam = rlml_slam.Slam(sensor_poses=bag.sensor_poses, continue_from=result.map)
    for measurement in bag:
        slam.add(measurement)
    after, before = slam.finish().map.reflectors, result.map.reflectors
    assert len(after) == len(before)
    assert (after.sightings > before.sightings).all()


def test_errors_are_those_of_the_files(result, tmp_path):
    own = rlml_slam.evaluate(result)
    assert own['rmse_m'] < 0.02
    truth = Trajectory(result.stamps, result.poses + np.array([1.0, 2.0, 0.0]))
    write_tum(tmp_path / 'truth.tum', truth)
    assert rlml_slam.evaluate(result, truth=tmp_path / 'truth.tum')['rmse_m'] < 1e-6
    shifted = rlml_slam.evaluate(result, truth=truth, align=False)
    assert shifted['rmse_m'] == pytest.approx(np.hypot(1.0, 2.0))
    t = result.stamps[[0, -1]] * 1e-9
    delta = rlml_slam.evaluate(result.trajectory, truth=truth)['matched']
    assert delta == len(result.poses)
    (tmp_path / 'relations').write_text(f'{t[0]:.9f} {t[1]:.9f} 0 0 0 0 0 0\n')
    relative = rlml_slam.evaluate(result, relations=tmp_path / 'relations')
    assert relative['relations'] == 1
    both = rlml_slam.evaluate(result, truth=truth, relations=tmp_path / 'relations')
    assert (both['unmatched'], both['relations_unmatched']) == (0, 0)
    with pytest.raises(rlml_slam.RlmlError, match='give truth or relations'):
        rlml_slam.evaluate(result.trajectory)


def test_parameters_are_read_and_checked(tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text('/**:\n  ros__parameters:\n    laser_pose: [0.2, 0.0, 0.0]\n')
    found = rlml_slam.read_parameters(path, {'use_odom': False})
    assert found.node.laser_pose == (0.2, 0.0, 0.0)
    assert not found.node.use_odom
    with pytest.raises(rlml_slam.RlmlError, match="unknown parameter 'use_odm'"):
        rlml_slam.read_parameters(changes={'use_odm': False})


def test_numbers_of_numpy_are_parameters():
    found = rlml_slam.read_parameters(
        changes={
            'back_end.keyframes_per_place': np.int64(3), 'motion.max_gap': np.float32(0.5),
            'laser_pose': np.array([0.5, 0.0, 0.0]), 'use_odom': np.bool_(False),
        }
    )  # fmt: skip
    assert found.back_end.keyframes_per_place == 3
    assert found.motion.max_gap == 0.5
    assert found.node.laser_pose == (0.5, 0.0, 0.0)
    assert found.node.use_odom is False


@pytest.mark.parametrize('pose', [[0.2, 0.0], [0.2, 0.0, np.nan], np.zeros((1, 3))])
def test_what_is_no_pose_of_a_sensor_is_refused(pose):
    with pytest.raises(rlml_slam.RlmlError, match=r'sensor_poses: laser: .* is not x, y, heading'):
        rlml_slam.Slam(sensor_poses={'laser': pose})


def test_other_things_are_no_measurements():
    with pytest.raises(rlml_slam.RlmlError, match='int is no measurement'):
        rlml_slam.Slam().add(3)
    with pytest.raises(rlml_slam.RlmlError, match='no measurement could be used'):
        rlml_slam.Slam().finish()


def test_stamps_of_numpy_are_stamps(bag):
    """With jitter, the sums of the filter of stamps are beyond 64 bits."""
    rng = np.random.default_rng(3)
    shifts = 1_760_000_000_000_000_000 + rng.integers(0, 20_000_000, 3000)
    poses = []
    for kind in (int, np.int64):
        slam = rlml_slam.Slam(sensor_poses=bag.sensor_poses)
        frames = []
        for m, shift in zip(bag, shifts.tolist(), strict=False):
            frames += slam.add(dataclasses.replace(m, stamp=kind(m.stamp + shift)))
        poses.append([f.T_map_base for f in frames])
    assert len(poses[0]) > 50
    np.testing.assert_array_equal(*poses)


ONE = np.eye(2)[None] * 1e-4
WRONG = {
    'Odometry.pose': Odometry(1, np.zeros(2)),
    'Odometry.stamp': Odometry(1.5e9, np.zeros(3)),
    'Imu.yaw_rate': Imu(1, 'fast'),
    'Scan.stamp': Scan('1', 'laser', 0.0, 0.1, 0.0, 0.1, 9.0, np.ones(9), np.zeros(0)),
    'Scan.ranges': Scan(1, 'laser', 0.0, 0.1, 0.0, 0.1, 9.0, np.ones((3, 3)), np.zeros(0)),
    'Detections.points': Detections(1, 'laser', np.ones(2), ONE, [1], [0.1]),
    'Detections.cov': Detections(1, 'laser', np.ones((1, 2)), np.eye(2), [1], [0.1]),
    'Detections.ids': Detections(1, 'laser', np.ones((1, 2)), ONE, [1, 2], [0.1]),
    'Imu.stamp': Imu(10**30, 0.1),
    'Scan.angle_min': Scan(1, 'laser', 'a', 0.1, 0.0, 0.1, 9.0, np.ones(9), np.zeros(0)),
    'Scan.range_max': Scan(1, 'laser', 0.0, 0.1, 0.0, 0.1, None, np.ones(9), np.zeros(0)),
    'Scan.frame_id': Scan(1, None, 0.0, 0.1, 0.0, 0.1, 9.0, np.ones(9), np.zeros(0)),
    'Odometry.pose: ': Odometry(1, np.ones(3) * 1j),
    'Detections.ids: [1.7]': Detections(1, 'laser', np.ones((1, 2)), ONE, [1.7], [0.1]),
    'Detections.ids: [1000': Detections(1, 'laser', np.ones((1, 2)), ONE, [10**30], [0.1]),
    'Detections.ids: [nan]': Detections(1, 'laser', np.ones((1, 2)), ONE, [np.nan], [0.1]),
    'Detections.ids: its': Detections(1, 'laser', np.ones((0, 2)), ONE[:0], [1], [0.1]),
    'Detections.diameters': Detections(1, 'laser', np.ones((1, 2)), ONE, [1], 0.1),
}


@pytest.mark.parametrize('name', WRONG)
def test_measurement_of_another_shape_is_refused_and_harms_nothing(bag, name):
    slam = rlml_slam.Slam(sensor_poses=bag.sensor_poses)
    with pytest.raises(rlml_slam.RlmlError, match=re.escape(name)):
        slam.add(WRONG[name])
    frames = [f for m, _ in zip(bag, range(400), strict=False) for f in slam.add(m)]
    assert len(frames) > 5


def test_lists_and_other_numbers_are_measurements(bag):
    poses = []
    for listed in (False, True):
        slam = rlml_slam.Slam(sensor_poses=bag.sensor_poses)
        frames = []
        for m, _ in zip(bag, range(400), strict=False):
            if listed and isinstance(m, Scan):
                m = dataclasses.replace(
                    m, ranges=m.ranges.tolist(), intensities=m.intensities.astype(np.float64)
                )
            elif listed and isinstance(m, Odometry):
                m = dataclasses.replace(m, pose=tuple(m.pose.tolist()))
            frames += slam.add(m)
        poses.append([f.T_map_base for f in frames])
    np.testing.assert_array_equal(*poses)


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (lambda b: rlml_slam.replay(b, {'use_odom': False}), 'dict is not Parameters'),
        (lambda b: rlml_slam.Slam({'use_odom': False}), 'read_parameters'),
        (lambda b: rlml_slam.read_bag(ROOM, {}), 'read_parameters'),
        (lambda b: rlml_slam.replay(b, localize_in=3), 'localize_in: a Map'),
        (lambda b: rlml_slam.replay(b, continue_from='nosuch.rlml'), 'nosuch.rlml'),
        (lambda b: rlml_slam.Slam(localize_in=rlml_slam.Slam().map()), 'the map is empty'),
        (lambda b: rlml_slam.Slam(sensor_poses={'laser': 'abc'}), 'not x, y, heading'),
        (lambda b: rlml_slam.save_map(b, 'x.rlml'), 'a Map is needed, not Bag'),
        (lambda b: rlml_slam.evaluate(np.zeros((2, 3)), truth=b.truth), 'ndarray is no Result'),
    ],
)
def test_likely_mistakes_are_errors_of_the_package(bag, call, said):
    with pytest.raises(rlml_slam.RlmlError, match=re.escape(said)):
        call(bag)


def test_map_may_be_given_by_its_path(result, tmp_path):
    path = rlml_slam.save_map(result.map, tmp_path / 'room.rlml')
    by_path, by_map = rlml_slam.Slam(localize_in=path), rlml_slam.Slam(localize_in=result.map)
    np.testing.assert_array_equal(by_path.map().reflectors.points, by_map.map().reflectors.points)
