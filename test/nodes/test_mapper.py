# SPDX-License-Identifier: Apache-2.0
"""The mapper by itself: what it makes of frames, without a front end and without topics."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import resource
import shutil
import threading
import time
from collections import defaultdict
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message

from rlml_slam import se2
from rlml_slam.errors import MapError, RlmlError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.last_pose import LastPose
from rlml_slam.ros.back_end.map_folder import LOST_BYTES, MapFolder
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.back_end.user_requests import UserRequests
from rlml_slam.ros.codecs.reflector_clouds import read_reflector_map
from rlml_slam.ros.codecs.request_message import read_request
from rlml_slam.slam.conversation import GIVEN, SessionFrame
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Frame, Health, Level, Motion, Observation, Reflectors

SECOND = 1_000_000_000
ODOMETRY = np.array([100.0, 50.0, 1.0])
STILL = np.zeros(3)


class Publisher:
    """Keeps what is sent on a topic."""

    def __init__(self, topic, sent):
        self.topic_name = topic
        self.publish = sent[topic].append


class Ear:
    """Stands in for the node: keeps messages by topic and warnings."""

    def __init__(self):
        self.sent = defaultdict(list)
        self.warnings = []
        self.now = SECOND

    namespace = '/'

    def get_namespace(self):
        return self.namespace

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now))

    def create_publisher(self, kind, topic, depth):
        return Publisher(topic, self.sent)

    def get_logger(self):
        return SimpleNamespace(
            warning=self.warnings.append, info=lambda text: None, error=self.warnings.append
        )


@pytest.fixture
def ear():
    return Ear()


@pytest.fixture
def make(ear, monkeypatch, tmp_path_factory):
    """Makes mappers with parameters of the group Node, and ends them with the test."""
    monkeypatch.chdir(tmp_path_factory.mktemp('maps'))
    made = []

    def mapper(**node):
        p = Parameters()
        p = dataclasses.replace(p, node=dataclasses.replace(p.node, **node))
        made.append(Mapper(ear, p))
        made[-1].requests = UserRequests(made[-1], p, ear.get_logger())
        made[-1].requests.begin()
        made[-1].worker.submit(lambda: None).result()
        return made[-1]

    yield mapper
    for mapper in made:
        mapper.close()


@pytest.fixture
def mapper(make, ear, monkeypatch):
    mapper = make(transform_tolerance=0.0)  # each transform once, with the stamp of its frame
    transforms = ear.sent['transforms']
    monkeypatch.setattr(
        mapper.transform._publisher, 'publish', lambda *sent: transforms.append(sent)
    )
    mapper.transforms = transforms
    return mapper


def add(mapper, k, pose=(0.0, 0.0, 0.0), odometry=ODOMETRY, session=1, local=STILL, **more):
    """The k-th frame of a robot without sensors, whose local frame is at ``local``; its stamp."""
    stamp, cov = (k + 1) * SECOND // 10, 1e-4 * np.eye(3)
    observation = Observation(stamp, Motion(np.zeros(3), 1e-6 * np.eye(3)), odom_pose=odometry)
    T = np.array(pose)
    none = np.zeros(0, dtype=np.int64)
    frame = Frame(stamp, observation, T, cov, se2.compose(local, T), cov, none, none)
    mapper.add(SessionFrame(session, frame, mode=mode_of(mapper), **more))
    return stamp


def mode_of(mapper):
    """What a front end would carry out by now."""
    return mapper.system.mode


def searched(mapper):
    """Wait for everything that a frame caused."""
    for worker in (mapper.worker, mapper.searcher.worker, mapper.worker):
        worker.submit(lambda: None).result()


def give(mapper, k, **frame):
    """The same, used and sent before this returns."""
    stamp = add(mapper, k, **frame)
    searched(mapper)
    mapper.send_transform()
    return stamp


def test_scan_without_odometry_leaves_map_to_odom_where_it_was(mapper):
    give(mapper, 0)
    stamp = give(mapper, 1, odometry=None)
    (_, _, first), (sent, _, second) = mapper.transforms
    assert sent == stamp
    np.testing.assert_array_equal(second, first)


def test_new_session_waits_for_the_odometry_that_there_is(mapper):
    give(mapper, 0)
    give(mapper, 1, odometry=None, session=2)
    assert len(mapper.transforms) == 1
    give(mapper, 2, session=2)
    np.testing.assert_allclose(mapper.transforms[-1][2], mapper.transforms[0][2], atol=1e-12)


def test_without_any_odometry_odom_is_the_local_frame(mapper):
    give(mapper, 0, pose=(3.0, 2.0, 1.0), odometry=None)
    np.testing.assert_allclose(mapper.transforms[-1][2], np.zeros(3), atol=1e-12)


def test_map_to_odom_waits_for_no_job_of_the_worker(mapper):
    """It goes on with every frame, by the correction that the frame has."""
    give(mapper, 0)
    busy = Event()
    mapper.worker.submit(busy.wait)
    for k, local in ((1, STILL), (2, np.array([1.0, 0.0, 0.0]))):
        stamp = add(mapper, k, pose=(0.1 * k, 0.0, 0.0), local=local)
        assert mapper.transforms[-1][0] == stamp
        *_, T = mapper.transforms[-1]
        want = [0.1 * k + local[0], 0.0, 0.0]
        np.testing.assert_allclose(se2.compose(T, ODOMETRY), want, atol=1e-12)
    busy.set()


def test_interval_of_the_map_changes_at_run_time(make, monkeypatch):
    mapper = make(map_update_interval=600.0)
    stamp = give(mapper, 0)
    mapper.worker.submit(mapper.publish_map).result()
    monkeypatch.setattr(mapper.products, '_rested', 0.0)
    assert not mapper.products.is_due(stamp + 10 * SECOND)
    mapper._p.node.change('map_update_interval', 2.0)
    assert not mapper.products.is_due(stamp + SECOND)
    assert mapper.products.is_due(stamp + 2 * SECOND)


def test_correction_of_one_session_is_not_of_the_next(mapper):
    give(mapper, 0, local=np.array([1.0, 0.0, 0.0]))
    mapper.system.T_map_local = np.array([1.0, 0.0, 0.0])
    add(mapper, 1, pose=(0.5, 0.0, 0.0), session=2, request=GIVEN)
    *_, T = mapper.transforms[-1]
    np.testing.assert_allclose(se2.compose(T, ODOMETRY), [0.5, 0.0, 0.0], atol=1e-12)


def test_correction_that_moves_the_robot_is_told(mapper, ear):
    give(mapper, 0)
    give(mapper, 1)
    assert ear.sent['jumps'] == []
    stamp = give(mapper, 2, local=np.array([0.3, 0.0, 0.0]))
    (jump,) = ear.sent['jumps']
    assert jump.header.frame_id == 'base_link'
    assert jump.header.stamp.sec * SECOND + jump.header.stamp.nanosec == stamp
    assert jump.pose.pose.position.x == pytest.approx(0.3, abs=1e-9)


def test_transform_is_dated_ahead_and_repeated_for_a_second(make, ear, monkeypatch):
    mapper = make(transform_tolerance=0.5)
    sent = []
    monkeypatch.setattr(mapper.transform._publisher, 'publish', lambda *t: sent.append(t[0]))
    stamp = add(mapper, 0)
    assert sent == [stamp, stamp + SECOND // 2 - 1]
    ear.now += SECOND // 5
    mapper.send_transform()
    mapper.send_transform()  # no date twice
    assert sent[2:] == [stamp + 7 * SECOND // 10 - 1]
    ear.now += SECOND
    mapper.send_transform()  # the laser has failed: nobody may go on with that pose
    assert len(sent) == 3


def test_pause_stops_the_map_but_not_map_to_odom(mapper):
    used = []
    add = mapper.back_end.add
    mapper.back_end.add = lambda frame, found: (used.append(frame.stamp), add(frame, found))[1]
    first = give(mapper, 0)
    mapper.system.pause(True)
    moved = give(mapper, 1, pose=(1.0, 0.0, 0.0))
    assert used == [first]
    stamp, _, T = mapper.transforms[-1]
    assert stamp == moved
    np.testing.assert_allclose(se2.compose(T, ODOMETRY), [1.0, 0.0, 0.0], atol=1e-12)


def test_pause_before_the_first_frame_is_survived(mapper, ear):
    mapper.system.pause(True)
    give(mapper, 0)
    mapper.publish_map()
    assert len(mapper.transforms) == 1
    assert deserialize_message(ear.sent['trajectory'][-1], Path).poses == []


# --- saving ---------------------------------------------------------------------------------


def posts(n):
    covs = np.tile(1e-4 * np.eye(2), (n, 1, 1))
    ids, counts = np.full(n, -1), np.full(n, 9)
    points = np.arange(2.0 * n).reshape(n, 2)
    return Reflectors(np.arange(n), points, covs, ids, counts, np.full(n, np.nan))


def test_loaded_map_is_not_saved_but_a_new_one_after_it_is(make, tmp_path):
    folder = MapFolder(str(tmp_path))
    folder.save('old', SavedMap(posts(3)))
    mapper = make(mode='localization', map_directory=str(tmp_path), map_file_name='old')
    with pytest.raises(MapError, match='nothing to save'):
        mapper.requests.save('new')
    mapper.requests.localize(False)
    with pytest.raises(MapError, match='there is no map yet'):
        mapper.requests.save('new')
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.requests.save('new')
    assert len(folder.load('new').reflectors) == 5


def test_map_made_here_can_be_saved_while_it_is_localized_in(make, tmp_path):
    mapper = make(map_directory=str(tmp_path))
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.requests.localize(True)
    mapper.requests.save('new')
    assert len(MapFolder(str(tmp_path)).load('new').reflectors) == 5
    mapper.requests.load('new')
    with pytest.raises(MapError, match='nothing to save'):
        mapper.requests.save('again')


def drives(mapper, ks, **more):
    for k in ks:
        give(mapper, k, pose=(0.1 * k, 0.0, 0.0), **more)


def lost(folder):
    """Names and numbers of keyframes of the maps that were kept."""
    return {
        path.name: len(map_file.load(path).arrays['pose'])
        for path in sorted(folder.glob('*.lost-*'))
    }


def test_map_of_a_few_keyframes_is_not_kept(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path))
    for session in range(1, 5):
        drives(mapper, range(10 * session, 10 * session + 10), session=session)
    assert lost(tmp_path) == {}


def test_automatic_maps_displace_none_that_is_there(make, ear, tmp_path):
    old = [tmp_path / f'map.lost-{k}.rlml' for k in range(20)]
    for path in old:
        path.write_bytes(b'x')
    mapper = make(map_directory=str(tmp_path))
    drives(mapper, range(60))
    give(mapper, 61, session=2, request=GIVEN)
    assert all(path.read_bytes() == b'x' for path in old)
    assert len([*tmp_path.glob('*.lost-*')]) == 21


def test_map_is_kept_when_the_front_end_begins_anew(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path))
    drives(mapper, range(60))
    keys = len(mapper.back_end.keyframes)
    assert keys > 10
    give(mapper, 61, session=2, request=GIVEN)
    assert lost(tmp_path) == {'map.lost-5.rlml': keys}
    assert ear.warnings[-1].find('the map until now is kept: ') > 0
    # nothing is in the new map, and what is in a file already is not kept twice
    drives(mapper, range(62, 120), session=2, request=GIVEN)
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.requests.save('map')
    give(mapper, 120, session=3, request=GIVEN)
    assert len(lost(tmp_path)) == 1


def test_keyframes_are_counted_as_they_come(make, ear, tmp_path):
    """Sparsification removes as many as are added; they are in no file all the same."""
    mapper = make(map_directory=str(tmp_path))
    drives(mapper, range(60))
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.requests.save('map')
    keys = len(mapper.back_end.keyframes)
    drives(mapper, range(60, 120))
    del mapper.back_end.keyframes[1 : 1 - keys]
    assert len(mapper.back_end.keyframes) == keys
    written = []
    mapper.archive._write = lambda path, *_: written.append(path.name)
    assert mapper.archive.keep(mapper.back_end, None, 'a test')
    assert mapper.archive.autosave(mapper.back_end, None)
    assert [name.split('-')[0] for name in written] == ['map.lost', 'map.autosave']


def test_front_end_that_starts_again_is_not_in_the_map_until_it_is_found(mapper, ear, tmp_path):
    mapper.back_end.reflectors = lambda: posts(5)
    drives(mapper, range(60))
    keys, sent = len(mapper.back_end.keyframes), len(mapper.transforms)
    for k in range(61, 64):
        add(mapper, k, session=2)
        mapper.send_transform()
    searched(mapper)
    mapper.send_transform()
    assert len(mapper.transforms) == sent  # nobody knows where it is
    assert len(mapper.back_end.keyframes) == keys
    (problem,) = mapper.problems()
    assert problem.startswith('not yet in the map: ')
    assert [m.data for m in ear.sent['rlml/map_entry']][-1] == problem
    figures = mapper.figures()
    assert figures['map not entered'] in problem
    assert figures['map id'] == 'none: a map in the making'
    with pytest.raises(MapError, match='not yet in the map'):
        mapper.requests.localize(True)
    assert '5 reflectors' in mapper.requests.save('hall')
    assert len(mapper.back_end.keyframes) == keys


def test_map_that_cannot_be_kept_does_not_stop_the_next_one(make, ear, tmp_path):
    (tmp_path / 'file').touch()
    mapper = make(map_directory=str(tmp_path / 'file'))
    drives(mapper, range(60))
    give(mapper, 61, session=2, request=GIVEN)
    assert ear.warnings[-1].find('the map until now is not kept: ') > 0
    assert len(mapper.back_end.keyframes) == 1


def test_map_made_here_stays_whole_while_it_is_localized_in(make, ear, tmp_path):
    """The front end begins again in it, and the graph can be saved all the same."""
    mapper = make(map_directory=str(tmp_path))
    drives(mapper, range(60))
    keys, found = len(mapper.back_end.keyframes), mapper.back_end.reflectors
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.requests.localize(True)
    mapper.back_end.reflectors = found
    drives(mapper, range(60, 70), session=2, request=GIVEN)
    np.testing.assert_array_equal(mapper.system.T_map_local, np.zeros(3))
    mapper.requests.save('map')
    assert len(map_file.load(tmp_path / 'map.rlml').arrays['pose']) == keys
    with pytest.raises(MapError, match='does not change'):
        mapper.requests.revoke('0')
    mapper.requests.localize(False)
    assert mapper.back_end.keyframes == []
    assert lost(tmp_path) == {}  # it is in a file


def state_of(mapper, ear, folder):
    """Everything that a request may change."""
    system = mapper.system
    return (
        id(mapper.back_end), mapper.back_end.graph.poses.tobytes(), mapper.loaded, system.session,
        system.mode, id(system.map), system.entry, system.requests.pending, system.T_map_local
        .tobytes(), dict(system.searches._pending), system.recovery.is_active,
        {topic: len(sent) for topic, sent in ear.sent.items()}, mapper.archive.unsaved,
        {path.name: path.read_bytes() for path in folder.iterdir()},
    )  # fmt: skip


def no_space(*_):
    raise MapError('No space left on device')


FAILURES = {
    'save_map outside of the folder': (lambda r: r.save('../map'), 'not inside of'),
    'load_map of none': (lambda r: r.load('none'), 'none.rlml: cannot be read'),
    'load_map of a damaged file': (lambda r: r.load('bad'), 'bad.rlml'),
    'load_map outside of the folder': (lambda r: r.load('/etc/map'), 'not inside of'),
    'revoke_closure of no number': (lambda r: r.revoke('x'), 'is not the number'),
    'revoke_closure of none': (lambda r: r.revoke('7'), 'there is no loop closure 7'),
}


@pytest.mark.parametrize(('request_', 'why'), FAILURES.values(), ids=FAILURES)
def test_refused_request_leaves_everything_as_it_was(make, ear, tmp_path, request_, why):
    (tmp_path / 'bad.rlml').write_bytes(b'nonsense' * 20)
    mapper = make(map_directory=str(tmp_path), journal_period=0.0)
    drives(mapper, range(30))
    before = state_of(mapper, ear, tmp_path)
    with pytest.raises(RlmlError, match=why):
        request_(mapper.requests)
    assert state_of(mapper, ear, tmp_path) == before


def test_map_that_cannot_be_written_is_still_unsaved(make, ear, tmp_path, monkeypatch):
    mapper = make(map_directory=str(tmp_path), journal_period=0.0)
    drives(mapper, range(60))
    mapper.back_end.reflectors = lambda: posts(5)
    before = state_of(mapper, ear, tmp_path)
    monkeypatch.setattr('rlml_slam.ros.back_end.map_archive.map_container.write', no_space)
    with pytest.raises(MapError, match='No space left'):
        mapper.requests.save('map')
    # the reflectors fitted, and are there
    assert state_of(mapper, ear, tmp_path)[:-1] == before[:-1]
    assert [path.name for path in tmp_path.iterdir()] == ['map.csv']


def test_localization_without_a_map_and_a_search_that_finds_nothing_change_nothing(
    make, ear, tmp_path
):
    mapper = make(map_directory=str(tmp_path), journal_period=0.0)
    before = state_of(mapper, ear, tmp_path)
    with pytest.raises(MapError, match='there is no map yet'):
        mapper.requests.localize(True)
    assert mapper.requests.localize(False) == 'maps already'
    drives(mapper, range(30))
    before = state_of(mapper, ear, tmp_path)
    answer = mapper.requests.relocalize()
    searched(mapper)
    assert not answer.result().success
    assert state_of(mapper, ear, tmp_path) == before


# --- a grid that is too large ---------------------------------------------------------------


def test_map_without_the_grid_that_cannot_be_drawn(make, ear, tmp_path):
    """A pose that is kilometres off spreads the grid; all else of the map goes on."""
    small = OccupancyGrid(0.05, (0.0, 0.0), np.zeros((2, 2), dtype=np.int8))
    MapFolder(str(tmp_path)).save('map', SavedMap(posts(3), small))
    mapper = make(map_directory=str(tmp_path))
    give(mapper, 0)
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.back_end.occupancy_grid = too_large
    for k in range(1, 40):
        give(mapper, k)
    mapper.publish_map()
    assert ear.sent['map'] == []
    assert len(read_reflector_map(ear.sent['reflector_map_points'][-1])) == 5
    assert mapper.current().grid is None
    answer = mapper.requests.relocalize()
    searched(mapper)
    assert not answer.result().success
    assert answer.result().text.startswith('not found: ')
    assert 'no grid: map of 9 x 9 cells' in mapper.requests.save('map')
    saved = MapFolder(str(tmp_path)).load('map')  # nothing of the older one
    assert (len(saved.reflectors), saved.grid) == (5, None)
    whole = map_file.saved_map(map_file.load(tmp_path / 'map.rlml'))
    assert (len(whole.reflectors), whole.grid) == (5, None)
    assert [w for w in ear.warnings if 'no grid' in w] == ['no grid: map of 9 x 9 cells']


def too_large():
    raise MapError('map of 9 x 9 cells')


# --- the last pose ----------------------------------------------------------------------------

STARS = np.array([[-3.6, -2.7], [3.4, -2.9], [3.8, 1.1], [-0.7, 2.6], [-3.9, 1.9], [1.5, -2.4]])
HERE = np.array([0.8, 0.5, 1.1])


def sees(mapper, k, pose, level=Level.OK):
    """The k-th frame of a robot that sees STARS from a pose, and believes to be there."""
    stamp, cov, n = (k + 1) * SECOND, 1e-4 * np.eye(3), len(STARS)
    points = se2.transform(se2.inverse(pose), STARS)
    detections = Detections(
        stamp, 'base_link', points, np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, -1),
        np.full(n, np.nan),
    )  # fmt: skip
    observation = Observation(
        stamp, Motion(np.zeros(3), cov), detections=detections, odom_pose=ODOMETRY
    )
    used = np.arange(n)
    frame = Frame(
        stamp, observation, pose, cov, pose, cov, used, np.zeros(n, dtype=np.int64),
        Health(level, ()),
    )  # fmt: skip
    mode = mode_of(mapper)
    mapper.add(SessionFrame(1, frame, mode, mode))
    searched(mapper)


@pytest.fixture
def switched_off(make, tmp_path):
    """A folder with a map of STARS in which a robot was at HERE when it was switched off."""
    stars = dataclasses.replace(posts(len(STARS)), points=STARS)
    MapFolder(str(tmp_path)).save('map', SavedMap(stars))
    mapper = make(mode='localization', map_directory=str(tmp_path))
    sees(mapper, 0, np.zeros(3))
    sees(mapper, 1, HERE)
    return tmp_path


def poses_given(ear):
    return [read_request(m).pose[:2] for m in ear.sent['rlml/session_start']]


def test_robot_starts_where_it_was_switched_off(make, ear, switched_off):
    assert poses_given(ear) == []
    mapper = make(mode='localization', map_directory=str(switched_off))
    sees(mapper, 0, HERE, Level.DEGRADED)
    np.testing.assert_allclose(poses_given(ear), [HERE[:2]], atol=0.02)
    sees(mapper, 1, HERE)
    assert len(poses_given(ear)) == 1


def test_robot_that_was_moved_while_it_was_off_does_not(make, ear, switched_off):
    mapper = make(mode='localization', map_directory=str(switched_off))
    sees(mapper, 0, np.array([-1.5, 0.5, -2.0]), Level.DEGRADED)
    assert poses_given(ear) == []
    assert 'is not restored: the robot is rather at x = -1.5' in ear.warnings[-1]


def test_robots_of_one_map_have_a_last_pose_each(make, ear, switched_off):
    ear.namespace = '/hall/r2'
    mapper = make(map_directory=str(switched_off), mode='localization', restore_pose=True)
    assert mapper.last_pose is not None
    assert mapper.last_pose._path == switched_off / 'map.hall.r2.pose'


def test_last_pose_that_is_damaged_or_not_wanted_is_left(make, ear, switched_off):
    mapper = make(mode='localization', map_directory=str(switched_off), restore_pose=False)
    sees(mapper, 0, HERE, Level.DEGRADED)
    (switched_off / 'map.pose').write_text('{')
    mapper = make(mode='localization', map_directory=str(switched_off))
    sees(mapper, 0, HERE, Level.DEGRADED)
    sees(mapper, 1, HERE)
    assert poses_given(ear) == []
    assert 'map.pose: no pose' in ear.warnings[-1]
    assert LastPose(switched_off / 'map.pose').read() is not None  # a new one is kept


# --- a survey -------------------------------------------------------------------------------


def test_survey_is_taken_from_the_map_directory_alone(ear, tmp_path):
    (tmp_path / 'maps').mkdir()
    for folder in (tmp_path, tmp_path / 'maps'):
        (folder / 'plant.csv').write_text('x,y\n1,2\n')
    p = Parameters()
    node = dataclasses.replace(p.node, map_directory=str(tmp_path / 'maps'))
    for name, why in (('none.csv', 'cannot be read'), ('../plant.csv', 'not inside of')):
        back_end = dataclasses.replace(p.back_end, survey=name)
        with pytest.raises(MapError, match=why):
            Mapper(ear, dataclasses.replace(p, node=node, back_end=back_end))
    back_end = dataclasses.replace(p.back_end, survey='plant.csv')
    mapper = Mapper(ear, dataclasses.replace(p, node=node, back_end=back_end))
    mapper.close()
    np.testing.assert_array_equal(mapper.back_end.survey_frame.survey.points, [[1.0, 2.0]])


def journals(folder):
    return sorted(folder.glob('*.journal-*'))


def killed(mapper):
    """As if the process was killed: nothing is saved, and its locks are free."""
    mapper.searcher.close()
    mapper.worker.close()
    mapper.journal._file.close()
    mapper._ended = True


def test_end_of_the_node_saves_what_is_in_no_file(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    assert len(journals(tmp_path)) == 1
    keys = len(mapper.back_end.keyframes)
    mapper.close()
    (saved,) = tmp_path.glob('map.autosave-*.rlml')
    assert len(map_file.load(saved).arrays['pose']) == keys
    assert f'the node ends: the map until now is kept: {saved}' in ear.warnings
    assert journals(tmp_path) == []
    mapper.close()
    assert len([*tmp_path.glob('map.autosave-*')]) == 1


def test_end_of_the_node_saves_nothing_twice(make, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    mapper.back_end.reflectors = lambda: posts(5)
    mapper.requests.save('map')
    mapper.close()
    assert [p for p in tmp_path.iterdir() if 'autosave' in p.name or 'journal' in p.name] == []


def test_pause_is_named_where_nothing_is_mapped(make, tmp_path):
    mapper = make(map_directory=str(tmp_path))
    mapper.execute(mapper.system.pause(True))
    drives(mapper, range(3))
    with pytest.raises(MapError, match='no map yet: new measurements are left out'):
        mapper.requests.save('map')
    mapper.execute(mapper.system.localize_in(SavedMap(posts(5))))
    assert 'left out' in mapper.requests.localize(False)
    mapper.execute(mapper.system.pause(False))
    mapper.execute(mapper.system.localize_in(SavedMap(posts(5))))
    assert 'left out' not in mapper.requests.localize(False)


def test_map_of_a_killed_process_is_recovered(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    poses = mapper.back_end.graph.poses.copy()
    killed(mapper)
    (left,) = journals(tmp_path)
    again = make(map_directory=str(tmp_path))
    searched(again)
    (saved,) = tmp_path.glob('map.autosave-*.rlml')
    assert any(str(left) in w and 'without saving its map' in w for w in ear.warnings)
    assert f'recovered: {len(poses)} keyframes in {saved}' in ear.warnings
    assert np.array_equal(map_file.load(saved).arrays['pose'], poses)
    assert not left.exists()
    assert again.system.entry is None


@pytest.mark.parametrize('clock', [0.0, -3600.0], ids=['clock goes on', 'clock was set back'])
def test_continued_map_is_the_recovered_one(make, ear, tmp_path, clock):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    mapper.back_end.reflectors = lambda: posts(5)
    drives(mapper, range(30))
    mapper.requests.save('map')
    saved = (tmp_path / 'map.rlml').stat().st_mtime - clock
    os.utime(tmp_path / 'map.rlml', (saved, saved))
    drives(mapper, range(30, 60))
    keys = len(mapper.back_end.keyframes)
    killed(mapper)
    again = make(map_directory=str(tmp_path), continue_map=True)
    assert len(again.back_end.keyframes) == keys, ear.warnings


def test_journal_of_a_running_process_is_left_alone(make, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    other = make(map_directory=str(tmp_path), continue_map=True)
    assert len(journals(tmp_path)) == 1
    assert other.back_end.keyframes == []


def test_journal_that_cannot_be_written_is_reported_once(make, ear, tmp_path):
    (tmp_path / 'file').touch()
    mapper = make(map_directory=str(tmp_path / 'file'), journal_period=1e-3)
    drives(mapper, range(60))
    assert len(mapper.back_end.keyframes) > 10
    assert [w for w in ear.warnings if 'journal' in w] == [
        f'{tmp_path}/file/map.journal-… cannot be written: File exists; '
        'if the process is killed now, this map is lost'
    ]
    assert 'File exists' in mapper.problems()[0]


def test_journal_begins_again_with_another_map(make, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    drives(mapper, range(62, 120), session=2, request=GIVEN)
    keys = len(mapper.back_end.keyframes)
    mapper.journal.flush()  # the last frame may have come within its period
    killed(mapper)
    searched(make(map_directory=str(tmp_path)))
    (saved,) = tmp_path.glob('map.autosave-*.rlml')
    assert len(map_file.load(saved).arrays['pose']) == keys


def test_slow_robot_loses_no_more_than_a_fast_one(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(8))
    keys = len(mapper.back_end.keyframes)
    assert keys < 5
    killed(mapper)
    searched(make(map_directory=str(tmp_path)))
    (saved,) = tmp_path.glob('map.autosave-*.rlml')
    assert len(map_file.load(saved).arrays['pose']) == keys


@contextlib.contextmanager
def no_file_larger_than(size):
    """As on a full disk: a file that grows beyond so many bytes cannot be written."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_is_reported_and_what_was_written_is_recovered(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    (left,) = journals(tmp_path)
    with no_file_larger_than(left.stat().st_size + 100):
        drives(mapper, range(60, 120))
        assert 'File too large' in mapper.problems()[0]
        keys = len(mapper.back_end.keyframes)
        with contextlib.suppress(OSError):  # of what could not be written
            killed(mapper)
        mapper._ended = True
    again = make(map_directory=str(tmp_path))
    searched(again)
    assert again.problems() == ()
    (saved,) = tmp_path.glob('map.autosave-*.rlml')
    assert 10 < len(map_file.load(saved).arrays['pose']) < keys


def test_journal_goes_on_once_the_map_was_saved(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    mapper.back_end.reflectors = lambda: posts(5)
    drives(mapper, range(60))
    (left,) = journals(tmp_path)
    with no_file_larger_than(left.stat().st_size + 100):
        drives(mapper, range(60, 90))
    assert 'File too large' in mapper.problems()[0]
    mapper.requests.save('map')
    assert mapper.problems() == ()
    drives(mapper, range(90, 120))
    poses = mapper.back_end.graph.poses.copy()
    killed(mapper)
    again = make(map_directory=str(tmp_path), continue_map=True)
    np.testing.assert_allclose(again.back_end.graph.poses, poses, atol=1e-6)


def test_journal_that_was_removed_is_reported(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path / 'maps'), journal_period=1e-3)
    mapper.back_end.reflectors = lambda: posts(5)
    drives(mapper, range(60))
    shutil.rmtree(tmp_path / 'maps')
    drives(mapper, range(60, 90))
    assert 'was removed: save the map' in mapper.problems()[0]
    mapper.requests.save('map')
    drives(mapper, range(90, 100))
    assert mapper.problems() == ()
    assert len(journals(tmp_path / 'maps')) == 1


@pytest.mark.parametrize('name', ['a\nb', 'map.autosave-5', 'x.journal-1', 'map.lost-7.rlml'])
def test_names_that_no_map_should_have_are_refused(make, tmp_path, name):
    mapper = make(map_directory=str(tmp_path))
    mapper.back_end.reflectors = lambda: posts(5)
    drives(mapper, range(30))
    with pytest.raises(MapError, match=r'is a name of automatic files|is no name of a file'):
        mapper.requests.save(name)


def test_journals_count_as_automatic_files(make, ear, tmp_path):
    with (tmp_path / 'map.journal-1.damaged').open('wb') as file:
        file.truncate(LOST_BYTES + 1)  # sparse
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    assert 'remove those that are not needed' in mapper.problems()[0]


def test_recovery_that_is_interrupted_is_left_to_the_next_start(make, ear, tmp_path):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    killed(mapper)
    other = make(map_directory=str(tmp_path / 'other'))
    other.journal._folder = mapper.archive.folder
    other.journal.ends = True
    other.journal.recover()
    assert any('left for the next start' in w for w in ear.warnings)
    assert len(journals(tmp_path)) == 1
    searched(make(map_directory=str(tmp_path)))
    assert len([*tmp_path.glob('map.autosave-*.rlml')]) == 1


def test_map_is_saved_before_a_search_has_ended(make, tmp_path):
    mapper = make(map_directory=str(tmp_path))
    drives(mapper, range(60))
    goes_on = threading.Event()
    mapper.searcher.worker.submit(goes_on.wait)
    end = threading.Thread(target=mapper.close)
    end.start()
    deadline = time.monotonic() + 20.0
    while not [*tmp_path.glob('map.autosave-*.rlml')] and time.monotonic() < deadline:
        time.sleep(0.01)
    saved = [*tmp_path.glob('map.autosave-*.rlml')]
    goes_on.set()
    end.join()
    assert len(saved) == 1


def test_damaged_journal_is_kept_under_another_name(make, ear, tmp_path):
    (tmp_path / 'map.journal-1').write_bytes(b'nonsense' * 20)
    searched(make(map_directory=str(tmp_path)))
    assert (tmp_path / 'map.journal-1.damaged').exists()
    assert any('no map can be made of it' in w for w in ear.warnings)


@pytest.mark.parametrize('continues', [False, True])
def test_journal_whose_map_has_no_name_is_left_and_the_node_starts(make, ear, tmp_path, continues):
    name = 'n' * 185  # that of the autosave would be too long
    mapper = make(map_directory=str(tmp_path), map_file_name=name, journal_period=1e-3)
    drives(mapper, range(60))
    killed(mapper)
    searched(make(map_directory=str(tmp_path), map_file_name=name, continue_map=continues))
    assert len(journals(tmp_path)) == 1
    assert any('left for the next start' in w and 'no name of a file' in w for w in ear.warnings)


def test_journal_that_vanishes_does_not_stop_the_others(make, ear, tmp_path, monkeypatch):
    mapper = make(map_directory=str(tmp_path), journal_period=1e-3)
    drives(mapper, range(60))
    killed(mapper)
    other = make(map_directory=str(tmp_path / 'other'))
    other.journal._folder = mapper.archive.folder
    left = [tmp_path / 'map.journal-0-1', *journals(tmp_path)]
    monkeypatch.setattr(other.journal, '_left', lambda: left)
    assert other.journal.recover() in tmp_path.glob('map.autosave-*.rlml')
    assert f'{left[0]}: not recovered: No such file or directory' in ear.warnings


def test_journal_that_is_being_opened_is_left_alone(make, ear, tmp_path):
    """Between its name and its lock it is empty."""
    (tmp_path / 'map.journal-1-1').touch()
    searched(make(map_directory=str(tmp_path)))
    assert [path.name for path in tmp_path.iterdir()] == ['map.journal-1-1']
    assert ear.warnings == []
