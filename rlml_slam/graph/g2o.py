# SPDX-License-Identifier: Apache-2.0
"""Pose-landmark graphs as text files: g2o and TORO, plain or gzipped.

g2o    VERTEX_SE2 id x y th, VERTEX_XY id x y, FIX id ..., EDGE_SE2 i j dx dy dth I11 I12 I13 I22
       I23 I33, EDGE_SE2_XY i j dx dy I11 I12 I22, EDGE_PRIOR_SE2, EDGE_PRIOR_XY, and, which g2o
       itself does not have, EDGE_RANGE_SE2_XY i j r I11: the distance of VERTEX_XY j from i
TORO   VERTEX2 id x y th, EDGE2 i j dx dy dth I11 I12 I22 I33 I13 I23

I is the information matrix of the residual (factors.py). What concerns no factor (DATA_*,
PARAMS_*, EQUIV ...) is skipped and counted. A file without FIX and priors has its first pose
fixed, as g2o does.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.model.factor_table import is_positive_definite
from rlml_slam.graph.model.factors import FactorKind, Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array, rotation
from rlml_slam.types import EdgeKind

# upper triangle of the information matrix by rows, and in TORO's order
MAX_SIZE = 1 << 31  # bytes, unpacked
LARGEST = 1e150  # its square is finite
UPPER_3 = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
TORO_3 = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
UPPER_2 = ((0, 0), (0, 1), (1, 1))

# tag: number of ids, number of values (measured + information)
TAGS = {
    'VERTEX_SE2': (1, 3), 'VERTEX2': (1, 3), 'VERTEX_XY': (1, 2),
    'EDGE_SE2': (2, 9), 'EDGE2': (2, 9), 'EDGE_SE2_XY': (2, 5),
    'EDGE_PRIOR_SE2': (1, 9), 'EDGE_PRIOR_XY': (1, 5), 'EDGE_RANGE_SE2_XY': (2, 2),
}  # fmt: skip
ALIASES = {'VERTEX_POINT_XY': 'VERTEX_XY', 'EDGE_POINT_XY': 'EDGE_SE2_XY'}


@dataclass(frozen=True)
class GraphFile:
    """A graph with the ids that its nodes have in the file, and counts of the lines skipped."""

    graph: Graph
    pose_ids: NDArray[np.int64]
    landmark_ids: NDArray[np.int64]
    skipped: Mapping[str, int] = field(default_factory=dict)


@dataclass
class _Lines:
    """The lines of one tag: ids, values, and line numbers for messages."""

    ids: list[list[int]] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)


def read_graph(path: Path | str, losses: Losses | None = None) -> GraphFile:
    """Read a g2o or TORO file.

    Poses without a VERTEX line start from the spanning tree of the edges. An edge between
    poses that follow each other is odometry, any other a closure. Raises FileFormatError naming
    file and line.
    """
    path = Path(path)
    lines, fixed, skipped = _parse(path)
    graph = Graph(losses)
    pose_ids = _add_vertices(path, graph, lines)
    landmark_ids = _add_landmarks(path, graph, lines)
    poses = {int(v): k for k, v in enumerate(pose_ids)}
    landmarks = {int(v): k for k, v in enumerate(landmark_ids)}
    _add_edges(path, graph, lines, poses)
    _add_sightings(path, graph, lines, poses, landmarks)
    _add_priors(path, graph, lines, poses, landmarks)
    for number, node in fixed:
        if node in poses:
            graph.fixed_poses[poses[node]] = True
        elif node in landmarks:
            graph.fixed_landmarks[landmarks[node]] = True
        else:
            raise FileFormatError(f'{path}:{number}: FIX of unknown vertex {node}')
    if len(pose_ids) and not (fixed or len(graph.pose_priors) or len(graph.landmark_priors)):
        graph.fixed_poses[0] = True
    if not (lines['VERTEX_SE2'].ids or lines['VERTEX2'].ids):
        initialize(graph, 'spanning_tree')
    return GraphFile(graph, pose_ids, landmark_ids, dict(skipped))


def _parse(path: Path) -> tuple[dict[str, _Lines], list[tuple[int, int]], Counter[str]]:
    try:
        raw = path.read_bytes()
        if raw[:2] == b'\x1f\x8b':
            with gzip.open(io.BytesIO(raw)) as f:
                raw = f.read(MAX_SIZE + 1)
        if len(raw) > MAX_SIZE:
            raise ValueError(f'more than {MAX_SIZE} bytes')
        text = raw.decode('ascii')
    except UnicodeDecodeError as error:
        message = f'{path}: no g2o or TORO file, which is ASCII: byte {error.start} is not'
        raise FileFormatError(message) from None
    except (ValueError, OSError, EOFError, zlib.error) as error:
        raise FileFormatError(f'{path}: cannot be read: {error}') from None
    lines = {tag: _Lines() for tag in TAGS}
    fixed: list[tuple[int, int]] = []
    skipped: Counter[str] = Counter()
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith('#'):
            continue
        tag = ALIASES.get(words[0], words[0])
        if tag == 'FIX':
            fixed += [(number, node) for node in _ids(path, number, words[1:])]
        elif tag in TAGS:
            num_ids, num_values = TAGS[tag]
            if len(words) != 1 + num_ids + num_values:
                raise FileFormatError(
                    f'{path}:{number}: {tag} has {len(words) - 1} values instead of '
                    f'{num_ids + num_values}'
                )
            lines[tag].ids.append(_ids(path, number, words[1 : 1 + num_ids]))
            lines[tag].values.append(_values(path, number, words[1 + num_ids :]))
            lines[tag].numbers.append(number)
        elif tag.startswith(('VERTEX', 'EDGE')):
            raise FileFormatError(f'{path}:{number}: {tag} is not a 2D pose or landmark graph')
        elif tag.replace('_', '').isalnum() and not tag[0].isdigit():
            skipped[tag] += 1
        else:
            raise FileFormatError(f'{path}:{number}: {line[:40]!r} is no g2o or TORO line')
    if not any(lines[tag].ids for tag in TAGS):
        raise FileFormatError(f'{path}: no vertices and no edges')
    return lines, fixed, skipped


def _ids(path: Path, number: int, words: Sequence[str]) -> list[int]:
    try:
        ids = [int(word) for word in words]
    except ValueError as error:
        raise FileFormatError(f'{path}:{number}: bad vertex id: {error}') from None
    if not all(abs(value) < 1 << 62 for value in ids):
        raise FileFormatError(f'{path}:{number}: bad vertex id: too large')
    return ids


def _values(path: Path, number: int, words: Sequence[str]) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise FileFormatError(f'{path}:{number}: {error}') from None
    if not (np.abs(values) < LARGEST).all():
        raise FileFormatError(f'{path}:{number}: a value is not finite, or beyond {LARGEST:g}')
    return values


def _add_vertices(path: Path, graph: Graph, lines: dict[str, _Lines]) -> NDArray[np.int64]:
    vertices = [lines['VERTEX_SE2'], lines['VERTEX2']]
    ids = [i[0] for one in vertices for i in one.ids]
    values = [v for one in vertices for v in one.values]
    if not ids:
        ends = {i for tag in ('EDGE_SE2', 'EDGE2') for pair in lines[tag].ids for i in pair}
        ids = sorted(ends)
        values = [[0.0, 0.0, 0.0]] * len(ids)
    _unique(path, ids, [n for one in vertices for n in one.numbers])
    graph.add_poses(np.array(values, dtype=np.float64).reshape(-1, 3))
    return np.array(ids, dtype=np.int64)


def _add_landmarks(path: Path, graph: Graph, lines: dict[str, _Lines]) -> NDArray[np.int64]:
    one = lines['VERTEX_XY']
    ids = [i[0] for i in one.ids]
    _unique(path, ids, one.numbers)
    graph.add_landmarks(np.array(one.values, dtype=np.float64).reshape(-1, 2))
    return np.array(ids, dtype=np.int64)


def _unique(path: Path, ids: list[int], numbers: list[int]) -> None:
    seen: set[int] = set()
    for i, number in zip(ids, numbers, strict=False):
        if i in seen:
            raise FileFormatError(f'{path}:{number}: vertex {i} is declared twice')
        seen.add(i)


def _nodes(path: Path, one: _Lines, maps: tuple[dict[int, int], ...]) -> NDArray[np.int64]:
    rows = []
    for ids, number in zip(one.ids, one.numbers, strict=True):
        try:
            rows.append([known[i] for known, i in zip(maps, ids, strict=True)])
        except KeyError as error:
            raise FileFormatError(f'{path}:{number}: unknown vertex {error.args[0]}') from None
    return np.array(rows, dtype=np.int64).reshape(-1, len(maps))


def _symmetric(values: Array, order: tuple[tuple[int, int], ...], d: int) -> Array:
    out = np.zeros((len(values), d, d))
    for column, (r, c) in enumerate(order):
        out[:, r, c] = out[:, c, r] = values[:, column]
    return out


def _add_edges(path: Path, graph: Graph, lines: dict[str, _Lines], poses: dict[int, int]) -> None:
    for tag, order in (('EDGE_SE2', UPPER_3), ('EDGE2', TORO_3)):
        one = lines[tag]
        nodes = _nodes(path, one, (poses, poses))
        v = np.array(one.values, dtype=np.float64).reshape(-1, 9)
        info = _symmetric(v[:, 3:], order, 3)
        _check(path, one, info, nodes)
        kinds = [
            EdgeKind.ODOMETRY if near else EdgeKind.CLOSURE
            for near in np.abs(nodes[:, 0] - nodes[:, 1]) == 1
        ]
        graph.add_edges(kinds, nodes, v[:, :3], info)


def _check(path: Path, one: _Lines, information: Array, nodes: NDArray[np.int64]) -> None:
    good = is_positive_definite(information)
    if not good.all():
        number = one.numbers[int(np.argmin(good))]
        raise FileFormatError(f'{path}:{number}: information is not positive definite')
    same = nodes[:, 0] == nodes[:, -1] if nodes.shape[1] == 2 else np.zeros(len(nodes), np.bool_)
    if same.any():
        number = one.numbers[int(np.argmax(same))]
        raise FileFormatError(f'{path}:{number}: both ends are the same vertex')


def _add_sightings(
    path: Path, graph: Graph, lines: dict[str, _Lines], poses: dict[int, int],
    landmarks: dict[int, int],
) -> None:  # fmt: skip
    one = lines['EDGE_SE2_XY']
    nodes = _nodes(path, one, (poses, landmarks))
    v = np.array(one.values, dtype=np.float64).reshape(-1, 5)
    info = _symmetric(v[:, 2:], UPPER_2, 2)
    _check(path, one, info, nodes[:, :1])
    graph.add_sightings(nodes, v[:, :2], info)
    one = lines['EDGE_RANGE_SE2_XY']
    nodes = _nodes(path, one, (poses, landmarks))
    v = np.array(one.values, dtype=np.float64).reshape(-1, 2)
    _check(path, one, v[:, 1:, None], nodes[:, :1])
    if (v[:, 0] < 0.0).any():
        number = one.numbers[int(np.argmax(v[:, 0] < 0.0))]
        raise FileFormatError(f'{path}:{number}: the range is negative')
    graph.add_ranges(nodes, v[:, 0], v[:, 1])


def _add_priors(
    path: Path, graph: Graph, lines: dict[str, _Lines], poses: dict[int, int],
    landmarks: dict[int, int],
) -> None:  # fmt: skip
    one = lines['EDGE_PRIOR_SE2']
    nodes = _nodes(path, one, (poses,))
    v = np.array(one.values, dtype=np.float64).reshape(-1, 9)
    info = _symmetric(v[:, 3:], UPPER_3, 3)
    _check(path, one, info, nodes)
    for (i,), pose, matrix in zip(nodes, v[:, :3], info, strict=True):
        B = _axes(pose)
        graph.add_pose_prior(int(i), pose, B @ matrix @ B.T)
    one = lines['EDGE_PRIOR_XY']
    nodes = _nodes(path, one, (landmarks,))
    v = np.array(one.values, dtype=np.float64).reshape(-1, 5)
    info = _symmetric(v[:, 2:], UPPER_2, 2)
    _check(path, one, info, nodes)
    for (k,), point, matrix in zip(nodes, v[:, :2], info, strict=True):
        graph.add_landmark_prior(int(k), point, matrix)


def _axes(pose: Array) -> Array:
    """From the axes of a prior, in which g2o has its residual, to those of the map, as ours."""
    B = np.eye(3)
    B[:2, :2] = rotation(pose[2])
    return B


def write_graph(
    path: Path | str,
    graph: Graph,
    pose_ids: Sequence[int] | NDArray[np.int64] | None = None,
    landmark_ids: Sequence[int] | NDArray[np.int64] | None = None,
) -> None:
    """Write g2o, or TORO where the name ends in .graph or .toro; gzipped where it ends in .gz.

    Disabled factors are left out. Numbers read back to the same bits. TORO has no landmarks, no
    priors and no FIX: FileFormatError if the graph has landmarks or priors.
    """
    path = Path(path)
    n = len(graph.poses)
    pose_ids = np.arange(n) if pose_ids is None else np.asarray(pose_ids)
    if landmark_ids is None:
        landmark_ids = int(np.max(pose_ids, initial=-1)) + 1 + np.arange(len(graph.landmarks))
    toro = {'.graph', '.toro'} & set(path.suffixes)
    write = _toro_lines if toro else _g2o_lines
    text = '\n'.join(write(path, graph, pose_ids, np.asarray(landmark_ids))) + '\n'
    data = text.encode('ascii')
    # mtime 0: the same graph gives the same bytes
    path.write_bytes(gzip.compress(data, mtime=0) if path.suffix == '.gz' else data)


def _row(tag: str, ids: Sequence[int], *values: Array | np.float64) -> str:
    numbers = [repr(float(x)) for v in values for x in np.ravel(v)]
    return ' '.join([tag, *map(str, ids), *numbers])


def _pick(matrix: Array, order: tuple[tuple[int, int], ...]) -> Array:
    return np.array([matrix[r, c] for r, c in order])


def _g2o_lines(
    path: Path, graph: Graph, pose_ids: NDArray[np.int64], landmark_ids: NDArray[np.int64]
) -> list[str]:
    out = [_row('VERTEX_SE2', [i], x) for i, x in zip(pose_ids, graph.poses, strict=True)]
    out += [_row('VERTEX_XY', [i], m) for i, m in zip(landmark_ids, graph.landmarks, strict=True)]
    e, s, p, q = graph.edges, graph.sightings, graph.pose_priors, graph.landmark_priors
    for k in np.flatnonzero(e.enabled):
        upper = _pick(e.information[k], UPPER_3)
        out.append(_row('EDGE_SE2', pose_ids[e.nodes[k]], e.measured[k], upper))
    for k in np.flatnonzero(s.enabled):
        ids = [pose_ids[s.nodes[k, 0]], landmark_ids[s.nodes[k, 1]]]
        if s.kinds[k] == FactorKind.RANGE:
            out.append(_row('EDGE_RANGE_SE2_XY', ids, s.measured[k, 0], s.information[k, 0, 0]))
            continue
        out.append(_row('EDGE_SE2_XY', ids, s.measured[k], _pick(s.information[k], UPPER_2)))
    for k in np.flatnonzero(p.enabled):
        B = _axes(p.measured[k])
        upper = _pick(B.T @ p.information[k] @ B, UPPER_3)
        out.append(_row('EDGE_PRIOR_SE2', pose_ids[p.nodes[k]], p.measured[k], upper))
    for k in np.flatnonzero(q.enabled):
        upper = _pick(q.information[k], UPPER_2)
        out.append(_row('EDGE_PRIOR_XY', landmark_ids[q.nodes[k]], q.measured[k], upper))
    # last: readG2o of GTSAM reads no edge behind a line that it does not know
    out += [f'FIX {i}' for i in pose_ids[graph.fixed_poses]]
    out += [f'FIX {i}' for i in landmark_ids[graph.fixed_landmarks]]
    return out


def _toro_lines(
    path: Path, graph: Graph, pose_ids: NDArray[np.int64], landmark_ids: NDArray[np.int64]
) -> list[str]:
    if len(landmark_ids) or len(graph.pose_priors) or len(graph.sightings):
        raise FileFormatError(f'{path}: TORO holds poses and edges alone; write g2o')
    out = [_row('VERTEX2', [i], x) for i, x in zip(pose_ids, graph.poses, strict=True)]
    e = graph.edges
    for k in np.flatnonzero(e.enabled):
        values = _pick(e.information[k], TORO_3)
        out.append(_row('EDGE2', pose_ids[e.nodes[k]], e.measured[k], values))
    return out
