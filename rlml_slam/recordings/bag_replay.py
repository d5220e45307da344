# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag: the system driven by its messages, in the order of the log."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rlml_slam import warm_up
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.errors import BagError, InputError, ParameterError
from rlml_slam.estimation.health import with_problems
from rlml_slam.evaluation.metrics import run_errors
from rlml_slam.evaluation.run_record import FrameLog, Origin, Run, Truth
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.maps.survey import Survey
from rlml_slam.params import EkfParameters, Parameters, changed
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.recordings.estimate_bag import EstimateBag
from rlml_slam.recordings.products import collect, fates, refused, survey_figures
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.slam.store import map_file
from rlml_slam.types import Frame

# name -> the type of its parameters and its constructor
SYSTEMS: Mapping[str, tuple[type[Any], Callable[[Any], Slam | EkfSlam]]] = {
    'rlml': (Parameters, Slam),
    'ekf': (EkfParameters, EkfSlam),
}


@dataclass(frozen=True)
class Given:
    """What a replay begins with: a map to localize in, one to continue, surveyed reflectors."""

    known: SavedMap | None = None
    begun: Content | None = None
    surveyed: Survey | None = None


def replay(
    path: str | Path,
    params: Parameters,
    truth: Truth | None = None,
    system: str = 'rlml',
    given: Given = Given(),
    mcap: Path | None = None,
    progress: Callable[[float, str], None] = lambda share, note: None,
) -> Run:
    """Drive the system with a bag's messages in the order of the log.

    ``truth`` replaces that of the bag. In a known map the robot starts at ``map_start_pose`` or
    where it finds itself; surveyed reflectors define the frame of the map. ``mcap`` is a file for
    all that was estimated (EstimateBag). ``progress`` is called with the share that is done and a
    note. A damaged bag, or one whose clock jumps back, gives what came before, and
    ``Run.problem`` says so. Raises BagError if there is nothing to use at all.
    """
    warm_up.compile_loaded(lambda text: progress(0.0, text))
    origin = Origin(parameters=changed(params), system=system)
    with BagReader(path) as bag, ExitStack() as files:
        inputs = BagInputs(bag, patient(params))
        params = inputs.params
        slam = _begin(system, params, given)
        feed = SensorInput(params, slam, slam.synchronizer.inputs)
        feed.use_extrinsics(inputs.extrinsics)
        recording = None
        if mcap is not None:
            recording = EstimateBag(files.enter_context(BagWriter(mcap)), inputs)
            recording.copy(path)
        log, problem = FrameLog(), ''
        began = time.perf_counter()
        try:
            _drive(slam, feed, inputs, log, recording, (bag.start, bag.end), progress)
        except BagError as e:
            problem = str(e)
        except InputError as e:
            problem = f'{path}: {e}'
        frames = _with_health(slam.finish(), feed, inputs)
        log.add(frames)
        wall = time.perf_counter() - began
        problem = problem or bag.damage
        if not log.stamps:
            why = problem or slam.synchronizer.inputs.last_error or 'no scan and no reflectors'
            raise BagError(f'{path}: nothing in it could be used: {why}')
        truth = truth or inputs.truth()
        if truth is not None and given.surveyed is not None:
            truth = replace(truth, is_map=False)  # the bag knows nothing of the survey
        result = collect(slam, log, Path(path).resolve().name, truth)
        if isinstance(slam, Slam) and given.known is None:
            result.stored = map_file.content_of(slam.back_end, params, result.grid)
            result.extra = survey_figures(slam.back_end)
        result.inputs = fates(slam.counts, bag.skipped, inputs.topics)
        result.topics = inputs.sources()
        for stream, why in slam.synchronizer.inputs.first_errors.items():
            if stream in result.topics and not result.inputs[stream]['used']:
                result.topics[stream] += f'; none is used: {why}'
        detected = str(slam.synchronizer.reflectors)
        if detected and 'reflectors' not in result.topics:
            result.topics['reflectors'] = f'intensities of the scans: {detected}'
            result.inputs['reflectors'] = {'used': slam.synchronizer.reflectors.num_scans}
        if slam.synchronizer.delay.now:
            result.topics['odom'] += f', stamped {slam.synchronizer.delay}'
        if 'imu' in result.topics and slam.synchronizer.gyro.fault:
            result.topics['imu'] += f'; not used, as {slam.synchronizer.gyro.fault}'
        if recording is not None:
            recording.add(bag.end, frames, slam)
            recording.finish(slam, run_errors(result))
    result.wall_s, result.origin = wall, origin
    ended = f'{problem}; the results hold what came before' if problem else ''
    missing = refused(slam.synchronizer.inputs)
    result.problem = '; '.join(filter(None, (ended, result.problem, missing)))
    return result


def _begin(system: str, params: Any, given: Given) -> Slam | EkfSlam:
    """The system, in the map or with the survey that is given."""
    options = {'--map': given.known, '--survey': given.surveyed, '--continue': given.begun}
    for option, value in options.items():
        if value is not None and SYSTEMS[system][1] is not Slam:
            raise ParameterError(f'replay: {option} is for --system rlml')
    if given.known is not None:
        slam = Slam(replace(params, node=replace(params.node, mode='localization')))
        slam.use_map(given.known)
        return slam
    if SYSTEMS[system][1] is not Slam:
        return SYSTEMS[system][1](params)
    slam = Slam(params, survey=given.surveyed)
    if given.begun is not None:
        slam.continue_map(given.begun)
    return slam


def patient(params: Parameters) -> Parameters:
    """Nobody waits for the pose: a pause of the odometry that can be bridged is waited for."""
    n = params.node
    longest = max(n.odom_timeout, params.motion.max_gap)
    return replace(params, node=replace(n, odom_timeout=longest))


def _drive(
    slam: Slam | EkfSlam,
    feed: SensorInput[Frame],
    inputs: BagInputs,
    log: FrameLog,
    recording: EstimateBag | None,
    span: tuple[int, int],
    progress: Callable[[float, str], None],
) -> None:
    """Feed all inputs, the same way as the live nodes do."""
    began, (start, end) = time.perf_counter(), span
    for k, (log_time, stream, message) in enumerate(inputs):
        frames = _with_health(feed.add(stream, message), feed, inputs)
        log.add(frames)
        if recording is not None:
            recording.add(log_time, frames, slam)
        if k % 200 == 0:
            done = log_time - start
            factor = done * 1e-9 / max(time.perf_counter() - began, 1e-3)
            progress(done / max(end - start, 1), f'{factor:.0f} x real time')


def _with_health(frames: list[Frame], feed: SensorInput[Frame], inputs: BagInputs) -> list[Frame]:
    """The frames with the health that a node would publish."""
    problems = (*inputs.problems, *feed.odometry_problems()) if frames else ()
    if not problems:
        return frames
    return [replace(f, health=with_problems(f.health, problems)) for f in frames]
