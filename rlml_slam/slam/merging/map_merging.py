# SPDX-License-Identifier: Apache-2.0
"""Maps of several sessions as one: placed, tied by reflectors and closures, solved as a whole.

Each map is put where its session lies (site_tree). Reflectors that are the same are merged, the
scans are matched with the submaps of the maps before, and the whole graph is solved. One map at
a time is read; what stays in memory is the merged one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError, RlmlError
from rlml_slam.graph import relative_information
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.survey import Survey, same
from rlml_slam.matching.scans.packed_submap import PackedSubmap, Unpacked
from rlml_slam.params import LoopClosure, Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.back_end.scan_graph import SavedSubmap, saved_submaps
from rlml_slam.slam.back_end.trajectory import poses_of
from rlml_slam.slam.keyframes import JUMP_SIGMA
from rlml_slam.slam.merging.placement import Placement
from rlml_slam.slam.merging.site_map import Session, Site, session_of
from rlml_slam.slam.merging.site_tree import Mapper, Placed, in_this_process, place_sessions
from rlml_slam.slam.store import map_file
from rlml_slam.types import EdgeKind

Arrays = dict[str, NDArray[Any]]
SHARE = 0.9  # of a map's keyframes whose stamps are in another one that has all of its drive
ALIKE = 0.5  # of its reflectors that are where the other one has some
NEAR, BENT = 0.4, 0.05  # [m], share of its extent by which the paths of one drive may differ


class Drive(NamedTuple):
    """``stamps`` (n,) and ``points`` (n, 2) of a session's ``num_keys`` keyframes and path."""

    session: Session
    stamps: NDArray[np.int64]
    points: Array
    num_keys: int


@dataclass(frozen=True)
class Merged:
    """Merged map; ``poses`` (n, 3) of the maps in its frame before the solve.

    ``content`` is to be saved, with the trajectories of all maps. ``joined`` reflectors were found
    to be one with another, ``closures`` accepted between maps.
    """

    back_end: BackEnd
    content: Content
    poses: Array
    joined: int
    closures: int


def merge_files(
    paths: Sequence[Path], params: Parameters, survey: Survey | None = None,
    run: Mapper = in_this_process,
) -> tuple[Merged, Placed]:  # fmt: skip
    """The map of many files, and which of them are in it. Raises MapError where no two fit."""
    if len({path.resolve() for path in paths}) < len(paths) or len(paths) < 2:
        raise MapError('two maps at least, and none twice, are needed to merge')
    read = run(read_session, paths)
    sessions, again = once_each([found for found in read if not isinstance(found, str)])
    broken = {
        str(path): Placement(None, why)
        for path, why in zip(paths, read, strict=True)
        if isinstance(why, str)
    } | again
    own = survey_of_all(sessions)
    if survey is not None and own is not None and not same(survey, own):
        raise MapError('a map was made with another survey than the one given')
    survey = own if survey is None else survey
    placed = place_sessions(sessions, params, survey, run) if sessions else None
    if placed is None or len(placed.site.sessions) < 2:
        doubts = broken if placed is None else placed.left_out | broken
        why = '; '.join(f'{name}: {doubt.why}' for name, doubt in doubts.items())
        raise MapError(f'no two of the maps fit together at exactly one pose: {why}')
    placed.left_out.update(broken)
    return assemble(placed, _loaded, params, survey), placed


def read_session(path: Path) -> Drive | str:
    """What placing needs of a map's file, or what is wrong with the file."""
    try:
        content = map_file.load(path)
        with map_file.consistent():
            a, session = content.arrays, session_of(str(path), content, path)
            poses = np.concatenate([a['pose'], poses_of(a['path'], a['path_motion'], a['pose'])])
            stamps = np.concatenate([a['key_stamp'], a['path']['stamp']])
            return Drive(session, stamps, poses[:, :2], len(a['pose']))
    except RlmlError as e:
        return str(e)


def once_each(drives: Sequence[Drive]) -> tuple[list[Session], dict[str, Placement]]:
    """Sessions of different drives, and why others are left out: the first largest map stays."""
    kept: list[Drive] = []
    again: dict[str, Placement] = {}
    for own in sorted(drives, key=lambda d: -d.num_keys):
        name, same_as = own.session.name, [k.session.name for k in kept if _is_same(own, k)]
        if same_as:
            why = f'{name} and {same_as[0]} are maps of one drive, which is used once'
            again[name] = Placement(None, why)
        else:
            kept.append(own)
    return [d.session for d in drives if d.session.name not in again], again


def _is_same(a: Drive, b: Drive) -> bool:
    """Whether b has stamps, path and reflectors of a; simulated drives may share the stamps."""
    stamps, i, j = np.intersect1d(a.stamps, b.stamps, return_indices=True)
    if np.isin(a.stamps[: a.num_keys], stamps[stamps > 0]).mean() < SHARE:
        return False
    there = b.points[j]
    T = se2.align(a.points[i], there)
    limit = max(NEAR, BENT * float(np.hypot(*(there - there.mean(axis=0)).T).max()))
    if np.median(np.hypot(*(se2.transform(T, a.points[i]) - there).T)) > limit:
        return False
    few, many = sorted((se2.transform(T, a.session.points), b.session.points), key=len)
    gap = np.linalg.norm(few[:, None] - many, axis=-1)
    return not len(few) or bool((gap.min(axis=1) < limit).mean() >= ALIKE)


def _loaded(session: Session) -> Content:
    assert session.path is not None
    return map_file.load(session.path)


def survey_of_all(sessions: Iterable[Session]) -> Survey | None:
    """The survey in whose frame maps were made, if any was; MapError where there are several."""
    surveys = [s.survey for s in sessions if s.survey is not None]
    if not all(same(surveys[0], other) for other in surveys):
        raise MapError('the maps were made with different surveys')
    return surveys[0] if surveys else None


def assemble(
    placed: Placed, read: Callable[[Session], Content], params: Parameters,
    survey: Survey | None = None,
) -> Merged:  # fmt: skip
    """The map of all sessions of a site, each read by ``read``.

    Its frame is that of the survey, if a session was placed by it, else that of the first session.
    """
    site = placed.site
    poses = site.poses
    if not placed.is_in_survey_frame:
        poses = se2.between(poses[0], poses)
    maps: list[Arrays] = []
    submaps: list[SavedSubmap] = []
    sizes, unpacked = [Sizes()], Unpacked()
    for session, T in zip(site.sessions, poses, strict=True):
        given, description = read(session)
        own = _moved(dict(given), T, is_first=not maps)
        del given
        own.pop('grid', None)  # another one is drawn
        after = sizes[-1].after(own)
        own = _shifted(own, sizes[-1])
        submaps += _packed(own, params, unpacked)
        maps.append(own)
        sizes.append(after)
    arrays = _joined(maps)
    if survey is not None and placed.is_in_survey_frame:
        arrays |= {f'survey_{name}': array for name, array in survey._asdict().items()}
    back_end = BackEnd(params, survey)
    map_file.restore(Content(arrays, description), back_end)
    paths = {name: arrays[name] for name in ('path', 'path_motion')}
    arrays.clear()
    back_end.scan_graph.add_finished(submaps, back_end.keyframes)
    first_pose = [n.poses for n in sizes[:-1]]
    for begin in first_pose[1:]:
        _connect(back_end, begin)
    joined = _tie(back_end, site, [n.keys for n in sizes[:-1]])
    back_end.optimize_after_join()
    accepted = _close(back_end, first_pose, params.loop_closure)
    back_end.optimize(final=True)
    made = map_file.content_of(back_end, params, back_end.occupancy_grid())
    content = Content({**made.arrays, **paths}, made.description)
    return Merged(back_end, content, poses, joined, accepted)


def _tie(back_end: BackEnd, site: Site, offsets: list[int]) -> int:
    """Reflectors that several sessions have seen become one; how many were joined to another."""
    known: dict[int, int] = {}
    joined = 0
    for session, rows, offset in zip(site.sessions, site.rows, offsets, strict=True):
        for key, row in zip((session.keys + offset).tolist(), rows.tolist(), strict=True):
            if known.setdefault(row, key) != key:
                back_end.reflector_graph.join(known[row], key)
                joined += 1
    return joined


def _connect(back_end: BackEnd, begin: int) -> None:
    """Weak edge to the first keyframe of another map, as over a jump."""
    graph = back_end.graph
    delta = se2.between(graph.poses[begin - 1], graph.poses[begin])
    information = relative_information(delta, np.diag(JUMP_SIGMA**2))
    graph.add_edge(EdgeKind.ODOMETRY, begin - 1, begin, delta, information)


def _close(back_end: BackEnd, first_pose: list[int], p: LoopClosure) -> int:
    """Loop closures of each map's keyframes with the submaps of the maps before; how many.

    Then a map's submaps replace those before that they cover, so that their number is bounded by
    the area.
    """
    accepted, graph = 0, back_end.scan_graph
    for begin, end in itertools.pairwise([*first_pose, len(back_end.keyframes)]):
        before = [m for m in graph.finished if m.anchor.index < begin]
        for key in back_end.keyframes[begin : end : p.keyframe_interval]:
            points = graph.thinned(key)
            if points is not None and before and p.enabled:
                closures = back_end.loop_closer.match(key, points, before)
                accepted += sum(c.accepted for c in closures)
        if before:
            graph.drop_covered([m for m in graph.finished if begin <= m.anchor.index < end])
    return accepted


def _packed(a: Arrays, params: Parameters, unpacked: Unpacked) -> Iterator[SavedSubmap]:
    """The submaps of a map, with compressed cells, which leave its arrays."""
    own = {name: a[name] for name in list(a) if name.startswith('submap_')}
    for name, array in own.items():
        a[name] = array[:0].copy()  # a view would hold all of them
    for s in saved_submaps(own, params.submap):
        yield s._replace(submap=PackedSubmap(s.submap, unpacked))


def _keys(a: Any) -> list[int]:
    return [*a['reflector_key'].tolist(), *a['reflector_alias'].ravel().tolist(),
            *a['reflector_removed']['key'].tolist()]  # fmt: skip


def _moved(a: Arrays, T: Array, is_first: bool) -> Arrays:
    """Arrays of a map moved by T (3,); what is relative to keyframes does not change."""
    if is_first and not T.any():
        return a
    R = se2.rotation(T[2])
    removed = a['reflector_removed'].copy()
    removed['place'] = se2.transform(T, removed['place'])
    jumped = a['key_jumped'].copy()
    jumped[:1] |= not is_first  # no motion leads there from the map before
    return a | {
        'pose': se2.compose(T, a['pose']),
        'landmark': se2.transform(T, a['landmark']),
        'landmark_prior_measured': se2.transform(T, a['landmark_prior_measured']),
        'landmark_prior_information': R @ a['landmark_prior_information'] @ R.T,
        'key_jumped': jumped,
        'reflector_removed': removed,
        'reflector_view': a['reflector_view'][:0],  # the cells are others
        'pose_fixed': a['pose_fixed'] & is_first,
    }


class Sizes(NamedTuple):
    """Of the maps so far: what the indices and keys of the next one come after."""

    poses: int = 0
    landmarks: int = 0
    edges: int = 0
    sightings: int = 0
    closures: int = 0
    keys: int = 0

    def after(self, a: Arrays) -> Sizes:
        """With one more map."""
        return Sizes(
            self.poses + len(a['pose']), self.landmarks + len(a['landmark']),
            self.edges + len(a['edge_nodes']), self.sightings + len(a['sighted_nodes']),
            self.closures + 1 + int(a['closure_state'][:, 0].max(initial=-1)),
            self.keys + 1 + int(max(_keys(a), default=-1)),
        )  # fmt: skip


def _shifted(b: Arrays, n: Sizes) -> Arrays:
    """Arrays of a map, its indices and keys after those of the maps before."""
    sighting, removed, state, path = (
        b[name].copy() for name in ('sighting', 'reflector_removed', 'closure_state', 'path')
    )
    path['key'] += n.poses
    sighting['pose'] += n.poses
    sighting['factor'] = _after(sighting['factor'], n.sightings)
    removed['key'] += n.keys
    state[:, 0] = _after(state[:, 0], n.closures)
    return b | {
        'edge_nodes': b['edge_nodes'] + n.poses,
        'sighted_nodes': b['sighted_nodes'] + (n.poses, n.landmarks),
        'pose_prior_nodes': b['pose_prior_nodes'] + n.poses,
        'landmark_prior_nodes': b['landmark_prior_nodes'] + n.landmarks,
        'submap_anchor': b['submap_anchor'] + n.poses,
        'closure': np.column_stack(
            [b['closure'][:, :2] + n.poses, _after(b['closure'][:, 2], n.edges)]
        ),
        'closure_state': state,
        'reflector_key': b['reflector_key'] + n.keys,
        'reflector_node': _after(b['reflector_node'], n.landmarks),
        'reflector_seen_together': b['reflector_seen_together'] + n.keys,
        'reflector_alias': b['reflector_alias'] + n.keys,
        'reflector_removed': removed,
        'sighting': sighting,
        'path': path,
    }  # fmt: skip


def _joined(maps: list[Arrays]) -> Arrays:
    """Arrays of all maps, each of which is emptied; the largest ones are never there twice."""
    motion = [maps[0]['path_motion']]
    for a, b in itertools.pairwise(maps):
        motion += [se2.between(a['pose'][-1:], b['pose'][:1]), b['path_motion']]
    out: Arrays = {'path_motion': np.concatenate(motion)}
    out['closures_tried'] = np.sum([a['closures_tried'] for a in maps], axis=0)
    path = np.concatenate([a['path'] for a in maps])
    out['path'] = path[np.argsort(path['stamp'], kind='stable')]
    skipped = (*out, 'reflector_num_added')
    for name in list(maps[0]):
        if name not in skipped and not name.startswith(('survey_', 'reflector_map')):
            out[name] = np.concatenate([a.pop(name) for a in maps])
    return out


def _after(index: NDArray[np.int64], offset: int) -> NDArray[np.int64]:
    """Indices after others; those below 0 stand for none."""
    return np.where(index >= 0, index + offset, index)
