# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab study deformable --node``: two nodes as processes over DDS.

What the node publishes is compared with the truth of the same stamps, one drive after another.
Errors of one drive hang together over time, so the bounds of its mean NEES are those of a single
sample; the mean over R drives has those of R.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from rlml_lab.carrier.carrier_messages import read_features
from rlml_lab.carrier.carrier_parameters import Carrier
from rlml_lab.deformable.scoring import chi2_bounds
from rlml_lab.deformable.study_deformable_window import KINDS
from rlml_slam.cli.support.live_session import node, own_domain
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import RlmlError
from rlml_slam.interrupts import held_interrupts
from rlml_slam.params import MotionNoise, Reflector
from rlml_slam.ros.codecs import decode
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.sensors import SENSOR
from rlml_slam.se2 import Array, wrap

TYPES = {
    'pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'features': 'sensor_msgs/msg/PointCloud2',
    'ground_truth': 'nav_msgs/msg/Odometry',
    'ground_truth_features': 'sensor_msgs/msg/PointCloud2',
    'reflectors': 'sensor_msgs/msg/PointCloud2',  # time begins when this ear hears as well
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
DEEP = QoSProfile(depth=5000)
SETTLED = 60.0  # [s] of the drive after which memory and time per update are taken
START_TIMEOUT = 90.0  # [s] for the node to start
UPDATE = 'time of an update, p99 [ms]'  # in the node's diagnostics
LINGER = 2.5  # [s] after the drive in which the last answer and diagnostics come


@dataclass(frozen=True)
class Drive:
    """What one drive over DDS showed.

    Of the detections, ``asked`` were sent and ``answered`` had an answer. ``pose`` (n,) and
    ``features`` (m,) are normalised errors of 3 and 2 degrees; ``figures`` are the last
    diagnostics. After SETTLED, ``growth`` [MB] is that of the memory and ``cpu_ms`` what the
    whole process needed per update, DDS and all.
    """

    asked: int
    answered: int
    pose: Array
    features: Array
    figures: dict[str, str]
    growth: float
    cpu_ms: float


class Ear(Node):
    """Keeps what is published as bytes, so that listening costs next to nothing."""

    def __init__(self) -> None:
        super().__init__('ear')
        self.heard: dict[str, list[bytes]] = {topic: [] for topic in TYPES}
        for topic, kind in TYPES.items():
            self.create_subscription(
                rclpy_class(kind), topic, self.heard[topic].append,
                SENSOR if topic == 'reflectors' else DEEP, raw=True,
            )  # fmt: skip

    def time(self) -> float:
        """Seconds of the drive that are over."""
        return len(self.heard['ground_truth']) / Carrier().rate

    def messages(self, topic: str) -> Iterator[Any]:
        """Everything heard on a topic."""
        kind = rclpy_class(TYPES[topic])
        return (deserialize_message(data, kind) for data in self.heard[topic])


def run_all(
    minutes: float, runs: int, ids: bool, rate: float, quiet: bool
) -> dict[str, list[Drive]]:
    """Drives with seeds 0 .. runs-1 beside each kind of carrier, ``rate`` x real time."""
    drives: dict[str, list[Drive]] = {kind: [] for kind in KINDS}
    tasks = [(kind, seed) for seed in range(runs) for kind in KINDS]
    with Progress('driving', len(tasks), quiet) as progress:
        for done, (kind, seed) in enumerate(tasks):
            drives[kind].append(
                run_node(kind, minutes, seed, ids, rate, partial(_tell, progress, done, kind))
            )
    return drives


def _tell(progress: Progress, done: int, kind: str, share: float) -> None:
    progress.update(done + share, kind)


def run_node(
    kind: str, minutes: float, seed: int, ids: bool, rate: float, report: Callable[[float], None]
) -> Drive:
    """One drive in a domain of its own; ``report`` is given the share that is done.

    Anonymous detections come with ghosts. RlmlError with its last words where a process dies.
    """
    duration, domain = 60.0 * minutes, free_domain()
    asked = math.floor(duration * Carrier().rate) + 1
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    simulated = {
        'seed': seed, 'rate': rate, 'duration': duration, 'wait_for_subscribers': 2,
        'carrier.kind': kind, 'carrier.ids': ids, 'carrier.false_detections': 0.0 if ids else 0.05,
    }  # fmt: skip
    with (
        tempfile.TemporaryDirectory() as folder,
        own_domain(domain, environment),
        held_interrupts() as check,
        Processes(Path(folder), environment) as processes,
    ):
        ear, executor = Ear(), SingleThreadedExecutor()
        executor.add_node(ear)

        def listen_until(done: Callable[[], bool], timeout: float) -> None:
            end = time.monotonic() + timeout
            while not done():
                if time.monotonic() > end:
                    raise RlmlError(f'{kind}: nothing more was heard for {timeout:g} s')
                executor.spin_once(timeout_sec=0.1)
                processes.check('deformable_slam')
                check()
                report(min(ear.time() / duration, 1.0))

        try:
            processes.start('deformable_slam', node('deformable_slam', noise_parameters()))
            listen_until(lambda: ear.count_publishers('features') > 0, START_TIMEOUT)
            processes.start(
                'carrier_simulator',
                ['rlml_lab.carrier.carrier_simulator', *node('carrier_simulator', simulated)[1:]],
            )
            listen_until(lambda: ear.time() > 0.0, START_TIMEOUT)
            patience = START_TIMEOUT + 10.0 * duration / rate
            listen_until(lambda: ear.time() >= min(SETTLED, 0.5 * duration), patience)
            before, heard = processes.usage('deformable_slam'), ear.time()
            listen_until(lambda: processes.has_ended('carrier_simulator'), patience)
            end, reports = time.monotonic() + LINGER, len(ear.heard['/diagnostics'])

            def is_told() -> bool:
                is_answered = len(ear.heard['pose']) >= asked
                return is_answered and len(ear.heard['/diagnostics']) > reports

            listen_until(lambda: is_told() or time.monotonic() > end, START_TIMEOUT)
            after = processes.usage('deformable_slam')
        finally:
            executor.shutdown(timeout_sec=1.0)
            ear.destroy_node()
    growth = cpu = math.nan
    if before is not None and after is not None:
        growth = after.rss_mb - before.rss_mb
        cpu = 1e3 * (after.cpu_s - before.cpu_s) / ((ear.time() - heard) * Carrier().rate)
    return Drive(asked, *evaluate(ear), growth, cpu)


def noise_parameters() -> dict[str, float]:
    """The simulated odometry's noise in the node's terms: per sqrt(s), but of an interval."""
    along, across, turn = np.array(Carrier().odometry_sigma) / math.sqrt(
        MotionNoise().noise_interval
    )
    return {
        'motion.speed_noise': 0.0, 'motion.speed_noise_floor': float(along),
        'motion.turn_noise': 0.0, 'motion.turn_noise_floor': float(turn),
        'motion.lateral_noise': float(across),
    }  # fmt: skip


def evaluate(ear: Ear) -> tuple[int, Array, Array, dict[str, str]]:
    """Number of answers, normalised errors of those whose truth was heard, last diagnostics.

    An anonymous feature is compared with the nearest true one as long as it is in the sensor's
    reach: beyond, what it is the estimate of may have left the conveyor.
    """
    truth = {
        decode.stamp(m, ''): decode.planar_pose(m.pose.pose, 'ground_truth')
        for m in ear.messages('ground_truth')
    }
    pose, at = [], dict[int, Array]()
    for m in ear.messages('pose'):
        got = decode.pose_estimate(m)
        at[got.stamp] = got.pose
        if got.stamp in truth:
            error = got.pose - truth[got.stamp]
            error[2] = wrap(error[2])
            pose.append(chi2_of(error, got.cov))
    true = {
        decode.stamp(m, ''): decode.detections(m, Reflector())
        for m in ear.messages('ground_truth_features')
    }
    features = []
    for m in ear.messages('features'):
        stamp = decode.stamp(m, '')
        if stamp not in true or stamp not in at:
            continue
        existing, found = true[stamp], read_features(m)
        reached = np.hypot(*(found.points - at[stamp][:2]).T) < Carrier().max_range
        for j in np.flatnonzero(reached | (found.ids >= 0)):
            errors, id = found.points[j] - existing.points, found.ids[j]
            near = existing.ids == id if id >= 0 else [np.argmin(np.hypot(*errors.T))]
            features += [chi2_of(e, found.cov[j]) for e in errors[near]]
    figures: dict[str, str] = {}
    for m in ear.messages('/diagnostics'):
        figures = {v.key: v.value for v in m.status[0].values}
    return len(ear.heard['pose']), np.array(pose), np.array(features), figures


def chi2_of(error: Array, cov: Array) -> float:
    """e^T P^-1 e."""
    return float(error @ np.linalg.solve(cov, error))


def summarize(drives: dict[str, list[Drive]]) -> dict[str, Any]:
    """Figures of each kind of carrier: NEES with its bounds, losses, time per update, memory."""
    return {kind: _figures(of) for kind, of in drives.items()}


def _figures(drives: list[Drive]) -> dict[str, Any]:
    def worst(figure: str) -> float:
        return max(float(d.figures.get(figure, math.nan)) for d in drives)

    return {
        'runs': len(drives),
        'asked': sum(d.asked for d in drives),
        'answered': sum(d.answered for d in drives),
        'nees_pose': float(np.mean([d.pose.mean() for d in drives])),
        'nees_pose_bounds': chi2_bounds(3, len(drives)),
        'nees_features': float(np.mean([d.features.mean() for d in drives])),
        'nees_features_bounds': chi2_bounds(2, len(drives)),
        'wall_ms_p99': worst(f'wall {UPDATE}'),
        'cpu_ms_p99': worst(f'CPU {UPDATE}'),
        'process_cpu_ms': max(d.cpu_ms for d in drives),
        'rss_growth_mb': max(d.growth for d in drives),
    }


def claims(summary: dict[str, Any]) -> list[tuple[str, bool]]:
    """What the node is held to, and whether the figures show it."""
    out = []
    for kind, f in summary.items():
        for what in ('pose', 'features'):
            low, high = f[f'nees_{what}_bounds']
            out.append((f'{kind}: NEES of the {what} is consistent',
                        low < f[f'nees_{what}'] < high))  # fmt: skip
        out.append((f'{kind}: all detections are answered', f['answered'] == f['asked']))
        for clock in ('wall', 'cpu'):
            out.append((f'{kind}: p99 of an update is at most 10 ms, {clock}',
                        f[f'{clock}_ms_p99'] <= 10.0))  # fmt: skip
        out.append((f'{kind}: memory grows by less than 4 MB', f['rss_growth_mb'] < 4.0))
    return out


def lines(f: dict[str, Any]) -> dict[str, str]:
    """The table's column of one kind."""

    def bounded(what: str) -> str:
        low, high = f[f'nees_{what}_bounds']
        return f'{f[f"nees_{what}"]:.2f} ({low:.2f} … {high:.2f})'

    return {
        'detections, answered': f'{f["asked"]}, {f["answered"]}',
        'NEES of the pose (3), 99.9 % bounds': bounded('pose'),
        'NEES of a feature (2), bounds': bounded('features'),
        'p99 of an update, ms: wall, CPU': f'{f["wall_ms_p99"]:.2f}, {f["cpu_ms_p99"]:.2f}',
        'CPU of the process per update, ms': f'{f["process_cpu_ms"]:.2f}',
        'growth of memory, MB': f'{f["rss_growth_mb"]:.2f}',
    }
