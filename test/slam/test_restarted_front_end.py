# SPDX-License-Identifier: Apache-2.0
"""A front end that starts again while a map is made goes on in that map, where it is found."""

import dataclasses

import numpy as np
import pytest
from made_worlds import OTHER_ROOM, ROOM, drive, messages

from rlml_slam import se2
from rlml_slam.params import Parameters
from rlml_slam.slam.conversation import GIVEN, MISPLACED, SessionFrame
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.relocalization.scan_relocalization import Relocation
from rlml_slam.slam.store import map_file
from rlml_slam.types import Odometry, Scan, Verdict

START = np.array([0.0, -0.8, 0.0])
PATH = drive((0.5, 0.5, 26.0), start=START)
AT = 120  # pose at which it starts again


def add(slam, m):
    if isinstance(m, Odometry):
        return slam.add_odometry(m)
    return slam.add_scan(m) if isinstance(m, Scan) else slam.add_detections(m)


class Run:
    """Drives a Slam through a room, and then, after ``restart``, through a world."""

    def __init__(self, misplaced=False, world=ROOM, delay=0.0):
        self.said, self.frames = list[str](), []
        self.slam = Slam(Parameters(), search_delay=delay)
        execute = self.slam.execute

        def noted(commands):
            commands = list(commands)
            self.said += [c.text for c in commands if hasattr(c, 'severity')]
            execute(commands)

        self.slam.execute = noted
        before, after = (
            [m for m in messages(w, PATH, rng=np.random.default_rng(1))] for w in (ROOM, world)
        )
        first = next(m.stamp for m in after if isinstance(m, Scan) and m.stamp >= stamp_of(AT))
        for m in before:
            if m.stamp < first:
                self.add(m)
        self.mapped = len(self.slam.back_end.keyframes)
        self.keys = set(self.slam.back_end.reflectors().keys.tolist())
        self.slam.session.restart(misplaced)
        self.frames.clear()
        for m in after:
            if m.stamp >= first:
                self.add(m)

    def add(self, m):
        self.frames += add(self.slam, m)

    @property
    def off(self):
        """Distance [m] of the newest pose from the true one, in the first map."""
        frame = self.frames[-1]
        k = (frame.stamp - stamp_of(0)) // (stamp_of(1) - stamp_of(0))
        true = se2.between(PATH[0], PATH[k])
        return float(np.hypot(*(frame.T_map_base - true)[:2]))


def stamp_of(k):
    return messages(ROOM, PATH[:1])[0].stamp + k * 100_000_000


def test_it_goes_on_in_the_map():
    run = Run()
    assert run.said[0] == 'the front end started again: the robot is searched in the map'
    assert run.said[1].startswith('the map is continued: ')
    assert run.off < 0.06
    assert len(run.slam.back_end.keyframes) > run.mapped > 10
    assert run.slam.system.entry is None
    # nothing leads from the one to the other but what was found
    jumps = [k for k, key in enumerate(run.slam.back_end.keyframes) if key.jumped]
    assert jumps == [run.mapped]
    # no reflector is there twice, none has the key of another
    reflectors = run.slam.reflectors()
    assert len(reflectors) == len(ROOM.reflectors)
    assert run.keys == set(reflectors.keys.tolist())


def fits_nowhere(self, command):
    """A search that takes no time and finds nothing."""
    none = Relocation(Verdict.IMPOSSIBLE, why='nothing fits')
    self.execute(self.system.on_search_result(command.number, none))


def test_frames_are_not_mapped_while_it_is_searched(monkeypatch):
    monkeypatch.setattr(Slam, '_search', fits_nowhere)
    run = Run()
    assert run.said[-1] == 'the robot was not found in the map: another map begins'
    patience = round(10 * Parameters().health.new_session_time)
    first = run.slam.back_end.keyframes[0].stamp
    assert abs(first - stamp_of(AT + patience)) < 1_000_000_000


@pytest.mark.parametrize('delay', [6.0, 9.0])
def test_search_that_takes_longer_than_the_patience_is_waited_for(delay):
    run = Run(delay=delay)
    assert run.said[-1].startswith('the map is continued: ')
    assert run.off < 0.06
    assert len(run.slam.back_end.keyframes) > run.mapped


def test_robot_that_is_silent_between_two_restarts_is_searched_all_the_same():
    slam = Slam(Parameters())
    frames = [f for m in messages(ROOM, PATH[:60], rng=np.random.default_rng(1))
              for f in add(slam, m)]  # fmt: skip
    system, last = slam.system, frames[-1]
    system.on_frame(SessionFrame(7, last))
    late = dataclasses.replace(last, stamp=last.stamp + 20_000_000_000)
    out = system.on_frame(SessionFrame(8, late))
    assert system.entry is not None
    assert 'ForgetMap' not in [type(c).__name__ for c in out]


def test_paused_robot_in_a_loaded_map_is_searched_there_after_a_restart():
    slam = Slam(Parameters())
    frames = [f for m in messages(ROOM, PATH[:60], rng=np.random.default_rng(1))
              for f in add(slam, m)]  # fmt: skip
    system, last = slam.system, frames[-1]
    slam.continue_map(map_file.content_of(slam.back_end, Parameters(), None))
    system.pause(True)
    start = next(c for c in [system._start(SessionFrame(1, last), np.zeros(3), np.eye(3))])
    system.on_frame(SessionFrame(2, last, start.number, system.mode))
    assert system.entry is None
    system.on_frame(SessionFrame(3, last, mode=system.mode))
    assert system.entry is not None
    late = dataclasses.replace(last, stamp=last.stamp + 90_000_000_000)
    system.entry.on_answer('nothing fits')
    out = system.on_frame(SessionFrame(3, late, mode=system.mode))
    assert 'ForgetMap' not in [type(c).__name__ for c in out]  # paused


@pytest.mark.parametrize(('request_', 'stays'), [(MISPLACED, False), (GIVEN, True)])
def test_what_a_user_and_a_late_transform_do_meanwhile(request_, stays):
    slam = Slam(Parameters())
    frames = [f for m in messages(ROOM, PATH[:60], rng=np.random.default_rng(1))
              for f in add(slam, m)]  # fmt: skip
    system, last = slam.system, frames[-1]
    system.on_frame(SessionFrame(7, last))
    _, (drawn,) = system.relocalize()
    assert not system.searches._pending[drawn.number].complete
    out = system.on_frame(SessionFrame(8, last, request_))
    assert (system.entry is not None) == stays
    assert ('ForgetMap' in [type(c).__name__ for c in out]) != stays


def test_robot_elsewhere_begins_another_map():
    run = Run(world=OTHER_ROOM)
    assert run.said[-1] == 'the robot was not found in the map: another map begins'
    assert run.slam.back_end.keyframes[0].stamp > stamp_of(AT)


def test_map_of_a_misplaced_sensor_is_not_continued():
    run = Run(misplaced=True)
    assert run.said == ['the front end began elsewhere: another map begins']
    assert run.slam.back_end.keyframes[0].stamp >= stamp_of(AT)


@pytest.mark.parametrize('restarts', [1, 2])
def test_keys_of_the_session_begin_behind_those_of_the_map(restarts):
    slam, started = Slam(Parameters()), []
    command = slam._command

    def noted(request):
        started.append(request.first_key)
        command(request)

    slam._executes = {**slam._executes}
    for kind in list(slam._executes):
        if kind.__name__ == 'StartSession':
            slam._executes[kind] = noted
    rng = np.random.default_rng(1)
    for m in messages(ROOM, PATH, rng=rng):
        if isinstance(m, Scan) and m.stamp in [stamp_of(60 * (k + 1)) for k in range(restarts)]:
            slam.session.restart()
        add(slam, m)
    assert len(started) == restarts
    assert min(started) > max(slam.back_end.reflectors().keys)


def test_it_stays_searched_while_it_starts_again_and_again():
    slam = Slam(Parameters())
    frames = [f for m in messages(ROOM, PATH[:60], rng=np.random.default_rng(1))
              for f in add(slam, m)]  # fmt: skip
    system, last, out = slam.system, frames[-1], []
    for session in (7, 8, 9):  # of front ends that crash at once
        out += system.on_frame(SessionFrame(session, last))
        assert system.entry is not None
    names = [type(c).__name__ for c in out]
    assert names.count('DrawMap') == 1
    assert not {'KeepMap', 'ForgetMap', 'MapFrame'} & set(names)
    assert system.frames.session not in (7, 8, 9)
