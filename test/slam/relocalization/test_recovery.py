# SPDX-License-Identifier: Apache-2.0
"""How often a lost robot is looked for in the map."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_worlds import ROOM, drive, observations

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Parameters
from rlml_slam.slam.conversation import ANY, Relocate, SessionFrame, StartSession
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.mapped_frames import MappedFrames
from rlml_slam.slam.relocalization.recovery import Recovery
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.slam.requests import Requests
from rlml_slam.slam.search_area import search_area
from rlml_slam.slam.searches import Purpose
from rlml_slam.slam.system import System
from rlml_slam.types import Health, Level, Reflectors, Status, Verdict

SECOND = 1_000_000_000
UNSURE = np.eye(3)  # within metres


def searched(lasts, pose, period=SECOND // 10):
    """Seconds since it was lost at which a robot is searched."""
    at = []
    recovery, health = Recovery(Parameters()), Health(Level.LOST, ())
    for stamp in range(0, lasts * SECOND, period):
        frame = SimpleNamespace(
            stamp=SECOND + stamp, health=health, unconfirmed=False, T_map_base=pose(stamp / SECOND)
        )
        recovery.follow(frame)
        if recovery.is_due(frame):
            at.append(stamp / SECOND)
    return at


def test_robot_that_stands_is_looked_for_rarely_and_at_once_where_it_comes():
    at = searched(120, lambda t: np.array([max(t - 100.0, 0.0), 0.0, 0.0]))
    assert 20 < sum(t < 100.0 for t in at) < 60
    # a metre a second: looked for as soon as it has gone one, and then ever more rarely
    after = [t for t in at if t >= 100.0]
    assert after[0] <= 101.2
    assert 10 < len(after) < 15


def drove_unseen(there=(0.0, 0.0, 0.0), cov=UNSURE, **changes):
    given = {
        'stamp': SECOND, 'T_map_base': np.array(there), 'T_local_base': np.ones(3),
        'cov_map': cov, 'unconfirmed': False, 'scan_used': False,
        'scan_score': float('nan'), 'statuses': np.zeros(0, dtype=int),
        'observation': SimpleNamespace(points=np.zeros((50, 2))),
    }  # fmt: skip
    return SimpleNamespace(**{**given, **changes})


def test_robot_that_matches_its_map_is_where_odometry_led_and_others_anywhere():
    there, cov = np.array([3.0, -2.0, 3.0]), np.diag([1.0, 0.2, 0.3]) ** 2
    matched = {'statuses': np.array([Status.NEW, Status.USED])}
    unmatched = {'statuses': np.array([Status.NEW])}
    for tracks in ({}, {'scan_used': True, 'scan_score': 0.6}, matched):
        area = search_area(drove_unseen(there, cov, **tracks))
        assert area is not None
        for off, fits in (
            ([3.0, 0.0, 0.0], True), ([4.5, 0.0, 0.0], False), ([0.0, 0.0, 1.1], True),
            ([0.0, 0.0, 2.0 * np.pi], True), ([0.0, 0.0, 1.4], False),
        ):  # fmt: skip
            assert area.contains(there + np.array(off)) is fits
    for moved in ({'unconfirmed': True}, {'scan_score': 0.2}, unmatched):
        assert search_area(drove_unseen(there, cov, **moved)) is None


def test_robot_that_only_drove_unseen_does_not_jump_through_the_building():
    """After a gap a scan fits one place of the unfinished map, which may be a twin."""
    for x, fits in ((1.0, True), (30.0, False)):
        system = System(Parameters())
        record = SessionFrame(1, drove_unseen())
        command = system.searches.begin(Purpose.RECOVER, record, None)
        there = np.array([x, 0.0, 0.0])
        found = Relocation(Verdict.UNIQUE, 'fits', there, 1e-4 * np.eye(3), 0.7)
        out = system.on_search_result(command.number, found)
        if fits:  # a loop closure, which the graph has to agree with: the robot does not jump
            np.testing.assert_array_equal(system.frames.found.T_map, there)
            np.testing.assert_array_equal(system.frames.found.T_local, record.frame.T_local_base)
            assert system.frames.found.area == pytest.approx(8.0**2)  # at all headings
        assert out == []
        assert (system.frames.found is not None) is fits
        assert ('too far' in system.recovery.why) is not fits


@pytest.mark.parametrize(
    ('changes', 'paused', 'x'),
    [
        ({'unconfirmed': True}, False, 30.0),  # it may have been carried
        ({'observation': SimpleNamespace(points=None)}, False, 1.0),  # no scan can close a loop
        ({}, True, 1.0),  # nothing is mapped
    ],
)
def test_robot_that_the_graph_cannot_find_jumps_to_where_it_was_found(changes, paused, x):
    system = System(Parameters())
    system.pause(paused)
    record = SessionFrame(1, drove_unseen(**changes))
    command = system.searches.begin(Purpose.RECOVER, record, None)
    found = Relocation(Verdict.UNIQUE, 'fits', np.array([x, 0.0, 0.0]), 1e-4 * np.eye(3), 0.7)
    out = system.on_search_result(command.number, found)
    assert any(isinstance(c, Relocate) for c in out)
    assert system.frames.found is None


def test_robot_that_localizes_is_searched_while_mapping_is_paused():
    none = Reflectors(
        *(np.zeros(shape) for shape in (0, (0, 2), (0, 2, 2))), *(np.zeros(0) for _ in range(3))
    )
    for known, searched in ((None, False), (SavedMap(none), True)):
        system, asked = System(Parameters()), []
        system.map = known
        system.pause(True)
        system._recover = lambda record, asked=asked: asked.append(record) or []
        system._restore = lambda record: []
        system.mode = 0
        system.on_frame(SessionFrame(1, drove_unseen()))
        assert bool(asked) is searched


def test_session_that_the_front_end_had_left_is_not_waited_for():
    """A search ended after a reset: the front end ignores where the one before was found."""
    requests = Requests()
    begin = np.zeros(3), np.eye(3)
    reset = requests.ask(StartSession(requests.new_number(), ANY, SECOND, *begin))
    late = requests.ask(StartSession(requests.new_number(), 1, SECOND, *begin))
    assert not requests.is_superseded(SessionFrame(1, drove_unseen(), 0))
    assert requests.pending is late
    assert not requests.is_superseded(SessionFrame(2, drove_unseen(), reset.number))
    assert requests.pending is None


@pytest.mark.parametrize('paused', [False, True])
def test_jump_while_mapping_is_paused_is_one_afterwards(paused):
    frames = MappedFrames()
    front_end, mapped = FrontEnd(Parameters()), []
    for k, observation in enumerate(observations(ROOM, drive((0.5, 0.0, 1.0))[:6])):
        frames.is_paused = paused and 1 <= k <= 3
        frame = replace(front_end.process(observation), jumped=k == 2)
        mapped += frames.add(SessionFrame(1, frame))
    assert [c.frame.jumped for c in mapped].count(True) == 1
