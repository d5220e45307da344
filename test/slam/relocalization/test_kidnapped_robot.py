# SPDX-License-Identifier: Apache-2.0
"""A robot that is carried to a place whose walls look like those where it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rlml_slam.cli.main import main
from rlml_slam.params import Node, Parameters, Simulator
from rlml_slam.recordings.bag_replay import Given, replay
from rlml_slam.slam.store import map_file
from rlml_slam.types import Level

# the scan fits the submap of the drive again within a few scans; it fits the map elsewhere
CARRIED = ((1, 6.02, 9.8), (12, 5.50, 9.8), (41, 6.91, 9.1))  # seed, time [s], distance [m]


@pytest.fixture
def known(room_run):
    return map_file.saved_map(map_file.load(room_run / 'run' / 'map.rlml'))


@pytest.mark.parametrize(('seed', 'at', 'distance'), CARRIED)
def test_saved_map_overrules_the_submaps_of_the_drive(tmp_path, known, seed, at, distance):
    bag = tmp_path / 'bag'
    made = {'kidnap_time': at, 'kidnap_distance': distance, 'laser.beams': 360}
    sets = [word for name, value in made.items() for word in ('--set', f'{name}={value}')]
    assert main(['simulate', 'room', str(bag), '--seed', str(seed), *sets]) == 0
    node = Node(mode='localization', laser_pose=Simulator().laser_pose)
    run = replay(bag, replace(Parameters(), node=node), given=Given(known))
    true = run.truth.trajectory
    stamps = np.array(run.frames.stamps)
    x, y = (np.interp(stamps, true.stamps, true.poses[:, k]) for k in range(2))
    error = np.hypot(*(np.array(run.frames.poses)[:, :2] - np.stack([x, y], axis=-1)).T)
    levels = np.array(run.frames.levels)
    wrong = error > 0.5
    assert wrong.any()
    assert wrong.sum() <= 15  # scans, of 10 Hz
    assert Level.LOST in levels
    assert error[-1] < 0.05


def test_robot_carried_where_nothing_is_mapped_is_lost_until_it_comes_to_what_is(tmp_path):
    """It was OK, 12 m from where it was, and the map had both places at one."""
    bag = tmp_path / 'bag'
    made = {
        'kidnap_time': 25.0, 'kidnap_distance': 12.0, 'speed': 0.8, 'laser.beams': 360,
        'laser.rate': 5.0, 'markers.enabled': 'false',
    }  # fmt: skip
    sets = [word for name, value in made.items() for word in ('--set', f'{name}={value}')]
    assert main(['simulate', 'hall', str(bag), '--duration', '65', *sets]) == 0
    run = replay(bag, replace(Parameters(), node=Node(laser_pose=Simulator().laser_pose)))
    true = run.truth.trajectory
    stamps, levels = np.array(run.frames.stamps), np.array(run.frames.levels)
    x, y = (np.interp(stamps, true.stamps, true.poses[:, k]) for k in range(2))
    error = np.hypot(*(np.array(run.frames.poses)[:, :2] - np.stack([x, y], axis=-1)).T)
    carried = stamps - stamps[0] >= 25e9
    wrong = carried & (error > 0.5)
    assert wrong.mean() > 0.2
    assert (wrong & (levels != Level.LOST)).sum() <= 4  # scans, of 5 Hz
    # then all that it mapped meanwhile is where it belongs
    assert levels[-1] == Level.OK
    assert error[-1] < 0.1
    path = run.trajectory
    x, y = (np.interp(path.stamps, true.stamps, true.poses[:, k]) for k in range(2))
    off = np.hypot(*(path.poses[:, :2] - np.stack([x, y], axis=-1)).T)
    assert np.median(off) < 0.05
    assert np.mean(off > 0.5) < 0.15  # the seconds in which it maps nothing
