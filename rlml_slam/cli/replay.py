# SPDX-License-Identifier: Apache-2.0
"""``rlml replay``: a bag through the system, without topics and the same from run to run."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import warm_up
from rlml_slam.cli.support.bag_inputs import BagInputs
from rlml_slam.cli.support.progress import Progress
from rlml_slam.datasets.tum import Trajectory, read_tum
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.errors import BagError, InputError, MapError, ParameterError
from rlml_slam.evaluation.run_record import FrameLog, Run, Truth
from rlml_slam.evaluation.survey_residuals import compare
from rlml_slam.maps import saved_map, survey
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.maps.survey import Survey
from rlml_slam.params import EkfParameters, Parameters, from_mapping, read_yaml
from rlml_slam.report.outputs import make_folder, write_outputs
from rlml_slam.report.summary import print_summary
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.sensor_input import SensorInput, counted_as
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.closure_table import closure_table
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file

# name -> the type of its parameters and its constructor
SYSTEMS: Mapping[str, tuple[type[Any], Callable[[Any], Slam | EkfSlam]]] = {
    'rlml': (Parameters, Slam),
    'ekf': (EkfParameters, EkfSlam),
}


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml replay``."""
    parser = subparsers.add_parser(
        'replay', help='run the system over a bag: no topics, deterministic'
    )
    parser.add_argument(
        'bag', metavar='BAG', type=Path, help='rosbag2 folder (sqlite3, mcap) or ROS 1 .bag'
    )
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='results go here')
    parser.add_argument('--config', metavar='YAML', type=Path, help='ROS parameter file')
    parser.add_argument(
        '--system', choices=sorted(SYSTEMS), default='rlml', help='default: %(default)s'
    )
    parser.add_argument(
        '--truth', metavar='TUM', type=Path, help='ground truth, aligned before it is compared'
    )
    parser.add_argument(
        '--map', metavar='MAP', type=Path,
        help='localize in this map: a .rlml file, a .yaml file of nav2, or a folder that a replay '
        'wrote or save_map as `map`',
    )  # fmt: skip
    parser.add_argument(
        '--continue', metavar='MAP', type=Path, dest='go_on',
        help='go on mapping with this .rlml file',
    )  # fmt: skip
    parser.add_argument(
        '--survey', metavar='FILE', type=Path,
        help='surveyed reflectors (.csv, .json, SICK .imk): their frame becomes that of the map',
    )  # fmt: skip
    parser.add_argument(
        '--no-odometry', action='store_true', help='leave out the odometry: as use_odom false'
    )
    parser.add_argument('--json', action='store_true', help='print metrics.json and no more')


def run(args: argparse.Namespace) -> int:
    """Replay, write the results, and say what they are."""
    kind = SYSTEMS[args.system][0]
    params = from_mapping(read_yaml(args.config, kind), kind) if args.config else kind()
    if args.no_odometry:
        params = replace(params, node=replace(params.node, use_odom=False))
    make_folder(args.out)  # before the work, not after it
    truth = Truth(read_tum(args.truth), is_map=False) if args.truth else None
    if args.map and (args.go_on or args.survey):
        raise ParameterError('replay: --map excludes --continue and --survey')
    known = load_known(args.map) if args.map else None
    begun = map_file.load(args.go_on) if args.go_on else None
    surveyed = survey.load(args.survey) if args.survey else None
    result = replay(
        args.bag, params, truth, args.system, quiet=args.json, known=known, begun=begun,
        surveyed=surveyed,
    )  # fmt: skip
    return print_summary(result, write_outputs(result, args.out), args.out, args.json)


def load_known(path: Path) -> SavedMap:
    """A map to localize in: a .rlml file, a .yaml of nav2 or a .csv of reflectors, a folder."""
    if path.suffix in ('.yaml', '.csv') or path.is_dir():
        return saved_map.load(path)
    content = map_file.load(path)
    if note := saved_map.newer_image(path):
        print(f'rlml: {note}', file=sys.stderr)
    return map_file.saved_map(content)


def replay(
    path: str | Path,
    params: Parameters,
    truth: Truth | None = None,
    system: str = 'rlml',
    quiet: bool = True,
    known: SavedMap | None = None,
    begun: Content | None = None,
    surveyed: Survey | None = None,
) -> Run:
    """Drive the system with a bag's messages in the order of the log.

    ``truth`` replaces that of the bag; ``known`` is a map to localize in, from the pose
    ``map_start_pose`` or from where the robot finds itself, ``begun`` one to go on with;
    ``surveyed`` reflectors define the frame of the map. A damaged bag, or one whose clock jumps
    back, gives what came before, and ``Run.problem`` says so. Raises BagError if there is nothing
    to use at all.
    """
    warm_up.compile_loaded()
    with BagReader(path) as bag:
        params = patient(params)
        inputs = BagInputs(bag, params)
        slam = SYSTEMS[system][1](params)
        if known is not None:
            if not isinstance(slam, Slam):
                raise ParameterError('replay: --map is for --system rlml')
            slam = Slam(replace(params, node=replace(params.node, mode='localization')))
            slam.use_map(known)
        if surveyed is not None:
            if not isinstance(slam, Slam):
                raise ParameterError('replay: --survey is for --system rlml')
            slam = Slam(params, survey=surveyed)
        if begun is not None:
            if not isinstance(slam, Slam):
                raise ParameterError('replay: --continue is for --system rlml')
            slam.continue_map(begun)
        log, problem = FrameLog(), ''
        began = time.perf_counter()
        try:
            _drive(slam, params, inputs, log, (bag.start, bag.end), quiet)
        except BagError as e:
            problem = str(e)
        except InputError as e:
            problem = f'{path}: {e}'
        log.add(slam.finish())
        wall = time.perf_counter() - began
        problem = problem or bag.damage
        if not log.stamps:
            why = problem or slam.synchronizer.inputs.last_error or 'no scan and no reflectors'
            raise BagError(f'{path}: nothing in it could be used: {why}')
        truth = truth or inputs.truth()
        if truth is not None and surveyed is not None:
            truth = replace(truth, is_map=False)  # the bag knows nothing of the survey
        result = collect(slam, log, Path(path).resolve().name, truth)
        if isinstance(slam, Slam) and known is None:
            result.stored = map_file.content_of(slam.back_end, params, result.grid)
            result.extra = survey_figures(slam.back_end)
        result.inputs = fates(slam.counts, bag.skipped, inputs.topics)
        result.topics = sources(inputs.topics, inputs.more_scans)
    result.wall_s = wall
    ended = f'{problem}; the results hold what came before' if problem else ''
    result.problem = '; '.join(filter(None, (ended, result.problem)))
    return result


def patient(params: Parameters) -> Parameters:
    """Nobody waits for the pose: a pause of the odometry that can be bridged is waited for."""
    n = params.node
    longest = max(n.transform_timeout, params.motion.max_gap)
    return replace(params, node=replace(n, transform_timeout=longest))


def _drive(
    slam: Slam | EkfSlam,
    params: Parameters,
    inputs: BagInputs,
    log: FrameLog,
    span: tuple[int, int],
    quiet: bool,
) -> None:
    """Feed all inputs, the same way as the live nodes do."""
    feed = SensorInput(params, slam, slam.synchronizer.inputs)
    feed.extrinsics = inputs.extrinsics
    began, (start, end) = time.perf_counter(), span
    with Progress('replay', (end - start) * 1e-9, quiet) as progress:
        for k, (log_time, stream, message) in enumerate(inputs):
            log.add(feed.add(stream, message))
            if k % 200 == 0:
                done = (log_time - start) * 1e-9
                factor = done / max(time.perf_counter() - began, 1e-3)
                progress.update(done, f'{factor:.0f} x real time')


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
    stamps, optimized = slam.trajectory()
    path = Trajectory(stamps, optimized)
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
        closure_table=closure_table(tried),
        reflector_states=tuple(back_end.reflector_states()),
    )


def fates(
    counts: Mapping[str, Mapping[str, int]],
    skipped: Mapping[str, int],
    topics: Mapping[str, str],
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


def sources(topics: Mapping[str, str], more_scans: Iterable[str] = ()) -> dict[str, str]:
    """The topics of a bag that each counted stream came from."""
    out: dict[str, list[str]] = {}
    for stream, topic in (*topics.items(), *(('scan', topic) for topic in more_scans)):
        out.setdefault(counted_as(stream), []).append(topic)
    return {stream: ', '.join(names) for stream, names in out.items()}
