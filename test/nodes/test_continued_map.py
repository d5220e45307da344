# SPDX-License-Identifier: Apache-2.0
"""The live back end goes on with a saved map: place, keys, and what may go wrong."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest
from made_worlds import ROOM, drive, errors, messages, observations
from test_mapper import Ear, journals, killed, searched

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps import reflector_file
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.map_folder import AUTOSAVE, LOST, LOST_AGE, MapFolder
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.back_end.user_requests import UserRequests
from rlml_slam.ros.codecs.correction_message import read_correction
from rlml_slam.ros.codecs.request_message import read_request
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.loop_closure import State
from rlml_slam.slam.conversation import RESTARTED
from rlml_slam.slam.front_end_session import FrontEndSession
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Odometry, Scan

PARAMS = Parameters()
CURVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 4.0), (0.5, -0.7, 2.0))
AGAIN = drive((0.4, 0.4, 6.0), (0.5, -0.5, 3.0), start=(0.6, -1.2, 0.4))


@pytest.fixture(scope='module')
def mapped():
    slam = Slam(PARAMS)
    slam.set_sensor_pose('laser', np.zeros(3))
    add = {Odometry: slam.add_odometry, Scan: slam.add_scan, Detections: slam.add_detections}
    for m in messages(ROOM, CURVE, rng=np.random.default_rng(0)):
        add[type(m)](m)
    slam.finish()
    return slam.back_end


@pytest.fixture
def folder(mapped, tmp_path):
    map_file.save(tmp_path / 'map.rlml', mapped, PARAMS)
    return tmp_path


@pytest.fixture
def make(folder):
    made = []

    def mapper(**node):
        values = {'map_directory': str(folder), **node}
        p = dataclasses.replace(PARAMS, node=dataclasses.replace(PARAMS.node, **values))
        ear = Ear()
        made.append(Mapper(ear, p))
        made[-1].requests = UserRequests(made[-1], p, ear.get_logger())
        made[-1].requests.begin()
        searched(made[-1])
        return made[-1], ear

    yield mapper
    for mapper in made:
        mapper.close()


class Front:
    """A front end that carries out the back end's messages, as the node does."""

    def __init__(self, mapper, ear):
        self.mapper, self.ear = mapper, ear
        self.session = FrontEndSession(PARAMS)
        self.frames, self.begun = [], 1

    def process(self, observation):
        record = self.session.process(observation)
        self.frames.append(record.frame)
        self.mapper.add(record)
        searched(self.mapper)
        for topic, read in (
            ('rlml/session_start', read_request),
            ('rlml/graph_correction', read_correction),
        ):
            before = self.session.session
            for msg in self.ear.sent[topic]:
                self.session.execute(read(msg))
            self.begun += self.session.session != before
            self.ear.sent[topic].clear()


def entering(mapper):
    return mapper.system.entry is not None


def drive_on(mapper, ear):
    front = Front(mapper, ear)
    for o in observations(ROOM, AGAIN, rng=np.random.default_rng(1)):
        front.process(o)
    mapper.worker.submit(mapper.back_end.finish).result()
    return front


def test_mapping_goes_on_where_the_robot_is_found(mapped, make):
    mapper, ear = make(continue_map=True)
    assert entering(mapper)
    assert 'not yet in the saved map' in mapper.problems()[0]
    before = len(mapper.back_end.keyframes)
    front = drive_on(mapper, ear)
    assert mapper.problems() == ()
    assert front.begun == 2
    assert not entering(mapper)
    assert len(mapper.back_end.keyframes) > before + 5
    found = mapper.back_end.reflectors()
    # none twice, under the keys that they had
    np.testing.assert_array_equal(found.keys, mapped.reflectors().keys)
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors, axis=-1)
    assert gap.min(axis=1).max() < 0.03
    late = np.array([f.T_map_base for f in front.frames[10:]])
    assert errors(late, AGAIN[10:])[0].max() < 0.06


def test_keys_of_the_session_are_none_of_the_map(mapped, make):
    mapper, ear = make(continue_map=True)
    front = drive_on(mapper, ear)
    first = mapped.reflector_graph.next_key
    seen = np.concatenate([f.landmarks for f in front.frames[5:]])
    aliases = mapper.back_end.belief().aliases
    assert {aliases.get(key, key) for key in seen[seen >= 0].tolist()} <= {
        *mapped.reflectors().keys.tolist()
    }
    assert min(aliases) >= first


def test_load_map_goes_on_while_mapping(make):
    mapper, ear = make()
    mapper.worker.submit(lambda: mapper.requests.load('map')).result()
    assert entering(mapper)
    drive_on(mapper, ear)
    assert not entering(mapper)


def test_nothing_is_mapped_until_the_place_is_known(make):
    mapper, ear = make(continue_map=True)
    before = len(mapper.back_end.keyframes)
    front = Front(mapper, ear)
    for o in observations(ROOM, AGAIN[:30], scan=False, reflectors=False):
        front.process(o)
    assert len(mapper.back_end.keyframes) == before
    assert front.begun == 1
    mapper.send_transform()
    assert ear.sent['/tf'] == ear.sent['~/map_to_odom'] == []
    # a restart is no entrance, even where the scan would fit at the pose it begins with
    front.session.start_at(0, AGAIN[0], np.zeros((3, 3)))
    front.session.request = RESTARTED
    mapper.searcher._p = dataclasses.replace(  # nor does a search find a place
        PARAMS, loop_closure=dataclasses.replace(PARAMS.loop_closure, min_score=1.0)
    )
    for o in observations(ROOM, AGAIN[:1], reflectors=False):
        front.process(o)
    assert entering(mapper)
    assert front.begun == 1


def test_pose_given_by_a_user_is_taken_where_the_scan_fits(make):
    for pose, enters in ((AGAIN[0], True), (AGAIN[0] + [1.5, 1.0, 1.0], False)):
        mapper, ear = make(continue_map=True)
        front = Front(mapper, ear)
        front.session.start_at(0, pose, 1e-4 * np.eye(3))
        seen = observations(ROOM, AGAIN[:5], reflectors=False)
        for o in seen:
            front.process(o)
        assert entering(mapper) != enters
        assert (front.begun == 2) == enters


def test_first_run_without_a_map_begins_one(make):
    mapper, ear = make(continue_map=True, map_file_name='other')
    assert not entering(mapper)
    assert any('other.rlml does not exist' in text for text in ear.warnings)
    with pytest.raises(MapError, match='cannot be read'):
        mapper.requests.load('other')


def test_damaged_map_is_refused_and_the_one_in_the_making_kept(make, folder):
    path = folder / 'map.rlml'
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    mapper, ear = make()
    front = Front(mapper, ear)
    for o in observations(ROOM, CURVE[:30], rng=np.random.default_rng(2)):
        front.process(o)
    before = len(mapper.back_end.keyframes)
    path.write_bytes(bytes(data))
    with pytest.raises(FileFormatError, match='damaged'):
        mapper.requests.load('map')
    assert len(mapper.back_end.keyframes) == before
    with pytest.raises(FileFormatError, match='damaged'):
        make(continue_map=True)
    with pytest.raises(FileFormatError, match='damaged'):
        make(mode='localization')


def test_folder_prefers_the_whole_map_unless_told(folder, mapped):
    found = mapped.reflectors()
    few = dataclasses.replace(
        found, **{f.name: getattr(found, f.name)[:2] for f in dataclasses.fields(found)}
    )
    reflector_file.save(few, folder / 'map.csv')
    maps = MapFolder(str(folder))
    assert len(maps.load('map').reflectors) == len(maps.load('map.rlml').reflectors) == len(found)
    assert len(maps.load('map.csv').reflectors) == 2


# --- files of a map that is continued -----------------------------------------------------------


def automatic(folder, kind):
    return sorted(folder.glob(f'map{kind}*.rlml'))


def test_autosave_that_is_the_only_map_stays_whatever_its_age(make, folder):
    """Not where the journal begins, nor at an end without a new keyframe."""
    only = folder / 'map.autosave-1.rlml'
    (folder / 'map.rlml').rename(only)
    old = only.stat().st_mtime - LOST_AGE - 1000.0
    os.utime(only, (old, old))
    older = folder / 'map.lost-1.rlml'
    older.touch()
    os.utime(older, (old, old))
    mapper, ear = make(continue_map=True, journal_period=1e-3)
    mapper.worker.submit(mapper.journal.flush).result()
    assert len(journals(folder)) == 1
    assert f'an old map is removed: {older}' in ear.warnings
    mapper.close()
    assert [*folder.iterdir()] == [only]


@pytest.mark.parametrize(
    ('begins', 'frames', 'wins'), [(False, 8, False), (True, 1, True), (False, 60, True)]
)
def test_few_recovered_keyframes_do_not_displace_a_map(make, mapped, folder, begins, frames, wins):
    """At this start and at the next. A journal that continues the map has all of it, and wins."""
    mapper, ear = make(continue_map=begins, journal_period=1e-3)
    front = Front(mapper, ear)
    for o in list(observations(ROOM, CURVE, rng=np.random.default_rng(1)))[:frames]:
        front.process(o)
    mapper.worker.submit(mapper.journal.flush).result()
    keys = len(mapper.back_end.keyframes)
    killed(mapper)
    for _ in range(2):
        mapper, ear = make(continue_map=True)
        assert len(mapper.back_end.keyframes) == (keys if wins else len(mapped.keyframes))
        mapper.close()
        (recovered,) = automatic(folder, AUTOSAVE if wins else LOST)
        assert len(map_file.load(recovered).arrays['pose']) == keys
    assert journals(folder) == []


def test_few_recovered_keyframes_are_better_than_nothing(make, folder):
    (folder / 'map.rlml').unlink()
    mapper, ear = make(journal_period=1e-3)
    front = Front(mapper, ear)
    for o in list(observations(ROOM, CURVE, rng=np.random.default_rng(1)))[:8]:
        front.process(o)
    mapper.worker.submit(mapper.journal.flush).result()
    keys = len(mapper.back_end.keyframes)
    killed(mapper)
    mapper, _ = make(continue_map=True)
    assert 0 < len(mapper.back_end.keyframes) == keys < 10


@pytest.fixture
def looped(make, folder):
    """A mapper with a loop closure, all of whose map is in a file; the number of the closure."""
    mapper, ear = make(journal_period=1e-3)
    front = Front(mapper, ear)
    laps = drive((0.6, 0.6, 10.5), (0.6, 0.6, 10.5))
    for o in observations(ROOM, laps, rng=np.random.default_rng(1)):
        front.process(o)
    mapper.worker.submit(lambda: mapper.requests.save('map')).result()
    return mapper, mapper.back_end.loop_closer.records.accepted()[0].number


def state_in(path, number):
    back_end = BackEnd(PARAMS)
    map_file.restore(map_file.load(path), back_end)
    return back_end.loop_closer.records.accepted(number)[0].status.state


def test_revocation_after_the_map_was_saved_is_saved_at_the_end(looped, folder):
    mapper, number = looped
    mapper.worker.submit(lambda: mapper.requests.revoke(str(number))).result()
    mapper.close()
    assert state_in(folder / 'map.rlml', number) is not State.REVOKED
    (saved,) = automatic(folder, AUTOSAVE)
    assert state_in(saved, number) is State.REVOKED


def test_revocation_survives_a_kill(looped, make, folder):
    mapper, number = looped
    mapper.worker.submit(lambda: mapper.requests.revoke(str(number))).result()
    poses = mapper.back_end.graph.poses.copy()
    killed(mapper)
    make(continue_map=True)
    (saved,) = automatic(folder, AUTOSAVE)
    assert state_in(saved, number) is State.REVOKED
    np.testing.assert_array_equal(map_file.load(saved).arrays['pose'], poses)
