# SPDX-License-Identifier: Apache-2.0
"""Correctness of an association, by the true position of each detection.

With the true pose, every detection has a true place in the map. The place of a landmark is the
median of those of its detections; a detection that was used for a landmark elsewhere was used
wrongly. This needs no identities, so it covers reflectors, spikes and lines alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.datasets.tum import Trajectory
from rlml_slam.estimation.landmark_models import Model
from rlml_slam.evaluation.ate import interpolate
from rlml_slam.se2 import Array
from rlml_slam.types import Frame, Reflectors, Status

RADIUS = 0.3  # [m] places nearer than this are one landmark


@dataclass
class AssociationLog:
    """What each detection of a run was taken for."""

    stamps: list[int] = field(default_factory=list)
    points: list[Array] = field(default_factory=list)
    keys: list[NDArray[np.int64]] = field(default_factory=list)
    used: list[NDArray[np.bool_]] = field(default_factory=list)

    def add(self, frames: Iterable[Frame]) -> None:
        """Note the detections of frames, in the base frame, and their landmarks' keys."""
        for f in frames:
            if f.observation.detections is not None and len(f.landmarks):
                self.stamps.append(f.stamp)
                self.points.append(f.observation.detections.points)
                self.keys.append(f.landmarks)
                self.used.append((f.statuses == Status.USED) & (f.landmarks >= 0))


def association_figures(
    log: AssociationLog, truth: Trajectory, landmarks: Reflectors, model: Model
) -> dict[str, Any]:
    """Precision, recall and landmark RMSE [m]; ``truth`` and ``landmarks`` in one frame.

    Precision: share of the used detections that were of the landmark they were used for. Recall:
    share of the detections of landmarks known by then that were used, and rightly. A landmark's
    error is its distance from the place of its detections. None where there is nothing to compare.
    """
    out: dict[str, Any] = dict.fromkeys(('precision', 'recall', 'landmark_rmse_m'))
    if not log.stamps:
        return out
    poses, known = interpolate(truth, np.array(log.stamps, dtype=np.int64))
    places, keys, used, times = [], [], [], []
    for k in np.flatnonzero(known):
        p = log.points[k]
        polar = np.stack([np.hypot(p[:, 0], p[:, 1]), np.arctan2(p[:, 1], p[:, 0])], -1)
        places.append(model.place(poses[k], polar)[0])
        keys.append(log.keys[k])
        used.append(log.used[k])
        times.append(np.full(len(p), k))
    if not places:
        return out
    place, key = np.concatenate(places), np.concatenate(keys)
    use, time = np.concatenate(used), np.concatenate(times)
    names = np.unique(key[use])
    if not len(names):
        return out
    homes = np.array([np.median(place[key == n], axis=0) for n in names])
    born = np.array([time[key == n].min() for n in names])
    home_of = dict(zip(names.tolist(), homes, strict=True))
    own = np.array([home_of.get(int(n), (np.inf, np.inf)) for n in key])
    right = use & (np.hypot(*(place - own).T) <= RADIUS)
    gap = np.linalg.norm(place[:, None] - homes[None], axis=-1)
    again = ((gap <= RADIUS) & (born[None] < time[:, None])).any(axis=1)
    errors = [
        p - home_of[int(n)]
        for n, p in zip(landmarks.keys, landmarks.points, strict=True)
        if int(n) in home_of
    ]
    out['precision'] = float(right.sum() / use.sum())
    out['recall'] = float((right & again).sum() / again.sum()) if again.any() else None
    if errors:
        out['landmark_rmse_m'] = float(np.sqrt((np.array(errors) ** 2).sum(axis=1).mean()))
    return out
