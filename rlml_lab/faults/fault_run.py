# SPDX-License-Identifier: Apache-2.0
"""One run of the system over a recording with a fault, and its figures."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from rlml_lab.faults.fault_catalog import Fault, Messages
from rlml_lab.faults.recording import Recording
from rlml_lab.support.drives import feed_one
from rlml_slam import se2, warm_up
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.relations import relation_errors
from rlml_slam.evaluation.run_record import FrameLog
from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_replay import patient
from rlml_slam.se2 import Array
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import Level, Scan

WRONG, WRONG_TURN = 0.5, np.radians(10.0)  # [m], [rad] beyond 3 sigma: a pose that is wrong
SIGMAS = 3.0


@dataclass(frozen=True)
class FaultFigures:
    """Figures of one run; errors are those of the optimised trajectory.

    ``mean_m`` and ``std_m`` are over all relations, or over the poses with truth, ``rot_deg`` the
    mean of the heading. ``ok_and_wrong`` is the share of the frames that were OK and wrong as
    published, ``longest_s`` the longest time of that. ``cpu_ms`` is front and back end together.
    """

    mean_m: float
    std_m: float
    rot_deg: float
    lost: float
    degraded: float
    ok_and_wrong: float
    longest_s: float
    cpu_ms: float
    real_time_factor: float


def run(
    recording: Recording, fault: Fault, seed: int, params: Parameters,
    reference: Trajectory | None = None,
) -> tuple[FaultFigures, Trajectory, FrameLog]:  # fmt: skip
    """Replay with a fault, and compare.

    The published poses are compared with the truth at their stamps, or else with ``reference``,
    the optimised trajectory of the run without a fault, at the stamps that were recorded: so
    relations know which scan a pose is of.
    """
    messages = fault(recording.messages, np.random.default_rng(seed))
    slam, log = Slam(patient(params)), FrameLog()
    warm_up.compile_loaded()
    for frame_id, pose in recording.sensors.items():
        slam.set_sensor_pose(frame_id, pose)
    began = time.process_time()
    for message in messages:
        log.add(feed_one(slam, message))
    log.add(slam.finish())
    spent = time.process_time() - began
    taken = {} if recording.truth else stamps_as_recorded(messages, recording.messages)
    path = restamped(Trajectory(*slam.trajectory()), taken)
    trans, rot = _errors(recording, path, reference)
    true = recording.truth or reference or path
    wrong = is_wrong(log, true, taken) & (np.array(log.levels) == Level.OK)
    at, levels = np.array(log.stamps), np.array(log.levels)
    figures = FaultFigures(
        float(trans.mean()), float(trans.std()), float(np.degrees(rot.mean())),
        float(np.mean(levels == Level.LOST)), float(np.mean(levels == Level.DEGRADED)),
        float(np.mean(wrong)), longest(at, wrong), 1e3 * spent / len(at),
        (recording.end - recording.start) * 1e-9 / spent,
    )  # fmt: skip
    return figures, path, log


def _errors(
    recording: Recording, path: Trajectory, reference: Trajectory | None
) -> tuple[Array, Array]:
    """Errors [m], [rad] of a trajectory: over the relations, or else of the poses."""
    if recording.relations is not None:
        e = relation_errors(path, recording.relations, max_unmatched=1.0)
        return e.trans, e.rot
    errors = trajectory_errors(path, recording.truth or reference or path)
    return errors.distances, np.abs(errors.errors[:, 2])


def stamps_as_recorded(messages: Messages, recorded: Messages) -> dict[int, int]:
    """Of each stamp [ns] of a scan that a fault has moved, the stamp that was recorded."""
    now, then = ([m.stamp for m in part if isinstance(m, Scan)] for part in (messages, recorded))
    if len(now) != len(then):
        return {}
    return {a: b for a, b in zip(now, then, strict=True) if a != b}


def restamped(path: Trajectory, taken: dict[int, int]) -> Trajectory:
    """The trajectory with each stamp replaced by that of ``taken``, if it is there, in order."""
    stamps = np.array([taken.get(s, s) for s in path.stamps.tolist()], dtype=np.int64)
    stamps, order = np.unique(stamps, return_index=True)
    return Trajectory(stamps, path.poses[order])


def is_wrong(log: FrameLog, truth: Trajectory, taken: dict[int, int] | None = None) -> Array:
    """Of each frame (n,), whether its pose is off by more than WRONG and SIGMAS.

    ``taken``: stamps at which the truth is looked up instead of the frame's.
    """
    at = np.array([(taken or {}).get(s, s) for s in log.stamps], dtype=np.int64)
    errors = trajectory_errors(Trajectory(at, np.array(log.poses).reshape(-1, 3)), truth)
    out = np.zeros(len(log.stamps), dtype=bool)
    covs = np.array(log.covs)[errors.indices]
    sigma = np.sqrt(np.linalg.eigvalsh(covs[:, :2, :2])[:, 1])
    sigma_turn = np.sqrt(covs[:, 2, 2])
    far = errors.distances > WRONG + SIGMAS * sigma
    turned = np.abs(se2.wrap(errors.errors[:, 2])) > WRONG_TURN + SIGMAS * sigma_turn
    out[errors.indices] = far | turned
    return out


def longest(stamps: Array, true: Array) -> float:
    """Longest time [s] for which frames in a row are true."""
    best, since = 0.0, None
    for stamp, flag in zip(stamps.tolist(), true.tolist(), strict=True):
        if not flag:
            since = None
            continue
        since = stamp if since is None else since
        best = max(best, (stamp - since) * 1e-9)
    return best
