# SPDX-License-Identifier: Apache-2.0
"""The Python API: what ``import rlml_slam`` offers to scripts and notebooks.

Poses are (x, y, theta) [m, rad] as arrays (..., 3), covariances are of the same three, and stamps
are integer nanoseconds. Everything that can go wrong raises a subclass of RlmlError. See
docs/examples/notebook.py.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rlml_slam.datasets.tum import Trajectory, read_tum
from rlml_slam.errors import InputError, MapError, ParameterError
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.metrics import metrics
from rlml_slam.evaluation.relations import Relations, read_relations, relation_errors
from rlml_slam.evaluation.run_record import FrameLog, Run
from rlml_slam.maps import map_container, reflector_file, saved_map
from rlml_slam.maps.atomic_file import set_aside
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.nav2_map import save_grid
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.params import Node, Parameters, from_mapping, read_yaml
from rlml_slam.recordings.bag_inputs import BagInputs
from rlml_slam.recordings.bag_replay import Given
from rlml_slam.recordings.bag_replay import replay as run_replay
from rlml_slam.recordings.measurements import Measurement, checked
from rlml_slam.recordings.products import collect
from rlml_slam.report.outputs import write_outputs
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.se2 import Array
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.odometry_sources import TF, TOPIC, OdometrySources
from rlml_slam.slam.offline.slam import Slam as System
from rlml_slam.slam.store import map_file
from rlml_slam.types import Detections, Frame, Imu, Odometry, Reflectors, Scan

File: TypeAlias = str | Path


def read_parameters(
    path: File | None = None, changes: Mapping[str, Any] | None = None
) -> Parameters:
    """Parameters of a ROS parameter file, or the defaults, with ``changes`` by ROS name.

    For example ``read_parameters(changes={'use_odom': False, 'motion.max_gap': 0.5})``. Raises
    ParameterError for an unknown name or a value out of its bounds, FileFormatError for a file
    that has no parameters.
    """
    values = {} if path is None else read_yaml(path, Parameters)
    for name, value in (changes or {}).items():
        values[name] = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    found: Parameters = from_mapping(values, Parameters)
    return found


class Bag:
    """The measurements of a bag in the order of their recording: iterate as often as needed.

    ``topics`` maps each stream (scan, odom, imu, reflectors, reflector_poses) to its topic,
    ``start`` and ``end`` [ns] bound the recording, ``sensor_poses`` maps the frame of each sensor
    that /tf_static knows to its pose (3,) on the robot. ``truth`` is the ground truth, None
    without any. An iteration leaves invalid messages out and counts them, by stream, in
    ``skipped``; it raises BagError where the file is damaged.
    """

    def __init__(self, path: File, parameters: Parameters | None = None) -> None:
        self.path = Path(path)
        self.parameters = _parameters(parameters, Parameters())
        self.skipped: Mapping[str, int] = {}
        with BagReader(self.path) as bag:
            inputs = BagInputs(bag, self.parameters)
            self.start, self.end = bag.start, bag.end
            self.topics: Mapping[str, str] = dict(inputs.topics)
            self.sensor_poses = inputs.extrinsics.planar_poses(self.parameters.node.base_frame)
            found = inputs.truth()
        self.truth: Trajectory | None = found.trajectory if found is not None else None

    def __iter__(self) -> Iterator[Measurement]:
        counts = InputCounts()
        with BagReader(self.path) as bag:
            inputs = BagInputs(bag, self.parameters)
            feed = SensorInput(inputs.params, _Measurements(inputs.params.node), counts)
            feed.use_extrinsics(inputs.extrinsics)
            for _, stream, message in inputs:
                yield from feed.add(stream, message)
            self.skipped = {name: sum(c.values()) for name, c in counts.totals().items()}


class _Measurements:
    """A target of SensorInput that returns what it is given, of odometry what is used."""

    def __init__(self, node: Node) -> None:
        self._odometry = OdometrySources(node.odom_source, node.tf_buffer_duration)

    def set_sensor_pose(self, frame_id: str, T_base_sensor: Array) -> None:
        """The pose of a sensor, which the bag has in ``sensor_poses`` already."""

    def add_odometry(self, sample: Odometry) -> list[Measurement]:
        used = self._odometry.use(TOPIC, sample)
        return [] if used is None else [used]

    def add_transform(self, sample: Odometry) -> list[Measurement]:
        used = self._odometry.use(TF, sample)
        return [] if used is None else [used]

    def add_imu(self, sample: Imu) -> list[Measurement]:
        return [sample]

    def add_scan(self, scan: Scan) -> list[Measurement]:
        return [scan]

    def add_detections(self, detections: Detections) -> list[Measurement]:
        return [detections]


@dataclass(frozen=True)
class Map:
    """Reflectors and occupancy grid in the map frame.

    ``reflectors.points`` (n, 2) [m] with ``reflectors.cov`` (n, 2, 2) [m^2] and
    ``reflectors.ids`` (n,), -1 for reflectors without one. ``grid.cells`` (rows, columns) int8
    has -1 unknown, 0 free to 100 occupied, and ``grid.origin`` [m] is the corner of
    ``cells[0, 0]``; None where no scans were used. ``graph`` has keyframes and factors: a map
    without it can be localized in, but not continued.
    """

    reflectors: Reflectors
    grid: OccupancyGrid | None = None
    graph: Content | None = None


def load_map(path: File) -> Map:
    """The map of a .rlml file, of a folder of ``rlml replay`` or ``save_map``, or of nav2 (.yaml).

    Raises MapError if there is none, FileFormatError if it is damaged.
    """
    path = Path(path)
    if path.suffix == '.yaml' or (path.is_dir() and not (path / 'map.rlml').exists()):
        plain = saved_map.load(path)
        return Map(plain.reflectors, plain.grid)
    content = map_file.load(path / 'map.rlml' if path.is_dir() else path)
    whole = map_file.saved_map(content)
    return Map(whole.reflectors, whole.grid, content)


def save_map(map_: Map, path: File) -> Path:
    """Write a map: all of it as a .rlml file, else reflectors and grid as text into a folder.

    The folder has reflectors.csv, map.pgm and map.yaml (of nav2's map_server). Raises MapError if
    the path cannot be written, or if a .rlml file is asked for of a map without its graph.
    """
    path = Path(path)
    if not isinstance(map_, Map):
        raise MapError(f'{path}: a Map is needed, not {type(map_).__name__}')
    if path.suffix == '.rlml':
        if map_.graph is None:
            raise MapError(
                f'{path}: this map has reflectors and a grid but no graph; save it to a folder'
            )
        return map_container.write(path, map_.graph)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise MapError(f'{path}: cannot be written: {e.strerror or e}') from e
    set_aside(path / 'map.rlml')  # of another map, which would be read in the place of this one
    reflector_file.save(map_.reflectors, path / 'reflectors.csv')
    save_grid(map_.grid, path)
    return path


@dataclass(frozen=True)
class Result:
    """What a run estimated: one pose per scan or set of detections.

    ``problem`` says in one line what ended the run early, empty without a problem.
    """

    run: Run

    @property
    def trajectory(self) -> Trajectory:
        """The optimized poses in the map frame, with their stamps."""
        return self.run.trajectory

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Stamps (n,) [ns] of the optimized poses."""
        return self.run.trajectory.stamps

    @property
    def poses(self) -> Array:
        """Optimized poses (n, 3) in the map frame."""
        return self.run.trajectory.poses

    @property
    def live(self) -> Trajectory:
        """The poses in the map frame as the robot has them while it drives."""
        return self.run.frames.trajectory()

    @property
    def covariances(self) -> Array:
        """Covariances (n, 3, 3) of the live poses, in the axes of the map."""
        return np.array(self.run.frames.covs).reshape(-1, 3, 3)

    @property
    def map(self) -> Map:
        """The map that the run made, or localized in."""
        return Map(self.run.reflectors, self.run.grid, self.run.stored)

    @property
    def problem(self) -> str:
        """What ended the run early, in one line."""
        return self.run.problem

    @property
    def metrics(self) -> dict[str, Any]:
        """The figures of metrics.json: counts, times, health, and errors where truth is known."""
        return metrics(self.run)

    def save(self, folder: File) -> Path:
        """Write all files of ``rlml replay``: trajectory, map, metrics, pictures, report."""
        write_outputs(self.run, folder)
        return Path(folder)


class Slam:
    """The system, measurement by measurement.

    ``add`` returns the frames that became ready: a scan waits until the odometry covers its sweep.
    ``sensor_poses`` maps the ``frame_id`` of scans and detections to their sensor's pose (3,) on
    the robot; a sensor that is not in it has the parameter ``laser_pose``. With ``localize_in``
    the robot localizes in a map that does not change; with ``continue_from`` it extends one.
    """

    def __init__(
        self,
        parameters: Parameters | None = None,
        sensor_poses: Mapping[str, Sequence[float] | Array] | None = None,
        *,
        localize_in: Map | File | None = None,
        continue_from: Map | File | None = None,
    ) -> None:
        self.parameters = _parameters(parameters, Parameters())
        known, begun = _start(localize_in, continue_from)
        if known is not None:
            node = replace(self.parameters.node, mode='localization')
            self.parameters = replace(self.parameters, node=node)
        self._system = System(self.parameters)
        if known is not None:
            self._system.use_map(known)
        if begun is not None:
            self._system.continue_map(begun)
        self._is_localizing = known is not None
        self._log = FrameLog()
        for frame_id, pose in (sensor_poses or {}).items():
            self._system.set_sensor_pose(frame_id, _place(frame_id, pose))

    def add(self, measurement: Measurement) -> list[Frame]:
        """One measurement; the frames that it made ready, in the order of their stamps.

        A frame has ``stamp`` [ns], ``T_map_base`` (3,), ``cov_map`` (3, 3) and ``health``. Raises
        InputError for a measurement whose stamp or arrays are of another kind or shape, and where
        the stamps jump back, as those of a bag that is played in a loop do.
        """
        measurement = checked(measurement)
        if isinstance(measurement, Odometry):
            frames = self._system.add_odometry(measurement)
        elif isinstance(measurement, Imu):
            frames = self._system.add_imu(measurement)
        elif isinstance(measurement, Scan):
            frames = self._system.add_scan(measurement)
        else:
            frames = self._system.add_detections(measurement)
        self._log.add(frames)
        return frames

    def map(self) -> Map:
        """The map as it is now."""
        now = self._system.map()
        return Map(now.reflectors, now.grid)

    def finish(self, name: str = 'run') -> Result:
        """Process what still waits, optimize a last time, and return the result."""
        self._log.add(self._system.finish())
        if not self._log.stamps:
            why = self._system.synchronizer.inputs.last_error or 'no scan and no detections came'
            raise InputError(f'{name}: no measurement could be used: {why}')
        run = collect(self._system, copy.deepcopy(self._log), name, None)  # it may go on
        if not self._is_localizing:
            run.stored = map_file.content_of(self._system.back_end, self.parameters, run.grid)
        run.inputs = self._system.counts
        return Result(run)


def read_bag(path: File, parameters: Parameters | None = None) -> Bag:
    """The measurements of a rosbag2 folder (sqlite3, mcap) or a ROS 1 .bag file.

    ``parameters`` name topics and frames. Raises BagError if the bag cannot be read or has neither
    scans nor reflectors.
    """
    return Bag(path, parameters)


def replay(
    bag: File | Bag,
    parameters: Parameters | None = None,
    *,
    localize_in: Map | File | None = None,
    continue_from: Map | File | None = None,
) -> Result:
    """Run the system over a bag, as ``rlml replay`` does: the same input gives the same bytes.

    With ``localize_in`` the robot localizes in a map that does not change; with ``continue_from``
    it extends one. Raises BagError if nothing in the bag can be used.
    """
    path, own = (bag.path, bag.parameters) if isinstance(bag, Bag) else (bag, Parameters())
    known, begun = _start(localize_in, continue_from)
    return Result(run_replay(path, _parameters(parameters, own), given=Given(known, begun)))


def evaluate(
    estimate: Result | Trajectory | File,
    *,
    truth: Trajectory | File | None = None,
    relations: Relations | File | None = None,
    align: bool | None = None,
) -> dict[str, float]:
    """Errors of a trajectory: absolute against ``truth``, relative against ``relations``.

    ``truth`` gives the absolute trajectory error (``rmse_m``, ``mean_m``, ``max_m``, …,
    ``heading_rmse_deg``); with ``align``, which is the default for a truth that is given, the
    trajectory is first moved by the SE(2) transform that fits it best. ``relations`` give the
    metric of Kümmerle et al. 2009 (``trans_mean_m``, ``rot_mean_deg``, …). Files are TUM text and
    relations. A Result is compared with the ground truth of its bag if neither is given. Raises
    InputError if there is nothing to compare with or the two share no time.
    """
    own = estimate.run.truth if isinstance(estimate, Result) else None
    if truth is None and relations is None:
        if own is None:
            raise InputError('evaluate: no ground truth in the bag; give truth or relations')
        truth, align = own.trajectory, not own.is_map if align is None else align
    path = _as_trajectory(estimate)
    figures: dict[str, float] = {}
    if truth is not None:
        figures |= trajectory_errors(path, _as_trajectory(truth), align is not False).summary()
    if relations is not None:
        given = relations if isinstance(relations, Relations) else read_relations(relations)
        figures |= relation_errors(path, given).summary()
    return figures


def _as_trajectory(given: Result | Trajectory | File) -> Trajectory:
    if isinstance(given, Result):
        return given.trajectory
    if isinstance(given, Trajectory):
        return given
    if not isinstance(given, str | Path):
        raise InputError(f'evaluate: {type(given).__name__} is no Result, Trajectory or file')
    return read_tum(given)


def _start(
    localize_in: Map | File | None, continue_from: Map | File | None
) -> tuple[SavedMap | None, Content | None]:
    """The map to localize in and the one to extend, at most one of them."""
    if localize_in is not None and continue_from is not None:
        raise MapError('localize_in and continue_from exclude each other: give one map')
    if continue_from is not None:
        begun = _map('continue_from', continue_from)
        if begun.graph is None:
            raise MapError('continue_from: this map has no graph; one that was saved as .rlml has')
        return None, begun.graph
    if localize_in is None:
        return None, None
    known = _map('localize_in', localize_in)
    whole = SavedMap(known.reflectors, known.grid)
    return saved_map.require_contents(whole, saved_map.EMPTY), None


def _map(name: str, given: Map | File) -> Map:
    if isinstance(given, str | Path):
        return load_map(given)
    if not isinstance(given, Map):
        raise MapError(f'{name}: a Map or the path of one is needed, not {type(given).__name__}')
    return given


def _parameters(given: Parameters | None, default: Parameters) -> Parameters:
    if given is not None and not isinstance(given, Parameters):
        raise ParameterError(
            f'parameters: {type(given).__name__} is not Parameters; use read_parameters(changes=…)'
        )
    return default if given is None else given


def _place(frame_id: str, pose: Sequence[float] | Array) -> Array:
    try:
        place = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError):
        place = np.full(3, np.nan)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(f'sensor_poses: {frame_id}: {pose} is not x, y, heading')
    return place
