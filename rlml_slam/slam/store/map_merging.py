# SPDX-License-Identifier: Apache-2.0
"""Merging of two saved maps: aligned by their reflectors, connected by these and by closures.

The second map is moved to where the constellation of its reflectors fits that of the first, if it
fits at exactly one pose. Reflectors that are the same are merged, the scans are matched with the
submaps of the first map, and the whole graph is solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.graph import relative_information
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.survey import same
from rlml_slam.matching.reflectors.constellation import locate
from rlml_slam.matching.reflectors.pair_votes import MAX_TESTS
from rlml_slam.params import Parameters, Relocalization
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.keyframes import JUMP_SIGMA
from rlml_slam.slam.store import map_file
from rlml_slam.types import EdgeKind, Verdict

# most reflectors of a map may be in places that the other one does not cover
UNMATCHED_SHARE = 0.95
TEST_FACTOR = 50  # times the tests of a relocalization: no robot waits, a minute is allowed
REQUIRED = (
    'key_detector_ran', 'key_jumped', 'reflector_removed', 'reflector_history',
    'reflector_surveyed', 'reflector_view',
)  # fmt: skip
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Merged:
    """Merged map; ``T_first_second`` (3,) is the pose of the second map before the solve.

    ``content`` is to be saved, with the trajectories of both maps.
    """

    back_end: BackEnd
    content: Content
    T_first_second: Array
    why: str
    joined: int
    closures: int


def merge_maps(first: Content, second: Content, params: Parameters) -> Merged:
    """One map, in the frame of the first. Raises MapError if their reflectors do not match."""
    if not all(name in c.arrays for name in REQUIRED for c in (first, second)):
        raise MapError('one of the maps is incomplete: continue it with a drive and save it first')
    a, b = map_file.saved_map(first).reflectors, map_file.saved_map(second).reflectors
    surveys = map_file.survey_of(first), map_file.survey_of(second)
    if surveys[0] is not None and surveys[1] is not None and not same(surveys[0], surveys[1]):
        raise MapError('the maps were made with different surveys')
    if surveys[0] is None and surveys[1] is not None:
        raise MapError('only the second map has the frame of a survey: give it as the first one')
    p = replace(Relocalization(), false_share=UNMATCHED_SHARE)
    found = locate(b.points, b.cov, a.points, a.cov, p, max_tests=TEST_FACTOR * MAX_TESTS)
    if found.verdict is not Verdict.UNIQUE:
        raise MapError(f'the reflectors of the maps do not match at exactly one pose: {found.why}')
    best = found.candidates[0]
    offset = 1 + int(max(_keys(first.arrays), default=-1))
    back_end = BackEnd(params)
    arrays = _joined(dict(first.arrays), _moved(dict(second.arrays), best.pose), offset)
    map_file.restore(Content(arrays, first.description), back_end)
    _connect(back_end, len(first.arrays['pose']))
    hits = np.flatnonzero(best.match >= 0)
    for k in hits.tolist():
        back_end.reflector_graph.join(int(a.keys[best.match[k]]), int(b.keys[k]) + offset)
    back_end.optimize_after_join()
    accepted = 0
    if params.loop_closure.enabled:
        accepted = _close(
            back_end, len(first.arrays['pose']), params.loop_closure.keyframe_interval
        )
    back_end.optimize(final=True)
    grid = back_end.occupancy_grid()
    made = map_file.content_of(back_end, params, grid)
    paths = {name: arrays[name] for name in ('path', 'path_motion')}
    content = Content({**made.arrays, **paths}, made.description)
    return Merged(back_end, content, best.pose, found.why, len(hits), accepted)


def _connect(back_end: BackEnd, begin: int) -> None:
    """Weak edge to the first keyframe of the second map, as over a jump."""
    graph = back_end.graph
    delta = se2.between(graph.poses[begin - 1], graph.poses[begin])
    information = relative_information(delta, np.diag(JUMP_SIGMA**2))
    graph.add_edge(EdgeKind.ODOMETRY, begin - 1, begin, delta, information)


def _close(back_end: BackEnd, begin: int, every: int) -> int:
    """Loop closures of the second map's keyframes with the first one's submaps; how many."""
    accepted = 0
    for key in back_end.keyframes[begin::every]:
        points = back_end.scan_graph.thinned(key)
        if points is not None:
            submaps = [m for m in back_end.scan_graph.finished if m.anchor.index < begin]
            accepted += sum(c.accepted for c in back_end.loop_closer.match(key, points, submaps))
    return accepted


def _keys(a: Any) -> list[int]:
    return [*a['reflector_key'].tolist(), *a['reflector_alias'].ravel().tolist(),
            *a['reflector_removed']['key'].tolist()]  # fmt: skip


def _moved(a: Arrays, T: Array) -> Arrays:
    """Arrays of a map moved by T (3,); what is relative to keyframes does not change."""
    R = se2.rotation(T[2])
    removed = a['reflector_removed'].copy()
    removed['place'] = se2.transform(T, removed['place'])
    jumped = a['key_jumped'].copy()
    jumped[:1] = True  # no motion leads there from the first map
    return a | {
        'pose': se2.compose(T, a['pose']),
        'landmark': se2.transform(T, a['landmark']),
        'landmark_prior_measured': se2.transform(T, a['landmark_prior_measured']),
        'landmark_prior_information': R @ a['landmark_prior_information'] @ R.T,
        'key_jumped': jumped,
        'reflector_removed': removed,
        'reflector_view': a['reflector_view'][:0],  # the cells are others
        'pose_fixed': np.zeros(len(a['pose']), dtype=np.bool_),
    }


def _joined(a: Arrays, b: Arrays, keys: int) -> Arrays:
    """Arrays of both maps, the indices of the second after those of the first."""
    poses, landmarks = len(a['pose']), len(a['landmark'])
    edges, sightings = len(a['edge_nodes']), len(a['sighted_nodes'])
    numbers = 1 + int(a['closure_state'][:, 0].max(initial=-1))
    sighting, removed, state, path = (
        b[n].copy() for n in ('sighting', 'reflector_removed', 'closure_state', 'path')
    )
    path['key'] += poses
    sighting['pose'] += poses
    sighting['factor'] = _after(sighting['factor'], sightings)
    removed['key'] += keys
    state[:, 0] = _after(state[:, 0], numbers)
    shifted: Arrays = {
        'edge_nodes': b['edge_nodes'] + poses,
        'sighted_nodes': b['sighted_nodes'] + (poses, landmarks),
        'pose_prior_nodes': b['pose_prior_nodes'] + poses,
        'landmark_prior_nodes': b['landmark_prior_nodes'] + landmarks,
        'submap_anchor': b['submap_anchor'] + poses,
        'closure': np.column_stack(
            [b['closure'][:, :2] + poses, _after(b['closure'][:, 2], edges)]
        ),
        'closure_state': state,
        'reflector_key': b['reflector_key'] + keys,
        'reflector_node': _after(b['reflector_node'], landmarks),
        'reflector_seen_together': b['reflector_seen_together'] + keys,
        'reflector_alias': b['reflector_alias'] + keys,
        'reflector_removed': removed,
        'sighting': sighting,
    }  # fmt: skip
    skipped = ('grid', 'path', 'path_motion', 'closures_tried', 'reflector_num_added')
    out: Arrays = {
        name: np.concatenate([array, shifted.get(name, b[name])])
        for name, array in a.items()
        if name not in skipped and not name.startswith(('survey_', 'reflector_map'))
    }
    path = np.concatenate([a['path'], path])
    between = se2.between(a['pose'][-1:], b['pose'][:1])
    own = {name: array for name, array in a.items() if name.startswith('survey_')}
    return {
        **out,
        **own,
        'path': path[np.argsort(path['stamp'], kind='stable')],
        'path_motion': np.concatenate([a['path_motion'], between, b['path_motion']]),
        'closures_tried': a['closures_tried'] + b['closures_tried'],
    }


def _after(index: NDArray[np.int64], offset: int) -> NDArray[np.int64]:
    """Indices after others; those below 0 stand for none."""
    return np.where(index >= 0, index + offset, index)
