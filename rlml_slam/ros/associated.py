# SPDX-License-Identifier: Apache-2.0
"""The topic ``reflectors/associated``: detections with what the front end made of each.

A PointCloud2 in the base frame with the stamp of the front end's pose, for the back end and RViz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import InputError
from rlml_slam.ros import build
from rlml_slam.ros.cloud import build_cloud, read_cloud
from rlml_slam.ros.convert import frame, stamp
from rlml_slam.ros.messages import Make
from rlml_slam.types import Detections, Frame

# z = 0 for RViz; landmark is the front end's key, id the reflector's own; both -1 for none
ASSOCIATED = np.dtype(
    [
        ('x', '<f4'), ('y', '<f4'), ('z', '<f4'),
        ('cov_xx', '<f4'), ('cov_xy', '<f4'), ('cov_yy', '<f4'),
        ('landmark', '<i4'), ('status', '<i4'), ('id', '<i4'), ('diameter', '<f4'),
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Associated:
    """Detections (n) in the base frame, their landmarks (n,) and statuses (n,)."""

    detections: Detections
    landmarks: NDArray[np.int64]
    statuses: NDArray[np.int64]


def build_associated(make: Make, result: Frame, base_frame: str) -> Any:
    """PointCloud2 of the detections of a frame, which must have some (or an empty set)."""
    d = result.observation.detections
    assert d is not None
    cloud = np.zeros(len(d), dtype=ASSOCIATED)
    cloud['x'], cloud['y'] = d.points[:, 0], d.points[:, 1]
    cloud['cov_xx'], cloud['cov_xy'] = d.cov[:, 0, 0], d.cov[:, 0, 1]
    cloud['cov_yy'] = d.cov[:, 1, 1]
    cloud['landmark'], cloud['status'] = result.landmarks, result.statuses
    cloud['id'], cloud['diameter'] = d.ids, d.diameters
    return build_cloud(make, build.header(make, result.stamp, base_frame), cloud)


def read_associated(msg: Any, topic: str = 'reflectors/associated') -> Associated:
    """The inverse of build_associated; InputError if it is another kind of cloud."""
    cloud = read_cloud(msg, topic)
    missing = set(ASSOCIATED.names or ()) - set(cloud.dtype.names or ())
    if missing:
        raise InputError(f'{topic}: cloud has no field {", ".join(sorted(missing))}')
    cov = np.empty((len(cloud), 2, 2))
    cov[:, 0, 0], cov[:, 1, 1] = cloud['cov_xx'], cloud['cov_yy']
    cov[:, 0, 1] = cov[:, 1, 0] = cloud['cov_xy']
    return Associated(
        Detections(
            stamp(msg, topic),
            frame(msg.header.frame_id),
            np.stack([cloud['x'], cloud['y']], -1).astype(np.float64),
            cov,
            cloud['id'].astype(np.int64),
            cloud['diameter'].astype(np.float64),
        ),
        cloud['landmark'].astype(np.int64),
        cloud['status'].astype(np.int64),
    )
