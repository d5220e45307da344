# SPDX-License-Identifier: Apache-2.0
"""The simulated carrier of deformable_slam."""

from __future__ import annotations

from dataclasses import dataclass, field

from rlml_slam.params.declaration import Group, param


@dataclass(frozen=True)
class CarrierRun(Group, prefix=''):
    """Clock and frames of carrier_simulator; the same seed gives the same run."""

    seed: int = param(0, 'seed of all noise', '', 0, 2**31 - 1)
    rate: float = param(1.0, 'real-time factor: simulated seconds per second', '', 0.01, 1000.0)
    duration: float = param(0.0, 'duration of the run; 0: no end', 's', 0.0, 1e6)
    exit_at_end: bool = param(True, 'the node exits with code 0 when the run is done')
    wait_for_subscribers: int = param(
        0, 'the run starts when the reflectors topic has this many subscribers', '', 0, 100
    )
    map_frame: str = param('map', 'frame of the ground truth: the base at start')
    odom_frame: str = param('odom', 'frame of the odometry')
    base_frame: str = param('base_link', 'frame of the robot and of its detections')


@dataclass(frozen=True)
class Carrier(Group):
    """The carrier, the robot beside it and its sensors."""

    kind: str = param(
        'train',
        'train: the features stay together and turn; conveyor: they pass by and are replaced',
        choices=('train', 'conveyor'),
    )
    features: int = param(6, 'number of features', '', 1, 100)
    rate: float = param(10.0, 'detections and odometry per second', 'Hz', 0.1, 1000.0)
    speed: float = param(1.0, 'mean nominal speed', 'm/s', 0.0, 10.0)
    turn_rate: float = param(
        0.1, 'amplitude of the sinusoidal turn rate of a train', 'rad/s', 0.0, 3.0
    )
    drift: float = param(0.05, 'random walk of each feature', 'm/sqrt(s)', 0.0, 10.0)
    common_drift: float = param(0.05, 'random walk of the whole carrier', 'm/sqrt(s)', 0.0, 10.0)
    odometry_sigma: tuple[float, ...] = param(
        (0.01, 0.01, 0.004),
        'odometry noise along, across per speed, and of the heading',
        'm/sqrt(s), sqrt(s), rad/sqrt(s)',
        0.0,
        10.0,
    )
    sigma: float = param(0.02, 'noise of a detection per axis', 'm', 1e-9, 10.0)
    max_range: float = param(8.0, 'farther features are not detected', 'm', 0.5, 500.0)
    missed_share: float = param(0.1, 'share of features in view that are missed', '', 0.0, 1.0)
    false_detections: float = param(
        0.0, 'mean number of false detections per step', '', 0.0, 100.0
    )
    ids: bool = param(True, 'detections have the id of their feature')


@dataclass(frozen=True)
class CarrierParameters:
    """Parameters of carrier_simulator."""

    node: CarrierRun = field(default_factory=CarrierRun)
    carrier: Carrier = field(default_factory=Carrier)
