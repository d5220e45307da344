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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError, cause
from rlml_slam.graph.batch.initialization import initialize
from rlml_slam.graph.model.factor_table import is_positive_definite
from rlml_slam.graph.model.factors import FactorKind, Losses
from rlml_slam.graph.model.graph import Graph
from rlml_slam.se2 import Array, rotation
from rlml_slam.types import EdgeKind

MAX_SIZE = 1 << 31  # bytes, unpacked
LARGEST = 1e150  # its square is finite
# entries of the information matrix: upper triangle by rows, and in TORO's order
UPPER_3 = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
TORO_3 = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
UPPER_2 = ((0, 0), (0, 1), (1, 1))
UPPER_1 = ((0, 0),)

# tag: number of ids, number of measured values, entries of the information that follow
TAGS: dict[str, tuple[int, int, tuple[tuple[int, int], ...]]] = {
    'VERTEX_SE2': (1, 3, ()), 'VERTEX2': (1, 3, ()), 'VERTEX_XY': (1, 2, ()),
    'EDGE_SE2': (2, 3, UPPER_3), 'EDGE2': (2, 3, TORO_3), 'EDGE_SE2_XY': (2, 2, UPPER_2),
    'EDGE_PRIOR_SE2': (1, 3, UPPER_3), 'EDGE_PRIOR_XY': (1, 2, UPPER_2),
    'EDGE_RANGE_SE2_XY': (2, 1, UPPER_1),
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

    path: Path
    tag: str
    ids: list[list[int]] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)

    def error(self, k: int, what: str) -> FileFormatError:
        """What is wrong with the k-th of these lines."""
        return FileFormatError(f'{self.path}:{self.numbers[k]}: {what}')

    def factors(self, *indices: Mapping[int, int]) -> tuple[NDArray[np.int64], Array, Array]:
        """Nodes (k, n), measured values (k, d) and information (k, d, d), checked.

        ``indices`` (n,) are those of the vertices by id, for each node of a factor.
        """
        rows = []
        for k, ids in enumerate(self.ids):
            try:
                rows.append([known[i] for known, i in zip(indices, ids, strict=True)])
            except KeyError as error:
                raise self.error(k, f'unknown vertex {error.args[0]}') from None
        _, d, entries = TAGS[self.tag]
        values = np.array(self.values, dtype=np.float64).reshape(-1, d + len(entries))
        information = np.zeros((len(values), d, d))
        for column, (r, c) in enumerate(entries, d):
            information[:, r, c] = information[:, c, r] = values[:, column]
        good = is_positive_definite(information)
        if not good.all():
            raise self.error(int(np.argmin(good)), 'information is not positive definite')
        nodes = np.array(rows, dtype=np.int64).reshape(-1, len(indices))
        return nodes, values[:, :d], information


def read_graph(path: Path | str, losses: Losses | None = None) -> GraphFile:
    """Read a g2o or TORO file.

    Poses without a VERTEX line start from the spanning tree of the edges. An edge between
    poses that follow each other is odometry, any other a closure. Raises FileFormatError naming
    file and line.
    """
    path = Path(path)
    lines, fixed, skipped = _parse(path)
    vertices = _vertices(lines['VERTEX_SE2'], lines['VERTEX2'])
    if not vertices:
        ends = {i for tag in ('EDGE_SE2', 'EDGE2') for pair in lines[tag].ids for i in pair}
        vertices = {i: [0.0, 0.0, 0.0] for i in sorted(ends)}
    points = _vertices(lines['VERTEX_XY'])
    graph = Graph(losses)
    graph.add_poses(list(vertices.values()))
    graph.add_landmarks(list(points.values()))
    poses = {i: k for k, i in enumerate(vertices)}
    landmarks = {i: k for k, i in enumerate(points)}
    _add_edges(graph, lines, poses)
    _add_sightings(graph, lines, poses, landmarks)
    _add_priors(graph, lines, poses, landmarks)
    for number, node in fixed:
        if node in poses:
            graph.fixed_poses[poses[node]] = True
        elif node in landmarks:
            graph.fixed_landmarks[landmarks[node]] = True
        else:
            raise FileFormatError(f'{path}:{number}: FIX of unknown vertex {node}')
    if len(poses) and not (fixed or len(graph.pose_priors) or len(graph.landmark_priors)):
        graph.fixed_poses[0] = True
    if not (lines['VERTEX_SE2'].ids or lines['VERTEX2'].ids):
        initialize(graph, 'spanning_tree')
    pose_ids, landmark_ids = (np.array(list(ids), dtype=np.int64) for ids in (poses, landmarks))
    return GraphFile(graph, pose_ids, landmark_ids, dict(skipped))


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
        if raw[:2] == b'\x1f\x8b':
            with gzip.open(io.BytesIO(raw)) as f:
                raw = f.read(MAX_SIZE + 1)
        if len(raw) > MAX_SIZE:
            raise ValueError(f'more than {MAX_SIZE} bytes')
        return raw.decode('ascii')
    except UnicodeDecodeError as error:
        message = f'{path}: no g2o or TORO file, which is ASCII: byte {error.start} is not'
        raise FileFormatError(message) from None
    except (ValueError, OSError, EOFError, zlib.error) as error:
        raise FileFormatError(f'{path}: cannot be read: {cause(error)}') from None


def _parse(path: Path) -> tuple[dict[str, _Lines], list[tuple[int, int]], Counter[str]]:
    lines = {tag: _Lines(path, tag) for tag in TAGS}
    fixed: list[tuple[int, int]] = []
    skipped: Counter[str] = Counter()
    for number, line in enumerate(_text(path).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith('#'):
            continue
        tag = ALIASES.get(words[0], words[0])
        if tag == 'FIX':
            fixed += [(number, node) for node in _ids(path, number, words[1:])]
        elif tag in TAGS:
            num_ids, num_measured, entries = TAGS[tag]
            num = num_ids + num_measured + len(entries)
            if len(words) != 1 + num:
                raise FileFormatError(
                    f'{path}:{number}: {tag} has {len(words) - 1} values instead of {num}'
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


def _vertices(*tags: _Lines) -> dict[int, list[float]]:
    """Values by id, in the order of the lines."""
    out: dict[int, list[float]] = {}
    for lines in tags:
        for k, ((i,), values) in enumerate(zip(lines.ids, lines.values, strict=True)):
            if i in out:
                raise lines.error(k, f'vertex {i} is declared twice')
            out[i] = values
    return out


def _add_edges(graph: Graph, lines: Mapping[str, _Lines], poses: Mapping[int, int]) -> None:
    for one in (lines['EDGE_SE2'], lines['EDGE2']):
        nodes, measured, information = one.factors(poses, poses)
        same = nodes[:, 0] == nodes[:, 1]
        if same.any():
            raise one.error(int(np.argmax(same)), 'both ends are the same vertex')
        kinds = [
            EdgeKind.ODOMETRY if near else EdgeKind.CLOSURE
            for near in np.abs(nodes[:, 0] - nodes[:, 1]) == 1
        ]
        graph.add_edges(kinds, nodes, measured, information)


def _add_sightings(
    graph: Graph, lines: Mapping[str, _Lines], poses: Mapping[int, int],
    landmarks: Mapping[int, int],
) -> None:  # fmt: skip
    graph.add_sightings(*lines['EDGE_SE2_XY'].factors(poses, landmarks))
    one = lines['EDGE_RANGE_SE2_XY']
    nodes, measured, information = one.factors(poses, landmarks)
    negative = measured[:, 0] < 0.0
    if negative.any():
        raise one.error(int(np.argmax(negative)), 'the range is negative')
    graph.add_ranges(nodes, measured, information)


def _add_priors(
    graph: Graph, lines: Mapping[str, _Lines], poses: Mapping[int, int],
    landmarks: Mapping[int, int],
) -> None:  # fmt: skip
    for (i,), pose, matrix in zip(*lines['EDGE_PRIOR_SE2'].factors(poses), strict=True):
        B = _axes(pose)
        graph.add_pose_prior(int(i), pose, B @ matrix @ B.T)
    for (k,), point, matrix in zip(*lines['EDGE_PRIOR_XY'].factors(landmarks), strict=True):
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
    is_toro = bool({'.graph', '.toro'} & set(path.suffixes))
    if is_toro and (len(landmark_ids) or len(graph.pose_priors) or len(graph.sightings)):
        raise FileFormatError(f'{path}: TORO holds poses and edges alone; write g2o')
    text = '\n'.join(_lines_of(graph, pose_ids, np.asarray(landmark_ids), is_toro)) + '\n'
    data = text.encode('ascii')
    # mtime 0: the same graph gives the same bytes
    path.write_bytes(gzip.compress(data, mtime=0) if path.suffix == '.gz' else data)


def _row(tag: str, ids: Iterable[int], measured: Array, information: Array | None = None) -> str:
    _, size, entries = TAGS[tag]
    numbers = measured[:size].tolist()
    if information is not None:
        numbers += [float(information[entry]) for entry in entries]
    return ' '.join([tag, *map(str, ids), *map(repr, numbers)])


def _lines_of(
    graph: Graph, pose_ids: NDArray[np.int64], landmark_ids: NDArray[np.int64], is_toro: bool
) -> list[str]:
    vertex, edge = ('VERTEX2', 'EDGE2') if is_toro else ('VERTEX_SE2', 'EDGE_SE2')
    out = [_row(vertex, [i], x) for i, x in zip(pose_ids, graph.poses, strict=True)]
    out += [_row('VERTEX_XY', [i], m) for i, m in zip(landmark_ids, graph.landmarks, strict=True)]
    e, s, p, q = graph.edges, graph.sightings, graph.pose_priors, graph.landmark_priors
    for k in np.flatnonzero(e.enabled):
        out.append(_row(edge, pose_ids[e.nodes[k]], e.measured[k], e.information[k]))
    for k in np.flatnonzero(s.enabled):
        tag = 'EDGE_RANGE_SE2_XY' if s.kinds[k] == FactorKind.RANGE else 'EDGE_SE2_XY'
        ids = [pose_ids[s.nodes[k, 0]], landmark_ids[s.nodes[k, 1]]]
        out.append(_row(tag, ids, s.measured[k], s.information[k]))
    for k in np.flatnonzero(p.enabled):
        B = _axes(p.measured[k])
        information = B.T @ p.information[k] @ B
        out.append(_row('EDGE_PRIOR_SE2', pose_ids[p.nodes[k]], p.measured[k], information))
    for k in np.flatnonzero(q.enabled):
        ids = landmark_ids[q.nodes[k]]
        out.append(_row('EDGE_PRIOR_XY', ids, q.measured[k], q.information[k]))
    if not is_toro:
        # last: readG2o of GTSAM reads no edge behind a line that it does not know
        out += [f'FIX {i}' for i in pose_ids[graph.fixed_poses]]
        out += [f'FIX {i}' for i in landmark_ids[graph.fixed_landmarks]]
    return out
