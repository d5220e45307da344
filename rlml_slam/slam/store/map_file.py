# SPDX-License-Identifier: Apache-2.0
"""Map files: keyframes, scans, submaps, graph, reflectors, parameters and the grid.

Names of the arrays in the container (maps/map_container.py), for n keyframes and m landmarks, in
metres and radians:

    pose (n, 3), pose_fixed (n,), landmark (m, 2), landmark_fixed (m,)     the estimate
    edge_…, sighted_…, pose_prior_…, landmark_prior_… with nodes, measured,
        information, kinds (graph.model.factor_table.FactorKind), enabled               the factors
    key_stamp [ns], key_local, key_cov, key_scan_stamp, key_detector_ran, key_jumped, key_origin,
        key_points (n,) number of its ``points`` (p, 2), -1 without a scan    keyframes and scans
    submap_…                        the grids that scans are matched against, cells in one row
    reflector_…, sighting           reflectors by key; `reflector_removed` left the map;
                                    `reflector_map` and `reflector_cov` are what a robot
                                    localizes with
    survey_ids, survey_points, survey_diameters     the survey whose frame the map has, if any
    closure…, path, path_motion     records of closures, the path of all frames
    grid (rows, columns)            the occupancy grid, where there are scans

The description has the parameters that the map was made with, the grid's origin, and ``id``, the
hash of reflectors and grid that /diagnostics show of who localizes in the map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError, MapError, SolverError
from rlml_slam.graph import FactorKind, FactorTable, Graph
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.maps.survey import Survey
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end import saved_state
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Keyframe
from rlml_slam.types import Reflectors
from rlml_slam.version import __version__

FORMAT, VERSION = 'rlml_slam map', 1
COLUMNS = ('nodes', 'measured', 'information', 'kinds', 'enabled')
MADE = ('keys', 'ids', 'sightings', 'diameters')
Arrays = Mapping[str, NDArray[Any]]


@contextmanager
def consistent() -> Iterator[None]:
    """FileFormatError in the place of what arrays that contradict each other raise."""
    try:
        yield
    except (
        LookupError, ValueError, TypeError, AttributeError, ArithmeticError, MemoryError,
        SolverError,
    ) as e:  # fmt: skip
        raise FileFormatError(f'the parts of the map are inconsistent: {e}') from e


def parameters_of(content: Content) -> Parameters:
    """Parameters that a map was made with; unknown ones are left out."""
    groups: dict[str, Any] = {}
    with consistent():
        saved = content.description['parameters']
        for group in dataclasses.fields(Parameters):
            kind: Any = group.default_factory
            known = {f.name for f in dataclasses.fields(kind)}
            values = saved.get(group.name, {})
            groups[group.name] = kind(**{k: v for k, v in values.items() if k in known})
        return Parameters(**groups)


def tables(graph: Graph) -> dict[str, FactorTable]:
    """The tables of a graph, by their names in the file."""
    return {
        'edge': graph.edges, 'sighted': graph.sightings,
        'pose_prior': graph.pose_priors, 'landmark_prior': graph.landmark_priors,
    }  # fmt: skip


def content_of(back_end: BackEnd, params: Parameters, grid: OccupancyGrid | None) -> Content:
    """The current map. Raises MapError if there is none."""
    if not back_end.keyframes:
        raise MapError('there is no map yet')
    graph, found = back_end.graph, back_end.reflectors()
    arrays: dict[str, NDArray[Any]] = {
        'pose': graph.poses, 'pose_fixed': graph.fixed_poses,
        'landmark': graph.landmarks, 'landmark_fixed': graph.fixed_landmarks,
        **arrays_of(back_end.keyframes), **saved_state.arrays_of(back_end),
        'reflector_map': found.points, 'reflector_cov': found.cov,
        **{f'reflector_map_{name}': getattr(found, name) for name in MADE},
    }  # fmt: skip
    for name, table in tables(graph).items():
        for column in COLUMNS:
            arrays[f'{name}_{column}'] = getattr(table, column)
    description: dict[str, Any] = {
        'format': FORMAT,
        'version': VERSION,
        'program': __version__,
        'parameters': dataclasses.asdict(params),
    }
    survey_frame = back_end.survey_frame
    if survey_frame is not None and survey_frame.found:
        arrays |= {
            f'survey_{name}': array for name, array in survey_frame.survey._asdict().items()
        }
    description['id'] = SavedMap(found, grid).id
    if grid is not None:
        arrays['grid'] = grid.cells
        description['grid'] = {'resolution': grid.resolution, 'origin': list(grid.origin)}
        if grid.yaw:
            description['grid']['yaw'] = grid.yaw
    return Content(arrays, description)


def arrays_of(keys: list[Keyframe]) -> dict[str, NDArray[Any]]:
    """Keyframes and their scans as arrays of the file."""
    points = [k.points for k in keys if k.points is not None]
    return {
        'key_stamp': np.array([k.stamp for k in keys], dtype=np.int64),
        'key_scan_stamp': np.array([k.scan_stamp for k in keys], dtype=np.int64),
        'key_detector_ran': np.array([k.detector_ran for k in keys]),
        'key_jumped': np.array([k.jumped for k in keys]),
        'key_local': np.array([k.T_local for k in keys]),
        'key_cov': np.array([k.cov_local for k in keys]),
        'key_origin': np.array([np.zeros(2) if k.origin is None else k.origin for k in keys]),
        'key_points': np.array([-1 if k.points is None else len(k.points) for k in keys]),
        'points': np.concatenate([np.zeros((0, 2), dtype=np.float32), *points]),
    }


def save(path: str | Path, back_end: BackEnd, params: Parameters) -> Path:
    """Write the current map; the previous file stays beside it. Raises MapError."""
    return map_container.write(path, content_of(back_end, params, back_end.occupancy_grid()))


def load(path: str | Path) -> Content:
    """Read and check a file. Raises MapError or FileFormatError."""
    content = map_container.read(path)
    kind, version = (content.description.get(k) for k in ('format', 'version'))
    if kind != FORMAT or version != VERSION:
        raise FileFormatError(
            f'{path}: format {kind} {version}, but this program reads {FORMAT} {VERSION}'
        )
    return content


def saved_map(content: Content) -> SavedMap:
    """Reflectors and grid for localization."""
    a, d = content.arrays, content.description
    with consistent():
        reflectors = Reflectors(
            a['reflector_map_keys'], a['reflector_map'], a['reflector_cov'],
            a['reflector_map_ids'], a['reflector_map_sightings'], a['reflector_map_diameters'],
        )  # fmt: skip
        if 'grid' not in a:
            return SavedMap(reflectors)
        (x, y), yaw = d['grid']['origin'], float(d['grid'].get('yaw', 0.0))
        grid = OccupancyGrid(float(d['grid']['resolution']), (x, y), a['grid'], yaw)
        return SavedMap(reflectors, grid)


def survey_of(content: Content) -> Survey | None:
    """The survey whose frame the map has, None where the map has a frame of its own."""
    a = content.arrays
    if 'survey_points' not in a:
        return None
    return Survey(a['survey_ids'], a['survey_points'], a['survey_diameters'])


def restore(content: Content, back_end: BackEnd) -> None:
    """Continue the map with an empty back end.

    Raises FileFormatError if its parts are inconsistent, MapError if it has the frame of another
    survey.
    """
    a = content.arrays
    with consistent():
        fill(back_end.graph, a)
        saved_state.restore(back_end, _keyframes(a), a, survey_of(content))


def revoked(content: Content, number: int) -> tuple[Content, Closure]:
    """A map without one of its loop closures, solved again, and the record of the closure.

    Raises SolverError if there is none of this number.
    """
    params = parameters_of(content)
    back_end = BackEnd(params)
    restore(content, back_end)
    closure = back_end.revoke(number)
    grid = back_end.occupancy_grid() if 'grid' in content.arrays else None
    out = content_of(back_end, params, grid)
    kept = {name: content.arrays[name] for name in ('path', 'path_motion')}
    return Content({**out.arrays, **kept}, out.description), closure


def fill(graph: Graph, a: Arrays) -> None:
    """Add the saved nodes and factors to an empty graph."""
    graph.add_poses(a['pose'])
    graph.poses[:] = a['pose']  # bit-identical: wrapping an angle again may change it
    graph.fixed_poses[:] = a['pose_fixed']
    graph.add_landmarks(a['landmark'])
    graph.fixed_landmarks[:] = a['landmark_fixed']
    n, m = len(a['pose']), len(a['landmark'])
    sizes = {'edge': (n, n), 'sighted': (n, m), 'pose_prior': (n,), 'landmark_prior': (m,)}
    for name, table in tables(graph).items():
        nodes, measured, information, kinds, enabled = (a[f'{name}_{c}'] for c in COLUMNS)
        table.append(
            [FactorKind(k) for k in kinds.tolist()], nodes, measured, information, sizes[name]
        )
        table.enabled[:] = enabled


def keyframes_of(content: Content) -> list[Keyframe]:
    """The keyframes of a map, with their scans. Raises FileFormatError."""
    with consistent():
        return _keyframes(content.arrays)


def _keyframes(a: Arrays) -> list[Keyframe]:
    counts = a['key_points']
    ends = np.cumsum(np.maximum(counts, 0))
    rows = zip(
        a['pose'], counts.tolist(), ends.tolist(), a['key_stamp'].tolist(), a['key_local'],
        a['key_cov'], a['key_origin'], a['key_scan_stamp'].tolist(), strict=True,
    )  # fmt: skip
    out = []
    for k, (_, count, end, stamp, T_local, cov, origin, scan_stamp) in enumerate(rows):
        points = a['points'][end - count : end].copy() if count >= 0 else None
        place = origin.copy() if count >= 0 else None
        detector_ran, jumped = bool(a['key_detector_ran'][k]), bool(a['key_jumped'][k])
        out.append(
            Keyframe(
                k, stamp, T_local.copy(), cov.copy(), points, place, scan_stamp, detector_ran,
                jumped,
            )
        )  # fmt: skip
    return out
