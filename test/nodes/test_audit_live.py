# SPDX-License-Identifier: Apache-2.0
"""``rlml audit`` of what live nodes wrote: a drive over DDS, and an incident of the black box."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from live import DOMAIN
from std_srvs.srv import Trigger

from rlml_slam.cli.main import main
from rlml_slam.simulation import world_file

PARAMETERS = ('--ros-args', '-p', 'laser_pose:=[0.2, 0.0, 0.0]', '-p', 'incident.after:=0.3',
              '-p', 'use_sim_time:=true')  # fmt: skip
STOOD, STANDS = np.array([2.2, 6.35]), np.array([2.25, 6.31])  # reflector 5 of the room
HIDDEN, WAS_HIDDEN = 2, np.array([3.1, 0.15])  # in a box
START = np.array([1.3, 1.2])


@pytest.fixture(scope='module')
def faulty(tmp_path_factory):
    """A recorded drive through the room, in which one reflector moved and one is hidden."""
    folder = tmp_path_factory.mktemp('faulty')
    world = (Path(world_file.__file__).parent / 'worlds' / 'room.yaml').read_text('utf-8')
    assert world.count(f'at: {STOOD.tolist()}') == 1
    world = world.replace(f'at: {STOOD.tolist()}', f'at: {STANDS.tolist()}')
    world = world.replace('boxes:\n', 'boxes:\n  - {at: [3.1, 0.2], size: [0.4, 0.4]}\n')
    (folder / 'faulty.yaml').write_text(world, encoding='utf-8')
    assert main(['simulate', str(folder / 'faulty.yaml'), str(folder / 'bag')]) == 0
    return folder / 'bag'


def findings(capsys, *arguments):
    capsys.readouterr()
    assert main(['audit', *map(str, arguments), '--json']) == 1
    return json.loads(capsys.readouterr().out)['findings']


def place(finding):
    """What a reflector of the robot's map is, in the world: its map begins at the start."""
    return np.array([finding['x_m'], finding['y_m']]) + START


def test_live_drive_names_what_is_not_as_planned(faulty, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    run, plan = tmp_path / 'run', tmp_path / 'plan'
    assert main(['live', str(faulty), '--out', str(run), '--rate', '3']) == 0
    main(['plan', 'room', '--out', str(plan), '--spacing', '0.5'])
    found = findings(capsys, run, '--plan', plan)
    assert [f['kind'] for f in found] == ['moved', 'hidden']
    assert found[0]['what'].startswith('reflector 5 at (2.20, 6.35) stands 6.')
    assert found[1]['what'].startswith(f'reflector {HIDDEN} at (3.10, 0.15) was seen ')


def test_incident_names_what_is_not_as_in_the_map(faulty, room_run, live, start, tmp_path, capsys):
    live.listen('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped')
    front_end = start('front_end', *PARAMETERS)
    live.spin_until(lambda: live.ear.count_publishers('pose') == 1, timeout=60.0)
    player = start('bag_player', '--ros-args', '-p', f'bag:={faulty}', '-p', 'rate:=4.0',
                   '-p', 'wait_for_subscribers:=1', '-p', 'start_delay:=0.5')  # fmt: skip
    live.spin_until(lambda: len(live.heard['pose']) > 270, timeout=60.0)
    assert live.call(Trigger, 'front_end/save_incident', Trigger.Request()).success
    folder = tmp_path / 'maps' / 'incidents'
    live.spin_until(lambda: list(folder.glob('incident-*.mcap')) != [])
    for process in (player, front_end):
        process.interrupt()
        assert process.finish()[0] == 0
    (incident,) = folder.glob('incident-*.mcap')
    run = tmp_path / 'run'
    assert main(['replay', str(incident), '--map', str(room_run / 'run' / 'map.rlml'),
                 '--out', str(run), '--no-report']) == 0  # fmt: skip
    found = findings(capsys, run)
    assert [f['kind'] for f in found] == ['moved', 'hidden']
    for finding, at in zip(found, (STOOD, WAS_HIDDEN), strict=True):
        np.testing.assert_allclose(place(finding), at, atol=0.05)
    assert ' stands 6.' in found[0]['what']
