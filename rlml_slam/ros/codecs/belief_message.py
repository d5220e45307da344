# SPDX-License-Identifier: Apache-2.0
"""The topic ``belief``: what the back end believes, for a front end that the graph contradicts.

A PointCloud2 with one point per dimension of the state: its value, the landmark it belongs to and
its row of the joint covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rlml_slam.errors import InputError
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.decode import stamp
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import build_cloud, read_cloud
from rlml_slam.se2 import Array
from rlml_slam.types import Belief

POSE, LANDMARK, CORRECTION, ALIAS, GONE = range(5)  # `kind`; an alias maps `key` to `value`


@dataclass(frozen=True)
class StampedBelief:
    """A belief about one session of the front end, and the ``T_map_local`` (3,) of then."""

    stamp: int
    session: int
    T_map_local: Array
    belief: Belief


def build_belief(make: Make, stamped: StampedBelief, map_frame: str) -> Any:
    """PointCloud2 of a belief."""
    b = stamped.belief
    n = 3 + 2 * len(b.keys)
    rows = np.zeros(
        n + 3 + len(b.aliases) + len(b.removed),
        dtype=[
            ('session', '<u4'), ('kind', 'u1'), ('key', '<i4'), ('value', '<f8'),
            ('cov', '<f8', (n,)),
        ],
    )  # fmt: skip
    rows['session'] = stamped.session
    rows['kind'] = (
        [POSE] * 3 + [LANDMARK] * (n - 3) + [CORRECTION] * 3
        + [ALIAS] * len(b.aliases) + [GONE] * len(b.removed)
    )  # fmt: skip
    rows['key'] = -1
    rows['key'][3:n] = np.repeat(b.keys, 2)
    rows['key'][n + 3 :] = [*b.aliases, *b.removed]
    values = [*b.T_map_base, *b.points.ravel(), *stamped.T_map_local, *b.aliases.values()]
    rows['value'][: len(values)] = values
    rows['cov'][:n] = b.cov
    return build_cloud(make, encode.header(make, stamped.stamp, map_frame), rows)


def read_belief(msg: Any, topic: str = 'belief') -> StampedBelief:
    """The inverse of build_belief; InputError if it is another kind of cloud."""
    rows = read_cloud(msg, topic)
    missing = {'session', 'kind', 'key', 'value', 'cov'} - set(rows.dtype.names or ())
    if missing or not np.isfinite(rows['value']).all():
        raise InputError(f'{topic}: not a belief')
    kind, value = rows['kind'], rows['value'].astype(np.float64)
    n = int(np.sum(kind <= LANDMARK))
    cov = np.array(rows['cov'][:n], dtype=np.float64).reshape(n, -1)
    if n < 3 or cov.shape != (n, n) or np.sum(kind == CORRECTION) != 3:
        raise InputError(f'{topic}: {n} values do not fit a covariance {cov.shape}')
    alias = kind == ALIAS
    return StampedBelief(
        stamp(msg, topic),
        int(rows['session'][0]),
        value[kind == CORRECTION],
        Belief(
            value[kind == POSE],
            rows['key'][kind == LANDMARK][::2].astype(np.int64),
            value[kind == LANDMARK].reshape(-1, 2),
            cov,
            dict(zip(rows['key'][alias].tolist(), value[alias].astype(int).tolist(), strict=True)),
            tuple(rows['key'][kind == GONE].tolist()),
        ),
    )
