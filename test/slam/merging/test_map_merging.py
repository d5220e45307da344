# SPDX-License-Identifier: Apache-2.0
"""Two maps are merged where their reflectors determine the relative pose, and only there."""

import json
import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_worlds import OTHER_ROOM, ROOM, drive, errors, messages
from numpy.testing import assert_array_equal

from rlml_slam import se2
from rlml_slam.cli.main import main
from rlml_slam.errors import MapError
from rlml_slam.maps import map_container
from rlml_slam.maps.pieces import Pieces
from rlml_slam.matching.reflectors.constellation import locate
from rlml_slam.matching.scans.packed_submap import Unpacked
from rlml_slam.params import Parameters, Relocalization
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.back_end.trajectory import poses_of
from rlml_slam.slam.merging.map_merging import (
    Drive,
    _packed,
    assemble,
    merge_files,
    once_each,
    survey_of_all,
)
from rlml_slam.slam.merging.placement import UNMATCHED_SHARE
from rlml_slam.slam.merging.site_map import session_of, site_of
from rlml_slam.slam.merging.site_tree import Placed, place_sessions
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Odometry, Scan, Verdict

PARAMS = Parameters(back_end=replace(Parameters().back_end, submap_size=10))
CURVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 6.0), (0.5, -0.7, 4.0))
HOUR = 3600 * 10**9
START = np.array([2.0, -1.4, 1.2])
AGAIN = drive((0.5, 0.5, 7.0), (0.4, -0.5, 4.0), start=START)


def mapped(world, poses, seed, scan=True, params=PARAMS):
    """A back end that knows nothing of where in the world its first pose is."""
    slam = Slam(params)
    slam.set_sensor_pose('laser', np.zeros(3))
    add = {Odometry: slam.add_odometry, Scan: slam.add_scan, Detections: slam.add_detections}
    for m in messages(world, poses, scan=scan, rng=np.random.default_rng(seed)):
        add[type(m)](m)
    slam.finish()
    return slam.back_end


def merge_maps(first, second):
    """One map, in the frame of the first. Raises MapError if their reflectors do not match."""
    contents = {'first': first, 'second': second}
    sessions = [session_of(name, content) for name, content in contents.items()]
    survey = survey_of_all(sessions)
    placed = place_sessions(sessions, PARAMS, survey)
    for doubt in placed.left_out.values():
        raise MapError(f'do not match at exactly one pose: {doubt.why}')
    return assemble(placed, lambda s: contents[s.name], PARAMS, survey)


@pytest.fixture(scope='module')
def two():
    first, second = mapped(ROOM, CURVE, 0), mapped(ROOM, AGAIN, 1)
    return [map_file.content_of(b, PARAMS, None) for b in (first, second)]


@pytest.fixture(scope='module')
def merged(two):
    return merge_maps(*two)


def test_second_map_is_put_where_it_lies(two, merged):
    a, b = (len(c.arrays['pose']) for c in two)
    np.testing.assert_allclose(merged.poses[1], START, atol=0.05)
    poses = merged.back_end.graph.poses
    assert len(poses) == a + b
    stamps = (two[1].arrays['key_stamp'] - 1_000_000_000) // 100_000_000
    distance, turn = errors(poses[a:], AGAIN[stamps])
    assert distance.max() < 0.05
    assert turn.max() < 0.03


def test_what_both_have_seen_is_there_once(two, merged):
    found = merged.back_end.reflectors()
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors, axis=-1)
    assert len(found) == len(ROOM.reflectors) == merged.joined
    assert gap.min(axis=0).max() < 0.03
    # of what both know: better than either
    alone = map_file.saved_map(two[0]).reflectors
    assert np.trace(found.cov.sum(axis=0)) < np.trace(alone.cov.sum(axis=0))


def test_frames_of_both_are_kept(two, merged):
    path = merged.content.arrays['path']
    assert len(path) == sum(len(c.arrays['path']) for c in two)
    assert (np.diff(path['stamp']) >= 0).all()
    poses = poses_of(path, merged.content.arrays['path_motion'], merged.back_end.graph.poses)
    of = (path['stamp'] - 1_000_000_000) // 100_000_000
    second = path['key'] >= len(two[0].arrays['pose'])
    assert errors(poses[~second], CURVE[of[~second]])[0].max() < 0.05
    assert errors(poses[second], AGAIN[of[second]])[0].max() < 0.05


def test_graph_is_one_and_at_its_optimum(two, merged):
    back_end = merged.back_end
    assert merged.closures > 0
    assert back_end.graph.fixed_poses.sum() == 1
    before = back_end.graph.poses.copy()
    back_end.optimize()
    np.testing.assert_allclose(back_end.graph.poses, before, atol=1e-3)


def test_merged_map_is_saved_and_gone_on_with(merged, tmp_path):
    path = map_file.save(tmp_path / 'c.rlml', merged.back_end, PARAMS)
    again = BackEnd(PARAMS)
    map_file.restore(map_file.load(path), again)
    assert again.graph.chi2() == merged.back_end.graph.chi2()
    numbers = [c.number for c in again.loop_closer.records if c.accepted]
    assert len(set(numbers)) == len(numbers)
    slam = Slam(PARAMS)
    slam.continue_map(map_file.load(path))
    slam.set_sensor_pose('laser', np.zeros(3))
    for m in messages(ROOM, AGAIN, rng=np.random.default_rng(5)):
        {Odometry: slam.add_odometry, Scan: slam.add_scan, Detections: slam.add_detections}[
            type(m)
        ](m)
    slam.finish()
    assert len(slam.reflectors()) == len(ROOM.reflectors)
    assert errors(slam.trajectory()[1][-1:], AGAIN[-1:])[0][0] < 0.06


def test_maps_of_which_nothing_tells_how_they_lie_are_refused(two, tmp_path, capsys):
    square = np.array([[-1.5, -2.0], [1.5, -2.0], [1.5, 2.0], [-1.5, 2.0]])
    for world in (
        replace(ROOM, reflectors=square),
        replace(ROOM, reflectors=np.random.default_rng(2).uniform(-2.0, 3.0, (5, 2))),
    ):
        other = map_file.content_of(mapped(world, AGAIN, 3), PARAMS, None)
        with pytest.raises(MapError, match='do not match at exactly one pose'):
            merge_maps(two[0], other)
    # twice the same square could be turned four ways
    twin = map_file.content_of(mapped(replace(ROOM, reflectors=square), CURVE, 4), PARAMS, None)
    with pytest.raises(MapError, match='do not match'):
        merge_maps(twin, twin)


@pytest.mark.parametrize('is_first', [False, True])
def test_map_without_a_scan_is_merged_with_one_of_scans(two, is_first):
    blind = map_file.content_of(mapped(ROOM, AGAIN, 2, scan=False), PARAMS, None)
    pair = (blind, two[0]) if is_first else (two[0], blind)
    merged = merge_maps(*pair)
    assert merged.joined == len(ROOM.reflectors)
    again = map_file.saved_map(merged.content)
    assert len(again.reflectors) == len(ROOM.reflectors)
    shapes = [c.arrays['submap_shape'] for c in (two[0], merged.content)]
    np.testing.assert_array_equal(*shapes)


def test_map_of_an_older_program_is_refused(two):
    older = {k: v for k, v in two[1].arrays.items() if k != 'reflector_removed'}
    for pair in ((two[0], two[1]._replace(arrays=older)), (two[1]._replace(arrays=older),) * 2):
        with pytest.raises(MapError, match='is incomplete'):
            merge_maps(*pair)


def test_command_merges_files(two, tmp_path, capsys):
    names = [str(map_container.write(tmp_path / f'{k}.rlml', c)) for k, c in enumerate(two)]
    out = tmp_path / 'c.rlml'
    assert main(['map', 'merge', *names, '--out', str(out)]) == 0
    assert 'reflectors in both' in capsys.readouterr().out
    assert len(map_file.saved_map(map_file.load(out)).reflectors) == len(ROOM.reflectors)


@pytest.mark.parametrize(('shared', 'unique'), [(7, True), (2, False)])
def test_maps_that_overlap_by_a_few_reflectors_are_placed_by_these(shared, unique):
    rng = np.random.default_rng(8)
    west, both, east = (
        rng.uniform(low, high, (n, 2))
        for low, high, n in (
            ((0.0, 0.0), (25.0, 20.0), 15), ((25.0, 0.0), (30.0, 20.0), shared),
            ((30.0, 0.0), (55.0, 20.0), 15),
        )
    )  # fmt: skip
    second = np.vstack([both, east])
    seen = se2.transform(se2.inverse(START), second) + 0.01 * rng.standard_normal(second.shape)
    first = np.vstack([west, both])
    cov = [np.tile(1e-4 * np.eye(2), (len(p), 1, 1)) for p in (seen, first)]
    stars = locate(
        seen, cov[0], first, cov[1], replace(Relocalization(), false_share=UNMATCHED_SHARE)
    )
    assert (stars.verdict is Verdict.UNIQUE) == unique, stars.why
    if unique:
        np.testing.assert_allclose(stars.candidates[0].pose, START, atol=0.03)


def test_command_merges_sessions_on_workers_as_in_this_process(two, tmp_path, capsys):
    """A stranger and a broken file are left out, with the reason, and cost nothing else."""
    pytest.importorskip('distributed')
    other = replace(ROOM, reflectors=np.random.default_rng(2).uniform(-2.0, 3.0, (5, 2)))
    contents = [*two, map_file.content_of(mapped(other, AGAIN, 3), PARAMS, None)]
    names = [str(map_container.write(tmp_path / f'{k}.rlml', c)) for k, c in enumerate(contents)]
    (tmp_path / 'broken.rlml').write_bytes(b'RLMLMAP')
    names.append(str(tmp_path / 'broken.rlml'))
    written = []
    for jobs in ('1', '2'):
        out = tmp_path / f'site-{jobs}.rlml'
        assert main(['map', 'merge', *names, '--out', str(out), '--jobs', jobs, '--json']) == 0
        figures = json.loads(capsys.readouterr().out)
        assert [s['map'] for s in figures['sessions']] == names[:2]
        assert set(figures['left_out']) == set(names[2:])
        assert 'pose' in figures['left_out'][names[2]]
        written.append(out.read_bytes())
    assert written[0] == written[1]


def test_nothing_is_written_where_no_two_maps_fit(two, tmp_path, capsys):
    name = str(map_container.write(tmp_path / 'a.rlml', two[0]))
    (tmp_path / 'broken.rlml').write_bytes(b'RLMLMAP')
    for names in ([name], [name, name], [name, str(tmp_path / 'broken.rlml')]):
        assert main(['map', 'merge', *names, '--out', str(tmp_path / 'c.rlml')]) != 0
        assert not (tmp_path / 'c.rlml').exists()


def imported(path, tmp_path):
    """The same map by way of text files."""
    assert main(['map', 'export', str(path), str(tmp_path / 'text')]) == 0
    out = tmp_path / 'imported.rlml'
    assert main(['map', 'import', str(tmp_path / 'text'), str(out)]) == 0
    return out


def an_hour_later(content):
    """The same session with other stamps: those of made drives are the same."""
    a = dict(content.arrays)
    a['path'] = a['path'].copy()
    a['path']['stamp'] += HOUR
    later = {name: a[name] + HOUR for name in ('key_stamp', 'key_scan_stamp')}
    return content._replace(arrays=a | later)


def remade(count=None, params=PARAMS):
    """The first drive, or its beginning, with other parameters."""
    return map_file.content_of(mapped(ROOM, CURVE[:count], 0, params=params), params, None)


@pytest.mark.parametrize('kind', ['copy', 'imported', 'parameters', 'autosave', 'continued'])
def test_maps_of_one_drive_count_once(two, tmp_path, kind):
    """Merged twice, its reflectors had half the variance without new data."""
    two = [two[0], an_hour_later(two[1])]
    a, b = (map_container.write(tmp_path / f'{k}.rlml', c) for k, c in enumerate(two))
    if kind == 'imported':
        again = imported(a, tmp_path)
    else:
        sparse = {'minimum_travel_distance': 0.43, 'minimum_travel_heading': 0.36}
        other = replace(PARAMS, back_end=replace(PARAMS.back_end, **sparse))
        again = map_container.write(tmp_path / 'again.rlml', {
            'copy': lambda: two[0], 'parameters': lambda: remade(params=other),
            'autosave': lambda: remade(len(CURVE) // 2),
            'continued': lambda: merge_maps(*two).content,
        }[kind]())  # fmt: skip
    if kind == 'continued':  # the larger one stays
        with pytest.raises(MapError, match=f'{a} and {again} are maps of one drive') as failed:
            merge_files([a, b, again], PARAMS)
        assert f'{b} and {again} are maps of one drive' in str(failed.value)
        return
    merged, placed = merge_files([a, b, again], PARAMS)
    assert placed.site.names == [str(a), str(b)]
    (doubt,) = placed.left_out.values()
    assert doubt.why == f'{again} and {a} are maps of one drive, which is used once'
    once, _ = merge_files([a, b], PARAMS)
    assert_array_equal(merged.back_end.reflectors().cov, once.back_end.reflectors().cov)


@pytest.mark.parametrize(('own', 'used'), [(40, 2), (5, 1)])
def test_maps_that_continue_a_third_one_are_both_used(own, used):
    """Both have data of their own, if it is more than a tenth of it."""
    rng = np.random.default_rng(2)
    shared = rng.uniform(0.0, 20.0, (60, 2))
    posts = rng.uniform(0.0, 20.0, (8, 2))

    def continued(name, first, number):
        stamps = np.concatenate([np.arange(1, 61), np.arange(first, first + number)]) * 10**9
        points = np.vstack([shared, rng.uniform(0.0, 20.0, (number, 2))])
        session = SimpleNamespace(name=name, points=posts)
        return Drive(session, stamps, points, len(stamps))

    kept, again = once_each([continued('a', 1000, 41), continued('b', 2000, own)])
    assert len(kept) == used
    assert list(again) == ['b'][used - 1 :]


def test_one_file_by_two_names_is_refused(two, tmp_path, monkeypatch):
    map_container.write(tmp_path / 'a.rlml', two[0])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MapError, match='none twice'):
        merge_files([Path('a.rlml'), tmp_path / 'x' / '..' / 'a.rlml'], PARAMS)


def test_session_without_reflectors_is_placed_by_its_scans(two, tmp_path):
    """And one whose scans fit nowhere is left out."""
    bare = [mapped(replace(w, reflectors=np.zeros((0, 2))), AGAIN, 6) for w in (ROOM, OTHER_ROOM)]
    contents = [two[0], *(map_file.content_of(b, PARAMS, None) for b in bare)]
    paths = [map_container.write(tmp_path / f'{k}.rlml', c) for k, c in enumerate(contents)]
    merged, placed = merge_files(paths, PARAMS)
    assert placed.site.names == [str(p) for p in paths[:2]]
    assert list(placed.left_out) == [str(paths[2])]
    np.testing.assert_allclose(merged.poses[1], START, atol=0.1)
    assert merged.closures > 0


@pytest.mark.parametrize('kept', [0, 6])
def test_submaps_of_a_place_that_is_mapped_again_do_not_add_up(two, kept):
    """The same session three times: its submaps are there once, or thrice if all are kept."""
    params = replace(PARAMS, back_end=replace(PARAMS.back_end, keyframes_per_place=kept))
    names = ['a', 'b', 'c']
    sessions = [session_of(name, two[0]) for name in names]
    site = site_of([(s, np.zeros(3)) for s in sessions])
    made = assemble(Placed(site, {}, {}), lambda s: two[0], params)
    once = len(two[0].arrays['submap_anchor'])
    number = len(made.content.arrays['submap_anchor'])
    assert number == 3 * once if kept == 0 else number <= 1.5 * once
    cells = made.content.arrays['submap_shape'].prod(axis=1).sum()
    packed = made.content.arrays['submap_cells']
    assert isinstance(packed, Pieces)  # they are never all unpacked
    assert len(packed) == len(np.asarray(packed)) == cells


def test_cells_of_a_session_go_as_soon_as_they_are_packed(two):
    arrays = {name: array.copy() for name, array in two[0].arrays.items()}
    cells = weakref.ref(arrays['submap_cells'])
    packed = list(_packed(arrays, PARAMS, Unpacked()))
    assert len(packed) == len(two[0].arrays['submap_anchor'])
    assert cells() is None
