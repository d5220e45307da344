# SPDX-License-Identifier: Apache-2.0
"""Reflectors between the nodes, as clouds that RViz shows: detections and the map.

``reflectors/associated`` has the detections of one pose, in the base frame, with what the front
end made of each; ``reflector_map_points`` is the map's reflectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.decode import covariances, frame, stamp
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.ros.codecs.point_cloud import bounded, build_cloud, read_table
from rlml_slam.se2 import Array
from rlml_slam.types import Detections, Frame, Reflectors

# x, y and z = 0 for RViz, which needs them in single precision; the nodes use `exact`.
# landmark is the front end's key, id the reflector's own; both -1 for none
_PLACED = [
    ('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('exact', '<f8', (2,)),
    ('cov_xx', '<f8'), ('cov_xy', '<f8'), ('cov_yx', '<f8'), ('cov_yy', '<f8'),
    ('landmark', '<i4'), ('id', '<i4'), ('diameter', '<f8'),
]  # fmt: skip
_COV = {'cov_xx': (0, 0), 'cov_xy': (0, 1), 'cov_yx': (1, 0), 'cov_yy': (1, 1)}
ASSOCIATED = np.dtype([*_PLACED, ('status', '<i4')])
MAPPED = np.dtype([*_PLACED, ('sightings', '<i4')])


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
    cloud = _placed(ASSOCIATED, d, result.landmarks)
    cloud['status'] = result.statuses
    return build_cloud(make, encode.header(make, result.stamp, base_frame), cloud)


def build_reflector_map(make: Make, stamp: int, map_frame: str, reflectors: Reflectors) -> Any:
    """PointCloud2 of a map's reflectors."""
    cloud = _placed(MAPPED, reflectors, reflectors.keys)
    cloud['sightings'] = reflectors.sightings
    return build_cloud(make, encode.header(make, stamp, map_frame), cloud)


def _placed(
    dtype: np.dtype[np.void], of: Detections | Reflectors, landmarks: NDArray[np.int64]
) -> NDArray[np.void]:
    cloud = np.zeros(len(of), dtype=dtype)
    cloud['x'], cloud['y'] = of.points[:, 0], of.points[:, 1]
    cloud['exact'] = of.points
    for name, (i, j) in _COV.items():
        cloud[name] = of.cov[:, i, j]
    cloud['landmark'], cloud['id'], cloud['diameter'] = landmarks, of.ids, of.diameters
    return cloud


def read_associated(msg: Any, topic: str = 'reflectors/associated') -> Associated:
    """The inverse of build_associated; InputError if it is another kind of cloud."""
    cloud, points, cov = _read(msg, ASSOCIATED, topic)
    return Associated(
        Detections(
            stamp(msg, topic),
            frame(msg.header.frame_id),
            points,
            cov,
            cloud['id'].astype(np.int64),
            cloud['diameter'].astype(np.float64),
        ),
        cloud['landmark'].astype(np.int64),
        cloud['status'].astype(np.int64),
    )


def read_reflector_map(msg: Any, topic: str = 'reflector_map_points') -> Reflectors:
    """The inverse of build_reflector_map; InputError if it is another kind of cloud."""
    cloud, points, cov = _read(msg, MAPPED, topic)
    return Reflectors(
        cloud['landmark'].astype(np.int64),
        points,
        cov,
        cloud['id'].astype(np.int64),
        cloud['sightings'].astype(np.int64),
        cloud['diameter'].astype(np.float64),
    )


def _read(msg: Any, dtype: np.dtype[np.void], topic: str) -> tuple[NDArray[np.void], Array, Array]:
    """The cloud (n,), its points (n, 2) and their covariances (n, 2, 2), checked."""
    cloud = read_table(msg, dtype, topic)
    points, cov = cloud['exact'].astype(np.float64), np.empty((len(cloud), 2, 2))
    for name, (i, j) in _COV.items():
        cov[:, i, j] = cloud[name]
    bounded(points, f'{topic}: a position')
    covariances(cov, f'{topic}: a covariance')
    return cloud, points, cov
