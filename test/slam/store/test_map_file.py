# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, drive, errors, messages, observations
from numpy.testing import assert_allclose

from rlml_slam import se2
from rlml_slam.cli.main import main
from rlml_slam.cli.map import map_export, map_info
from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.graph.batch.solver import optimize
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import Content
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import EdgeKind, Odometry, Scan

PARAMS = Parameters()
CURVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 4.0), (0.5, -0.7, 2.0))
# the room once more, from elsewhere
AGAIN = drive((0.4, 0.4, 6.0), (0.5, -0.5, 3.0), start=(0.6, -1.2, 0.4))


def feed(slam, observed):
    slam.set_sensor_pose('laser', np.zeros(3))
    frames = []
    for m in observed:
        if isinstance(m, Odometry):
            frames += slam.add_odometry(m)
        elif isinstance(m, Scan):
            frames += slam.add_scan(m)
        else:
            frames += slam.add_detections(m)
    return frames + slam.finish()


@pytest.fixture(scope='module')
def mapped():
    slam = Slam(PARAMS)
    feed(slam, messages(ROOM, CURVE, rng=np.random.default_rng(0)))
    return slam


@pytest.fixture
def saved(mapped, tmp_path):
    return map_file.save(tmp_path / 'room.rlml', mapped.back_end, PARAMS)


def test_map_is_read_as_it_was_saved(mapped, saved):
    content = map_file.load(saved)
    again = BackEnd(PARAMS)
    map_file.restore(content, again)
    a, b = mapped.back_end, again
    np.testing.assert_array_equal(b.graph.poses, a.graph.poses)
    np.testing.assert_array_equal(b.graph.fixed_poses, a.graph.fixed_poses)
    assert b.graph.chi2() == a.graph.chi2()
    np.testing.assert_array_equal(b.reflectors().points, a.reflectors().points)
    np.testing.assert_array_equal(b.reflectors().keys, a.reflectors().keys)
    np.testing.assert_array_equal(b.occupancy_grid().cells, a.occupancy_grid().cells)
    assert [k.stamp for k in b.keyframes] == [k.stamp for k in a.keyframes]
    assert b.scan_graph.num_submaps == a.scan_graph.num_submaps
    # saved once more, only what belongs to the session that ended is another
    twice = map_file.content_of(b, PARAMS, b.occupancy_grid())
    assert json.loads(json.dumps(twice.description)) == content.description
    for name, array in content.arrays.items():
        if name not in (
            'path',
            'key_local',
            'key_cov',
            'submap_cells',
            'submap_corner',
            'submap_shape',
        ):
            np.testing.assert_array_equal(twice.arrays[name], array, err_msg=name)


def test_a_jump_is_one_in_the_saved_map_as_well(saved):
    """What is known of a keyframe does not come through a jump in the session after, either."""
    content = map_file.load(saved)
    jumped = content.arrays['key_jumped'].copy()
    jumped[6] = True
    jumping = Content({**content.arrays, 'key_jumped': jumped}, content.description)
    again, without = BackEnd(PARAMS), BackEnd(PARAMS)
    map_file.restore(jumping, again)
    map_file.restore(content, without)
    same = map_file.content_of(again, PARAMS, again.occupancy_grid())
    np.testing.assert_array_equal(same.arrays['key_jumped'], jumped)
    keys = again.keyframes
    before, after = (again.path_covariance.cov(keys[k]) for k in (5, 6))
    assert_allclose(before, without.path_covariance.cov(keys[5]), atol=1e-15)
    assert_allclose(after, se2.rotate_cov(keys[6].cov_local, -keys[6].T_local[2]), atol=1e-12)
    assert again.path_covariance.newest == keys[6].number


def test_last_keyframe_is_known_by_its_jump_in_the_frame_of_the_map(saved):
    content = map_file.load(saved)
    jumped, local = (content.arrays[name].copy() for name in ('key_jumped', 'key_local'))
    jumped[-1] = True
    local[-1] = 20.0, -5.0, 1.0  # the frame of a session that began elsewhere
    again = BackEnd(PARAMS)
    arrays = {**content.arrays, 'key_jumped': jumped, 'key_local': local}
    map_file.restore(Content(arrays, content.description), again)
    last = again.keyframes[-1]
    known = se2.rotate_cov(again.path_covariance.cov(last), last.T_local[2])
    assert_allclose(known, last.cov_local, atol=1e-12)


def test_saved_map_keeps_its_sightings_whatever_comes_after(saved):
    """A session that sees fewer reflectors does not thin what the one before saw."""
    again = BackEnd(PARAMS)
    map_file.restore(map_file.load(saved), again)
    again.solver.solve()
    before = int(again.graph.sightings.enabled.sum())
    for key in again.keyframes:
        again.reflector_graph.thin(key.index)
    assert int(again.graph.sightings.enabled.sum()) == before > 0


def test_two_saves_are_equal_files(mapped, saved, tmp_path):
    other = map_file.save(tmp_path / 'other.rlml', mapped.back_end, PARAMS)
    assert other.read_bytes() == saved.read_bytes()


def test_mapping_goes_on_in_a_saved_map(mapped, saved):
    before = len(mapped.back_end.keyframes)
    slam = Slam(PARAMS)
    slam.continue_map(map_file.load(saved))
    feed(slam, messages(ROOM, AGAIN, rng=np.random.default_rng(1)))
    back_end = slam.back_end
    assert len(back_end.keyframes) > before + 5
    # the reflectors are those of the map, under the keys that they had
    found = back_end.reflectors()
    np.testing.assert_array_equal(found.keys, mapped.back_end.reflectors().keys)
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors, axis=-1)
    assert gap.min(axis=1).max() < 0.03
    distance, turn = errors(slam.trajectory()[1], AGAIN)
    assert distance.max() < 0.06
    assert turn.max() < 0.03
    # and the poses of the first session stayed where they were
    moved, _ = errors(back_end.graph.poses[:before], mapped.back_end.graph.poses)
    assert moved.max() < 0.02


def test_robot_localizes_in_the_file(saved):
    known = map_file.saved_map(map_file.load(saved))
    assert len(known.reflectors) == len(ROOM.reflectors)
    params = replace(PARAMS, node=replace(PARAMS.node, map_start_pose=tuple(AGAIN[0])))
    front_end = FrontEnd(params)
    front_end.use_map(known.reflectors, known.grid)
    frames = [
        front_end.process(o) for o in observations(ROOM, AGAIN, rng=np.random.default_rng(2))
    ]
    assert errors(np.array([f.T_map_base for f in frames[5:]]), AGAIN[5:])[0].max() < 0.06


def test_empty_map_is_not_saved(tmp_path):
    with pytest.raises(MapError, match='no map yet'):
        map_file.save(tmp_path / 'a.rlml', BackEnd(PARAMS), PARAMS)
    assert list(tmp_path.iterdir()) == []


def test_other_and_inconsistent_files_are_refused(saved, tmp_path):
    content = map_file.load(saved)
    newer = Content(content.arrays, {**content.description, 'version': 99})
    with pytest.raises(FileFormatError, match='99, but this program reads'):
        map_file.load(map_container.write(tmp_path / 'newer.rlml', newer))
    for name, bad in (
        ('edge_nodes', content.arrays['edge_nodes'] + 1000),
        ('key_points', content.arrays['key_points'][:-1]),
        ('pose', np.full_like(content.arrays['pose'], np.nan)),
    ):
        broken = Content({**content.arrays, name: bad}, content.description)
        with pytest.raises(FileFormatError, match='are inconsistent'):
            map_file.restore(broken, BackEnd(PARAMS))
    without = {k: v for k, v in content.arrays.items() if k != 'submap_cells'}
    with pytest.raises(FileFormatError, match='submap_cells'):
        map_file.restore(Content(without, content.description), BackEnd(PARAMS))


def test_export_is_what_the_map_says(mapped, saved, tmp_path):
    content = map_file.load(saved)
    (tmp_path / 'out').mkdir()
    names = map_export.export(content, tmp_path / 'out')
    assert sorted(p.name for p in (tmp_path / 'out').iterdir()) == sorted(names)
    figures = map_info.contents(content)
    assert figures['keyframes'] == len(mapped.back_end.keyframes)
    assert figures['reflectors'] == len(ROOM.reflectors)
    rows = (tmp_path / 'out' / 'trajectory.tum').read_text().splitlines()
    assert len([r for r in rows if not r.startswith('#')]) == len(mapped.trajectory()[0])
    graph = (tmp_path / 'out' / 'graph.g2o').read_text()
    assert graph.count('VERTEX_SE2 ') == figures['keyframes']


def test_closure_is_revoked_in_a_saved_map(mapped, tmp_path, capsys):
    back_end = BackEnd(PARAMS)
    map_file.restore(map_file.content_of(mapped.back_end, PARAMS, None), back_end)
    graph = back_end.graph
    i, j = 1, len(graph.poses) - 2
    delta = se2.compose(se2.between(graph.poses[i], graph.poses[j]), (0.3, 0.0, 0.0))  # wrong
    edge = graph.add_edge(EdgeKind.CLOSURE, i, j, delta, 1e8 * np.eye(3))
    number = 1 + max((c.number for c in back_end.loop_closer.records), default=-1)
    back_end.loop_closer.records.append(Closure(i, j, delta, 0.7, edge, 'fits', number=number))
    right = graph.poses.copy()
    optimize(graph, PARAMS.solver)
    assert np.abs(graph.poses - right).max() > 0.01
    path = map_file.save(tmp_path / 'a.rlml', back_end, PARAMS)
    assert main(['closures', str(path), '--all']) == 0
    assert f'{number}' in capsys.readouterr().out
    assert main(['closures', str(path), '--revoke', str(number)]) == 0
    assert f'loop closure {number}' in capsys.readouterr().out
    content = map_file.load(path)
    np.testing.assert_allclose(content.arrays['pose'], right, atol=1e-3)
    assert main(['closures', str(path), '--json']) == 0
    rows = json.loads(capsys.readouterr().out)['closures']
    assert [r['state'] for r in rows if int(r['number']) == number] == ['revoked']
    map_file.load(f'{path}.previous')  # as it was before
    assert main(['closures', str(path), '--revoke', str(number)]) == 1
    assert 'already revoked' in capsys.readouterr().err


def test_parameters_of_a_map_are_those_it_was_made_with(mapped):
    params = replace(PARAMS, solver=replace(PARAMS.solver, max_iterations=33))
    content = map_file.content_of(mapped.back_end, params, None)
    content = Content(content.arrays, json.loads(json.dumps(content.description)))
    assert map_file.parameters_of(content) == params
    content.description['parameters']['solver']['of_another_version'] = 1
    assert map_file.parameters_of(content) == params
