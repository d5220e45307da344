# SPDX-License-Identifier: Apache-2.0
"""What happens to a robot while it maps or localizes: a drive, events by frame, expectations.

A scenario is a value. Each way to run it (by calls, by messages in one process, by processes) is
one driver, which has a method for each event of the list.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from made_worlds import ROOM, SECOND, STEP, TinyWorld, drive, scan_at, seen_at

from rlml_slam import se2
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.systems.simulator_messages import SimulatedMessages
from rlml_slam.se2 import Array
from rlml_slam.slam import conversation as say
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Odometry, Reflectors

START = np.array([0.0, -0.8, 0.0])
ROUND = drive((0.5, 0.5, 12.6), start=START)  # a circle of 1 m
TWICE = drive((0.5, 0.5, 16.0), start=START)
ELSEWHERE = drive((0.4, 0.4, 8.0), (0.5, -0.4, 8.0), start=(0.6, -1.2, 0.4))
CARRIED = np.vstack([ROUND[:90], drive((0.3, 0.3, 7.0), start=(4.6, -1.4, 2.0))])
EPOCH = 1000 * SECOND
BLIND = TinyWorld(ROOM.walls, np.zeros((0, 2)))
T_SURVEY_WORLD = np.array([20.0, -7.0, 0.8])
FIRST_NUMBER, SECOND_NUMBER = 5000, 1000  # of requests, of two runs of the back end
SAVED = 'map'  # name of the map of ROUND
NEAR = np.diag([0.25, 0.25, 0.07]) ** 2  # of a pose set by hand


@dataclass(frozen=True)
class Scenario:
    """One drive along the true ``poses`` (n, 3), a frame every 0.1 s, and what happens meanwhile.

    ``events``: (frame before which it happens, name of the driver's method, its arguments).
    ``jumps``: frames at which the robot is carried to its pose, which odometry does not see.
    ``node``: parameters. ``seen_from``: the first frame that sees reflectors. ``delay``: of
    searches [s].

    ``decisions`` are the commands to the front end in their order. The robot is within ``error``
    [m] of the truth in the last frames, in the axes of a map where the world is at
    ``T_map_world``. The graph has ``more`` keyframes than the saved map, or is ``empty``.
    ``kept`` is the number of maps that were kept automatically.
    """

    name: str
    poses: Array
    T_map_world: Array
    decisions: tuple[str, ...]
    events: tuple[tuple[int, str, tuple[object, ...]], ...] = ()
    jumps: tuple[int, ...] = ()
    node: dict[str, object] = field(default_factory=dict)
    survey: bool = False
    seen_from: int = 0
    delay: float = 0.0
    error: float = 0.06
    more: bool = False
    empty: bool = False
    kept: int = 0

    def odometry(self) -> Array:
        """Odometry (n, 3): the true motion but for what carries the robot."""
        out = [np.zeros(3)]
        for k in range(1, len(self.poses)):
            step = np.zeros(3)
            if k not in self.jumps:
                step = se2.between(self.poses[k - 1], self.poses[k])
            out.append(se2.compose(out[-1], step))
        return np.array(out)

    def steps(self) -> Iterator[list[object]]:
        """What is measured by each frame, in order of arrival."""
        rng, odometry = np.random.default_rng(3), self.odometry()
        for k, pose in enumerate(self.poses):
            stamp = EPOCH + k * STEP
            world = ROOM if k >= self.seen_from else BLIND
            out: list[object] = []
            if k:
                half = se2.interpolate(odometry[k - 1], odometry[k], 0.5)
                out.append(Odometry(stamp - STEP // 2, half))
            yield [
                *out,
                Odometry(stamp, odometry[k]),
                scan_at(world, pose, stamp, rng),
                seen_at(world, pose, stamp, rng, frame='laser'),
            ]


@dataclass
class Outcome:
    """What became of a drive: by frame its number, session (from 1 on) and pose in the map."""

    frames: list[tuple[int, int, Array]] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    keyframes: int = 0
    trajectory: Array | None = None
    reflectors: Reflectors | None = None
    grid: OccupancyGrid | None = None
    kept: int | None = None


class Driver:
    """Runs a scenario; a subclass says how measurements and events reach the system."""

    make: object

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self.scenario, self.folder = scenario, folder
        p = Parameters()
        node = dict(scenario.node, map_directory=str(folder), journal_period=0.0)
        back_end = dataclasses.replace(p.back_end, survey='plant.csv' if scenario.survey else '')
        self.params = dataclasses.replace(
            p, node=dataclasses.replace(p.node, **node), back_end=back_end
        )
        self.messages = SimulatedMessages(self.make, SimulatorParameters())
        self.shift, self.now = 0, EPOCH
        self.outcome = Outcome()
        self._sessions: dict[int, int] = {}

    def run(self) -> Outcome:
        """The whole drive."""
        self.begin()
        for k, measured in enumerate(self.scenario.steps()):
            for at, event, arguments in self.scenario.events:
                if at == k:
                    getattr(self, event)(*arguments)
            self.now = EPOCH + k * STEP + self.shift
            for sample in measured:
                late = dataclasses.replace(sample, stamp=sample.stamp + self.shift)
                self.feed(*self.messages(late))
        self.end()
        return self.outcome

    def jump_back(self, seconds: float) -> None:
        """The clock of all sensors jumps back."""
        self.shift -= round(seconds * SECOND)

    def saw(self, record: say.SessionFrame) -> None:
        """A frame came out of the front end."""
        number = self._sessions.setdefault(record.session, len(self._sessions) + 1)
        k = round((record.frame.stamp - self.shift - EPOCH) / STEP)
        self.outcome.frames.append((k, number, record.frame.T_map_base))

    def pose_message(self, k: int, offset: tuple[float, float, float]) -> object:
        """What a user sets near the true pose of a frame, in the axes of the map."""
        s = self.scenario
        pose = se2.compose(se2.compose(s.T_map_world, s.poses[k]), np.array(offset))
        return encode.pose_with_covariance(self.make, self.now, 'map', pose, NEAR)


def same(a: Outcome, b: Outcome) -> None:
    """Hold two outcomes of a scenario against each other, to the last bit."""
    assert a.decisions == b.decisions
    assert [f[:2] for f in a.frames] == [f[:2] for f in b.frames]
    for (_, _, x), (_, _, y) in zip(a.frames, b.frames, strict=True):
        assert x.tobytes() == y.tobytes()
    assert a.keyframes == b.keyframes
    assert a.trajectory.tobytes() == b.trajectory.tobytes()
    assert np.array_equal(a.reflectors.keys, b.reflectors.keys)
    assert a.reflectors.points.tobytes() == b.reflectors.points.tobytes()
    assert a.reflectors.cov.tobytes() == b.reflectors.cov.tobytes()
    assert a.grid.cells.tobytes() == b.grid.cells.tobytes()


def decision(command: object) -> str | None:
    """The name of a command to the front end that decides something."""
    if isinstance(command, say.LocalizeIn):
        return 'map' if command.map is None else 'localize'
    if isinstance(command, say.StartSession):
        return 'start'
    return 'relocate' if isinstance(command, say.Relocate) else None


def save_map(folder: Path) -> int:
    """Save the map of ROUND and the survey of the room; the number of keyframes."""
    folder.mkdir(parents=True, exist_ok=True)
    slam = Slam(Parameters())
    slam.set_sensor_pose('laser', np.zeros(3))
    add = {'Odometry': slam.add_odometry, 'Scan': slam.add_scan, 'Detections': slam.add_detections}
    for measured in Scenario('', ROUND, START, ()).steps():
        for sample in measured:
            add[type(sample).__name__](sample)
    slam.finish()
    map_file.save(folder / f'{SAVED}.rlml', slam.back_end, Parameters())
    points = se2.transform(T_SURVEY_WORLD, ROOM.reflectors)
    rows = [f'{x:.6f},{y:.6f}' for x, y in points]
    (folder / 'plant.csv').write_text('\n'.join(['x,y', *rows, '']))
    return len(slam.back_end.keyframes)


def check(scenario: Scenario, outcome: Outcome, saved_keyframes: int) -> None:
    """Hold an outcome against the expectations."""
    s, o = scenario, outcome
    assert tuple(o.decisions) == s.decisions, o.decisions
    tail = o.frames[-10:]
    assert tail[-1][0] >= len(s.poses) - 3
    true = se2.compose(s.T_map_world, np.array([s.poses[k] for k, _, _ in tail]))
    error = se2.between(true, np.array([pose for _, _, pose in tail]))
    assert np.hypot(error[:, 0], error[:, 1]).max() < s.error
    assert np.abs(error[:, 2]).max() < 0.05
    assert (o.keyframes == 0) == s.empty
    assert o.keyframes > saved_keyframes or not s.more
    assert o.kept in (None, s.kept)
    assert o.reflectors is not None
    assert len(o.reflectors) == len(ROOM.reflectors)  # none twice
    gap = np.linalg.norm(
        o.reflectors.points[:, None] - se2.transform(s.T_map_world, ROOM.reflectors), axis=-1
    )
    assert gap.min(axis=1).max() < s.error


HOME = se2.inverse(START)  # of the world in a map that begins at START, and in the saved one
THERE = se2.inverse(ELSEWHERE[0])
LOCALIZES = {'mode': 'localization'}

SCENARIOS = (
    Scenario(
        'map loaded while driving', ELSEWHERE, HOME, ('map', 'start'),
        ((40, 'load', (SAVED,)),), more=True,
    ),
    Scenario(
        'map continued at start', ELSEWHERE, HOME, ('map', 'start'),
        node={'continue_map': True}, more=True,
    ),
    Scenario(
        'kidnap while mapping', CARRIED, HOME, ('map', 'relocate'), jumps=(90,),
    ),
    Scenario(
        'kidnap while localizing', CARRIED, HOME, ('localize', 'relocate'), jumps=(90,),
        node=LOCALIZES, empty=True,
    ),
    Scenario(
        'restart of the front end', TWICE, HOME, ('map', 'start'),
        ((100, 'restart_front_end', ()),),
    ),
    Scenario(
        'restart of the front end while localizing', TWICE, HOME, ('localize', 'relocate'),
        ((100, 'restart_front_end', ()),), node=LOCALIZES, empty=True,
    ),
    Scenario(
        'restart of the back end', TWICE, HOME, ('map', 'map', 'start'),
        ((80, 'kill_back_end', ()), (100, 'start_back_end', ())),
    ),
    Scenario(
        'search 5 s late', ELSEWHERE, HOME, ('map', 'start'),
        ((40, 'load', (SAVED,)),), delay=5.0, more=True,
    ),
    Scenario(
        'clock that jumps back', TWICE, HOME, ('map', 'start'),
        ((100, 'jump_back', (30.0,)),),
    ),
    Scenario(
        'set_localization_mode', TWICE, HOME, ('map', 'localize', 'map'),
        ((100, 'localize', (True,)), (130, 'localize', (False,))), kept=1,
    ),
    Scenario(
        'pause_new_measurements', TWICE, HOME, ('map',),
        ((60, 'pause', (True,)), (90, 'pause', (False,))),
    ),
    Scenario(
        'reset', TWICE, se2.inverse(TWICE[99]), ('map', 'start'), ((100, 'reset', ()),),
    ),
    Scenario(
        'survey found half-way', TWICE, T_SURVEY_WORLD, ('map',), survey=True, seen_from=80,
    ),
    Scenario(
        'pose of a user while localizing', ELSEWHERE, HOME, ('localize',),
        ((5, 'give_pose', (5, (0.2, -0.1, 0.1))),), node=LOCALIZES, empty=True,
    ),
)  # fmt: skip
