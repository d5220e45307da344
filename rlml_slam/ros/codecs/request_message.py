# SPDX-License-Identifier: Apache-2.0
"""The topic ``rlml/session_start``: where the front end is to begin a session, or to go on.

A PointCloud2 of one point, the place, whose fields are those of the request, exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.decode import covariances, stamp, stamp_or_now
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import bounded, build_cloud, read_table
from rlml_slam.slam.conversation import Relocate, StartSession

START, RELOCATE = range(2)  # `kind`
REQUEST = np.dtype(
    [
        ('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('kind', 'u1'), ('number', '<u4'),
        ('session', '<u4'), ('first_key', '<i4'), ('pose', '<f8', (3,)), ('cov', '<f8', (9,)),
    ]
)  # fmt: skip


def build_request(make: Make, command: StartSession | Relocate, map_frame: str) -> Any:
    """PointCloud2 of one point."""
    r = np.zeros(1, dtype=REQUEST)
    r['x'], r['y'] = command.pose[:2]
    r['number'], r['session'] = command.number, command.session
    r['pose'], r['cov'] = command.pose, command.cov.ravel()
    r['kind'] = RELOCATE
    if isinstance(command, StartSession):
        r['kind'], r['first_key'] = START, command.first_key
    return build_cloud(make, encode.header(make, command.stamp, map_frame), r)


def read_request(msg: Any, topic: str = 'rlml/session_start') -> StartSession | Relocate:
    """The inverse of build_request; InputError if it is another kind of cloud."""
    r = read_table(msg, REQUEST, topic, one=True)[0]
    pose = np.array(r['pose'], dtype=np.float64)
    cov = np.array(r['cov'], dtype=np.float64).reshape(3, 3)
    bounded(pose, f'{topic}: the pose')
    covariances(cov, f'{topic}: the covariance')
    number, session = int(r['number']), int(r['session'])
    if r['kind'] == START:
        time = stamp_or_now(msg, topic)  # none where it is about the pose of now
        return StartSession(number, session, time, pose, cov, int(r['first_key']))
    return Relocate(number, session, stamp(msg, topic), pose, cov)
