# SPDX-License-Identifier: Apache-2.0
"""What a finished system made of a recording, as a Run; and what became of its inputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.errors import MapError
from rlml_slam.evaluation.run_record import FrameLog, Run, Truth
from rlml_slam.evaluation.survey_residuals import compare
from rlml_slam.ros.sensor_input import counted_as
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.synchronizer import MEASURED
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_table import closure_table
from rlml_slam.slam.offline.slam import Slam

NAMES = {
    'scan': 'scans', 'reflectors': 'messages with reflectors', 'odom': 'messages with odometry'
}  # fmt: skip
MANY = 0.4  # of a stream: with a clock of its own, one of two lidars has about half of the scans
OF_USED = (
    'no_returns',
    'robot_parts',
    'sweep_time',
    'waited_out',
)  # counted among the used ones as well


def survey_figures(back_end: BackEnd) -> dict[str, Any]:
    """Of metrics.json: how the map and the survey, if there is one, agree."""
    survey_frame = back_end.survey_frame
    if survey_frame is None:
        return {}
    if not survey_frame.found:
        return {'survey': {'found': False, 'why': survey_frame.why}}
    rows = compare(back_end.reflectors(), survey_frame.survey, in_survey_frame=True)
    return {'survey': {'found': True, 'why': survey_frame.why, **rows}}


def collect(slam: Slam | EkfSlam, log: FrameLog, name: str, truth: Truth | None) -> Run:
    """The products of a finished system; a grid too large to be drawn is ``Run.problem``."""
    truth = truth and truth.in_map_of(log)
    path = Trajectory(*slam.trajectory())
    grid, problem = None, ''
    try:
        grid = slam.occupancy_grid()
    except MapError as e:
        problem = f'{e}; the results hold everything else'
    if isinstance(slam, EkfSlam):
        return Run(name, log, path, slam.reflectors(), grid, truth=truth, problem=problem)
    back_end = slam.back_end
    indices = [key.index for key in back_end.keyframes]
    poses = back_end.graph.poses
    tried = back_end.loop_closer.records
    ends = [poses[[c.i, c.j], :2] for c in tried if c.accepted]
    return Run(
        name,
        log,
        path,
        slam.reflectors(),
        grid,
        np.array(poses[indices]).reshape(-1, 3),
        np.array(ends).reshape(-1, 2, 2),
        back_end.loop_closer.tried[False],
        np.array([u.wall_ms for u in slam.updates]),
        truth=truth,
        problem=problem,
        closure_table=closure_table(tried) if indices else '',
        reflector_states=tuple(back_end.reflector_states()),
    )


def fates(
    counts: Mapping[str, Mapping[str, int]], skipped: Mapping[str, int], topics: Mapping[str, str]
) -> dict[str, dict[str, int]]:
    """What became of the inputs of each stream: used, late, invalid, and whatever else occurred.

    ``skipped`` messages, by topic, could not even be read, and count as invalid.
    """
    unread: Counter[str] = Counter()
    for stream, topic in topics.items():
        unread[counted_as(stream)] += skipped.get(topic, 0)
    out: dict[str, dict[str, int]] = {}
    for stream in dict.fromkeys([*map(counted_as, topics), *counts]):
        fate = {'used': 0, 'late': 0, 'invalid': 0} | dict(counts.get(stream, {}))
        fate['invalid'] += unread[stream]
        out[stream] = fate
    return out


def refused(inputs: InputCounts) -> str:
    """How many scans or reflectors were late or ahead of all others, '' unless they are many.

    Of odometry there is more than enough where a recording is merely out of order; where it jumps,
    or none is valid, that is a problem as well. An IMU without turn rates is none.
    """
    out = []
    for stream, name in NAMES.items():
        fate = inputs.counts.get(stream, Counter())
        every = sum(fate.values()) - sum(fate[what] for what in OF_USED)
        wrong = fate['late'] + fate['future'] if stream in MEASURED else fate['jump']
        wrong = every if fate['invalid'] == every else wrong
        if wrong > MANY * every:
            first = inputs.first_errors[stream]
            out.append(f'{wrong} of {every} {name} were not used; the first: {first}')
    return '; '.join(out)


def sources(topics: Mapping[str, str], more_scans: Iterable[str] = ()) -> dict[str, str]:
    """The topics of a bag that each counted stream came from."""
    out: dict[str, list[str]] = {}
    for stream, topic in (*topics.items(), *(('scan', topic) for topic in more_scans)):
        out.setdefault(counted_as(stream), []).append(topic)
    return {stream: ', '.join(names) for stream, names in out.items()}
