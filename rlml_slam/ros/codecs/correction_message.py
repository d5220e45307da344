# SPDX-License-Identifier: Apache-2.0
"""The topic ``rlml/graph_correction``: what the graph knows better than the front end.

A PointCloud2 with one point per value: those of T_map_local with the rows of the keyframe's
covariance in the map, keys of removed reflectors, and the belief, whose values have the landmark
that they belong to and their row of the joint covariance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.decode import covariances, stamp
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import bounded, build_cloud, check_fields, read_cloud
from rlml_slam.slam.conversation import Correct
from rlml_slam.types import Belief

# `kind`; an alias maps `key` to `value`, NOTHING is the only row where there is nothing else
POSE, LANDMARK, CORRECTION, ALIAS, BELIEF_REMOVED, REMOVED, NOTHING = range(7)


def _layout(width: int) -> np.dtype[np.void]:
    """One value, with ``width`` columns of covariances."""
    return np.dtype(
        [
            ('session', '<u4'),
            ('kind', 'u1'),
            ('key', '<i4'),
            ('value', '<f8'),
            ('cov', '<f8', (width,)),
        ]
    )


def build_correction(make: Make, command: Correct, map_frame: str) -> Any:
    """PointCloud2 of a correction."""
    b, correction = command.belief, command.T_map_local
    n = 3 if b is None else 3 + 2 * len(b.keys)
    rows: list[tuple[int, int, float, NDArray[np.float64]]] = []
    none = np.full(n, np.nan)
    if correction is not None:
        covs = np.full((3, n), np.nan)
        if command.cov_map is not None:
            covs[:, :3] = command.cov_map
        rows += [(CORRECTION, -1, v, c) for v, c in zip(correction, covs, strict=True)]
    rows += [(REMOVED, key, 0.0, none) for key in command.removed]
    if b is not None:
        kinds, keys = [POSE] * 3 + [LANDMARK] * (n - 3), [-1] * 3 + np.repeat(b.keys, 2).tolist()
        values = [*b.T_map_base, *b.points.ravel()]
        rows += list(zip(kinds, keys, values, b.cov, strict=True))
        rows += [(ALIAS, key, float(other), none) for key, other in b.aliases.items()]
        rows += [(BELIEF_REMOVED, key, 0.0, none) for key in b.removed]
    rows = rows or [(NOTHING, -1, 0.0, none)]
    cloud = np.zeros(len(rows), dtype=_layout(n))
    cloud['session'] = command.session
    for name, column in zip(('kind', 'key', 'value', 'cov'), zip(*rows, strict=True), strict=True):
        cloud[name] = column
    return build_cloud(make, encode.header(make, command.stamp, map_frame), cloud)


def read_correction(msg: Any, topic: str = 'rlml/graph_correction') -> Correct:
    """The inverse of build_correction; InputError if it is another kind of cloud."""
    rows = read_cloud(msg, topic)
    width = (
        rows['cov'].shape[1] if 'cov' in (rows.dtype.names or ()) and rows['cov'].ndim == 2 else 3
    )
    check_fields(rows, _layout(width), topic)
    if not len(rows):
        raise InputError(f'{topic}: a correction without rows')
    bounded(rows['value'], f'{topic}: a value')
    kind, value, cov = rows['kind'], rows['value'].astype(np.float64), rows['cov']
    own = kind == CORRECTION
    if own.sum() not in (0, 3) or width < 3:
        raise InputError(f'{topic}: {own.sum()} values are no correction')
    T_map_local = value[own] if own.any() else None
    cov_map = np.array(cov[own][:, :3], dtype=np.float64) if own.any() else None
    if cov_map is not None and np.isnan(cov_map).any():
        cov_map = None
    if cov_map is not None:
        covariances(cov_map, f'{topic}: the covariance')
    return Correct(
        int(rows['session'][0]), stamp(msg, topic), T_map_local, cov_map,
        tuple(rows['key'][kind == REMOVED].tolist()), _belief(rows, value, topic),
    )  # fmt: skip


def _belief(rows: NDArray[np.void], value: NDArray[np.float64], topic: str) -> Belief | None:
    kind = rows['kind']
    n = int(np.sum(kind <= LANDMARK))
    if n == 0:
        return None
    cov = np.array(rows['cov'][kind <= LANDMARK], dtype=np.float64)
    if np.sum(kind == POSE) != 3 or cov.shape != (n, n):
        raise InputError(f'{topic}: {n} values do not fit a covariance {cov.shape}')
    covariances(cov, f'{topic}: the joint covariance')
    alias = kind == ALIAS
    return Belief(
        value[kind == POSE],
        rows['key'][kind == LANDMARK][::2].astype(np.int64),
        value[kind == LANDMARK].reshape(-1, 2),
        cov,
        dict(zip(rows['key'][alias].tolist(), value[alias].astype(int).tolist(), strict=True)),
        tuple(rows['key'][kind == BELIEF_REMOVED].tolist()),
    )
