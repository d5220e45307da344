# SPDX-License-Identifier: Apache-2.0
"""The live back end goes on with a saved map: place, keys, and what may go wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from made_worlds import ROOM, drive, errors, messages, observations
from test_mapper import Ear

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps import reflector_file
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.map_folder import MapFolder
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.codecs.belief_message import read_belief
from rlml_slam.ros.codecs.decode import pose_estimate
from rlml_slam.ros.codecs.frame_messages import Record
from rlml_slam.slam.front_end.front_end import FrontEnd
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
        return made[-1], ear

    yield mapper
    for mapper in made:
        mapper.worker.close()


class Front:
    """A front end that does what the back end tells it, as the node does."""

    def __init__(self, mapper, ear, pose=(0.0, 0.0, 0.0)):
        self.mapper, self.ear, self.session = mapper, ear, 1
        self.front_end = FrontEnd(PARAMS)
        self.front_end.reset(np.array(pose), np.zeros((3, 3)))
        self.frames = []

    def process(self, observation):
        frame = self.front_end.process(observation)
        self.frames.append(frame)
        self.mapper.add(Record(self.session, frame, True, True))
        self.mapper.worker.submit(lambda: None).result()
        told = self.ear.sent['initialpose']
        if told:
            found = pose_estimate(told.pop(), 'initialpose')
            self.front_end.reset(found.pose, found.cov)
            self.session += 1
            self.ear.sent['belief'].clear()
        for msg in self.ear.sent['belief']:
            said = read_belief(msg)
            self.front_end.correct(said.T_map_local)
            self.front_end.forget(said.belief.removed)
            if said.stamp == self.front_end.newest and self.front_end.contradicts(said.belief):
                self.front_end.adopt(said.belief)
        self.ear.sent['belief'].clear()


def drive_on(mapper, ear):
    front = Front(mapper, ear)
    for o in observations(ROOM, AGAIN, rng=np.random.default_rng(1)):
        front.process(o)
    mapper.worker.submit(mapper.back_end.finish).result()
    return front


def test_mapping_goes_on_where_the_robot_is_found(mapped, make):
    mapper, ear = make(continue_map=True)
    assert mapper.continued
    before = len(mapper.back_end.keyframes)
    front = drive_on(mapper, ear)
    assert front.session == 2
    assert mapper.continued == {}
    assert len(mapper.back_end.keyframes) > before + 5
    found = mapper.back_end.reflectors()
    # none twice, under the keys that they had
    np.testing.assert_array_equal(found.keys, mapped.reflectors().keys)
    gap = np.linalg.norm(found.points[:, None] - ROOM.reflectors, axis=-1)
    assert gap.min(axis=1).max() < 0.03
    late = np.array([f.T_map_base for f in front.frames[10:]])
    assert errors(late, AGAIN[10:])[0].max() < 0.06


def test_belief_names_reflectors_as_the_session_does(mapped, make):
    mapper, ear = make(continue_map=True)
    drive_on(mapper, ear)
    belief = mapper.back_end.belief()
    told = mapper._continued.to_session(belief)
    assert len(set(told.keys.tolist())) == len(belief.keys)
    first = mapped.reflector_graph.next_key
    for key, other in zip(belief.keys.tolist(), told.keys.tolist(), strict=True):
        if other >= 0:
            assert mapper.back_end.reflector_graph.resolve(other + first) == key
    assert (told.keys >= 0).sum() >= 3  # those that were seen in this session


def test_load_map_goes_on_while_mapping(make):
    mapper, ear = make()
    mapper.load('map')
    assert mapper.continued
    drive_on(mapper, ear)
    assert mapper.continued == {}


def test_nothing_is_mapped_until_the_place_is_known(make):
    mapper, ear = make(continue_map=True)
    before = len(mapper.back_end.keyframes)
    front = Front(mapper, ear)
    for o in observations(ROOM, AGAIN[:30], scan=False, reflectors=False):
        front.process(o)
    assert len(mapper.back_end.keyframes) == before
    assert ear.sent['initialpose'] == []
    mapper.send_transform()
    assert ear.sent['/tf'] == ear.sent['~/map_to_odom'] == []
    # a restart that nobody told a place for is no entrance
    front.session += 1
    for o in observations(ROOM, AGAIN[:30], scan=False, reflectors=False):
        front.process(o)
    assert mapper.continued


def test_place_that_a_person_tells_is_taken_where_the_scan_fits(make):
    for pose, enters in ((AGAIN[0], True), (AGAIN[0] + [1.5, 1.0, 1.0], False)):
        mapper, ear = make(continue_map=True)
        front = Front(mapper, ear, pose)
        mapper._continued._look = lambda frame: None  # no place is found
        seen = observations(ROOM, AGAIN[:5], reflectors=False)
        front.process(seen[0])
        assert mapper.continued
        front.session += 1
        front.process(seen[1])
        assert (mapper.continued == {}) == enters


def test_first_run_without_a_map_begins_one(make):
    mapper, ear = make(continue_map=True, map_file_name='other')
    assert mapper.continued == {}
    assert 'other.rlml is not there to go on with' in ear.warnings[-1]
    with pytest.raises(MapError, match='cannot be read'):
        mapper.load('other')


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
        mapper.load('map')
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
