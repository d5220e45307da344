# SPDX-License-Identifier: Apache-2.0
"""Reflectors and detections as markers for RViz and Foxglove."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import Make
from rlml_slam.se2 import Array
from rlml_slam.types import Reflectors, Status

# visualization_msgs/Marker
CYLINDER, SPHERE_LIST, TEXT, DELETEALL = 3, 7, 9, 3
SCALE_95 = math.sqrt(-2.0 * math.log(0.05))  # of chi^2 with 2 degrees of freedom
HEIGHT = 1.5  # [m] of the cylinder drawn for a reflector

ORANGE = (1.0, 0.55, 0.1, 1.0)
YELLOW = (1.0, 0.9, 0.2, 0.5)
WHITE = (1.0, 1.0, 1.0, 1.0)
STATUS_COLORS = {
    Status.USED: (0.1, 0.8, 0.3, 1.0),
    Status.GATED: (0.9, 0.1, 0.1, 1.0),
    Status.NEW: (0.2, 0.5, 1.0, 1.0),
    Status.GHOST: (0.6, 0.6, 0.6, 1.0),
    Status.AMBIGUOUS: (1.0, 0.9, 0.2, 1.0),
    Status.DEFERRED: (0.7, 0.4, 1.0, 1.0),
}


class Markers:
    """Collects the markers of one array; the first one clears what was drawn before."""

    def __init__(self, make: Make, stamp: int, frame_id: str) -> None:
        self._make = make
        self._header = encode.header(make, stamp, frame_id)
        self.list: list[Any] = []
        self.add('', 0, WHITE, (0.0, 0.0, 0.0))
        self.list[0].action = DELETEALL

    def add(
        self,
        namespace: str,
        kind: int,
        color: tuple[float, float, float, float],
        scale: tuple[float, float, float],
        at: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        points: Array | None = None,
        text: str = '',
    ) -> None:
        """A marker ``at`` (x, y, heading, z)."""
        make = self._make
        pose = encode.pose(make, np.array(at[:3]))
        pose.position.z = float(at[3])
        lines = np.zeros((0, 2)) if points is None else points.reshape(-1, 2)
        duration = make('builtin_interfaces/msg/Duration', sec=0, nanosec=0)
        rgba = dict(zip('rgba', map(float, color), strict=True))
        self.list.append(
            make(
                'visualization_msgs/msg/Marker',
                header=self._header,
                ns=namespace,
                id=len(self.list),
                type=kind,
                action=0,
                pose=pose,
                scale=encode.vector(make, *scale),
                color=make('std_msgs/msg/ColorRGBA', **rgba),
                lifetime=duration,
                frame_locked=False,
                points=[encode.vector(make, x, y, 0.0, 'Point') for x, y in lines],
                colors=[],
                texture_resource='',
                texture=_no_texture(make),
                uv_coordinates=[],
                text=text,
                mesh_resource='',
                mesh_file=make(
                    'visualization_msgs/msg/MeshFile', filename='', data=np.zeros(0, np.uint8)
                ),
                mesh_use_embedded_materials=False,
            )
        )

    def array(self) -> Any:
        """MarkerArray of all that was added."""
        return self._make('visualization_msgs/msg/MarkerArray', markers=self.list)


def _no_texture(make: Make) -> Any:
    return make(
        'sensor_msgs/msg/CompressedImage',
        header=encode.header(make, 0, ''),
        format='',
        data=np.zeros(0, np.uint8),
    )


def ellipse(cov: Array) -> tuple[float, float, float]:
    """Full axes [m] and heading [rad] of the ellipse that holds 95 % of cov (2, 2)."""
    values, axes = np.linalg.eigh(cov)
    minor, major = 2.0 * SCALE_95 * np.sqrt(np.maximum(values, 0.0))
    return float(major), float(minor), math.atan2(axes[1, 1], axes[0, 1])


def reflector_markers(make: Make, stamp: int, frame_id: str, reflectors: Reflectors) -> Any:
    """MarkerArray: a cylinder, the 95 % ellipse and the key of each reflector."""
    out = Markers(make, stamp, frame_id)
    for k in range(len(reflectors)):
        x, y = reflectors.points[k]
        known = np.isfinite(reflectors.diameters[k])
        diameter = float(reflectors.diameters[k]) if known else 0.1
        middle = (x, y, 0.0, HEIGHT / 2)
        out.add('reflectors', CYLINDER, ORANGE, (diameter, diameter, HEIGHT), middle)
        major, minor, heading = ellipse(reflectors.cov[k])
        flat = (max(major, 1e-3), max(minor, 1e-3), 0.01)
        out.add('ellipses', CYLINDER, YELLOW, flat, (x, y, heading, 0.0))
        above, key = (x, y, 0.0, HEIGHT + 0.3), str(int(reflectors.keys[k]))
        out.add('keys', TEXT, WHITE, (0.0, 0.0, 0.3), above, text=key)
    return out.array()


def detection_markers(
    make: Make, stamp: int, frame_id: str, points: Array, statuses: NDArray[np.int64]
) -> Any:
    """MarkerArray: detections (n, 2), a colour and a namespace for each status (n,)."""
    out = Markers(make, stamp, frame_id)
    for status, color in STATUS_COLORS.items():
        of_status = statuses == status
        if of_status.any():
            size = (0.25, 0.25, 0.25)
            out.add(status.name.lower(), SPHERE_LIST, color, size, points=points[of_status])
    return out.array()
