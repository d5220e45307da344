# SPDX-License-Identifier: Apache-2.0
"""Two saved maps as one: placed by their reflectors, tied by these and by loop closures.

The second map is put where the constellation of its reflectors fits that of the first, if it fits
in one place and no other; reflectors that are the same become one, its scans are matched with the
first one's submaps, and the whole graph is solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.graph.model.factors import relative_information
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

# of a map that overlaps with another, most reflectors may be of places that the other lacks; that
# what they have in common is no chance, the verdict still has to show
APART = 0.95
PATIENCE = 50  # nobody waits for a pose: a minute of searching
LATER = (
    'key_looked', 'key_jumped', 'reflector_gone', 'reflector_life', 'reflector_surveyed',
    'reflector_view',
)  # fmt: skip
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Merged:
    """The map of two; ``T_first_second`` (3,) is where the second one lay before the solve.

    ``content`` is what is saved of it, the paths of both maps included.
    """

    back_end: BackEnd
    content: Content
    T_first_second: Array
    why: str
    joined: int
    closures: int


def merge_maps(first: Content, second: Content, params: Parameters) -> Merged:
    """One map, in the frame of the first. Raises MapError where nothing tells how they lie."""
    if not all(name in c.arrays for name in LATER for c in (first, second)):
        raise MapError('one of the maps is of an older program: go on with it once, and save it')
    a, b = map_file.saved_map(first).reflectors, map_file.saved_map(second).reflectors
    surveys = map_file.survey_of(first), map_file.survey_of(second)
    if surveys[0] is not None and surveys[1] is not None and not same(surveys[0], surveys[1]):
        raise MapError('the maps have the frames of two different surveys')
    if surveys[0] is None and surveys[1] is not None:
        raise MapError('only the second map has the frame of a survey: name it first')
    alike = replace(Relocalization(), false_share=APART)
    stars = locate(b.points, b.cov, a.points, a.cov, alike, max_tests=PATIENCE * MAX_TESTS)
    if stars.verdict is not Verdict.UNIQUE:
        raise MapError(f'the reflectors do not tell how the maps lie: {stars.why}')
    best = stars.candidates[0]
    offset = 1 + int(max(_keys(first.arrays), default=-1))
    back_end = BackEnd(params)
    arrays = _joined(dict(first.arrays), _moved(dict(second.arrays), best.pose), offset)
    map_file.restore(Content(arrays, first.description), back_end)
    _tie(back_end, len(first.arrays['pose']))
    hits = np.flatnonzero(best.match >= 0)
    for k in hits.tolist():
        back_end.reflector_graph.join(int(a.keys[best.match[k]]), int(b.keys[k]) + offset)
    back_end.rejoin()
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
    return Merged(back_end, content, best.pose, stars.why, len(hits), accepted)


def _tie(back_end: BackEnd, begin: int) -> None:
    """An edge to the first keyframe of the second map, as wide as one over a jump."""
    graph = back_end.graph
    delta = se2.between(graph.poses[begin - 1], graph.poses[begin])
    information = relative_information(delta, np.diag(JUMP_SIGMA**2))
    graph.add_edge(EdgeKind.ODOMETRY, begin - 1, begin, delta, information)


def _close(back_end: BackEnd, begin: int, every: int) -> int:
    """Loop closures of the second map's keyframes with the first one's submaps; how many."""
    accepted = 0
    for key in back_end.keyframes[begin::every]:
        accepted += sum(c.accepted for c in back_end.scans.link(key, begin))
    return accepted


def _keys(a: Any) -> list[int]:
    return [*a['reflector_key'].tolist(), *a['reflector_alias'].ravel().tolist(),
            *a['reflector_gone']['key'].tolist()]  # fmt: skip


def _moved(a: Arrays, T: Array) -> Arrays:
    """The arrays of a map that lies at T (3,); what hangs on keyframes moves with them."""
    R = se2.rotation(T[2])
    gone = a['reflector_gone'].copy()
    gone['place'] = se2.transform(T, gone['place'])
    jumped = a['key_jumped'].copy()
    jumped[:1] = True  # no motion leads there from the other map
    return a | {
        'pose': se2.compose(T, a['pose']),
        'landmark': se2.transform(T, a['landmark']),
        'landmark_prior_measured': se2.transform(T, a['landmark_prior_measured']),
        'landmark_prior_information': R @ a['landmark_prior_information'] @ R.T,
        'key_jumped': jumped,
        'reflector_gone': gone,
        'reflector_view': a['reflector_view'][:0],  # cells of another floor
        'pose_fixed': np.zeros(len(a['pose']), dtype=np.bool_),
    }


def _joined(a: Arrays, b: Arrays, keys: int) -> Arrays:
    """One after the other, with the indices of the second behind those of the first."""
    poses, landmarks = len(a['pose']), len(a['landmark'])
    edges, sightings = len(a['edge_nodes']), len(a['sighted_nodes'])
    numbers = 1 + int(a['closure_fate'][:, 0].max(initial=-1))
    sighting, gone, fate, path = (
        b[n].copy() for n in ('sighting', 'reflector_gone', 'closure_fate', 'path')
    )
    path['key'] += poses
    sighting['pose'] += poses
    sighting['factor'] = _behind(sighting['factor'], sightings)
    gone['key'] += keys
    fate[:, 0] = _behind(fate[:, 0], numbers)
    shifted: Arrays = {
        'edge_nodes': b['edge_nodes'] + poses,
        'sighted_nodes': b['sighted_nodes'] + (poses, landmarks),
        'pose_prior_nodes': b['pose_prior_nodes'] + poses,
        'landmark_prior_nodes': b['landmark_prior_nodes'] + landmarks,
        'submap_anchor': b['submap_anchor'] + poses,
        'closure': np.column_stack(
            [b['closure'][:, :2] + poses, _behind(b['closure'][:, 2], edges)]
        ),
        'closure_fate': fate,
        'reflector_key': b['reflector_key'] + keys,
        'reflector_node': _behind(b['reflector_node'], landmarks),
        'reflector_beside': b['reflector_beside'] + keys,
        'reflector_alias': b['reflector_alias'] + keys,
        'reflector_gone': gone,
        'sighting': sighting,
    }  # fmt: skip
    skipped = ('grid', 'path', 'path_motion', 'closures_tried', 'reflector_came')
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


def _behind(index: NDArray[np.int64], offset: int) -> NDArray[np.int64]:
    """Indices behind others; those below 0 stand for none."""
    return np.where(index >= 0, index + offset, index)
