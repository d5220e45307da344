# SPDX-License-Identifier: Apache-2.0
"""``rlml replay --mcap``: inputs and estimates in one file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlml_slam import se2
from rlml_slam.cli.main import main
from rlml_slam.datasets.tum import read_tum
from rlml_slam.params import Parameters
from rlml_slam.recordings.bag_replay import Given, replay
from rlml_slam.ros.bags.bag import BagReader, BagWriter
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_bag
from rlml_slam.slam.store import map_file

ROOT = Path(__file__).resolve().parents[2]
ROOM = ROOT / 'bags' / 'room'


def test_bag_writes_one_file_of_that_name(tmp_path):
    for name in ('a.mcap', 'b.mcap'):
        with BagWriter(tmp_path / name) as bag:
            bag.write('/number', make_bag('std_msgs/msg/Float64', data=1.5), 7)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['a.mcap', 'b.mcap']
    assert (tmp_path / 'a.mcap').read_bytes() == (tmp_path / 'b.mcap').read_bytes()
    with BagReader(tmp_path / 'a.mcap') as bag:
        assert [(t, m.data) for t, _, m in bag.messages()] == [(7, 1.5)]


@pytest.fixture(scope='module')
def messages(room_run):
    """The messages of the file by topic."""
    with BagReader(room_run / 'run.mcap') as bag:
        out = {topic: [] for topic in bag.topics}
        for time, topic, message in bag.messages():
            out[topic].append((time, message))
        assert not bag.skipped
    return out


def test_two_replays_give_the_same_bytes(room_run, room_again):
    assert (room_run / 'run.mcap').read_bytes() == (room_again / 'run.mcap').read_bytes()


def test_poses_are_those_of_the_front_end(room_run, messages):
    live = read_tum(room_run / 'run' / 'front_end.tum')
    poses = [decode.pose_estimate(m) for _, m in messages['/pose']]
    assert [p.stamp for p in poses] == live.stamps.tolist()
    assert np.allclose([p.pose for p in poses], live.poses, atol=1e-6)


def test_transforms_compose_to_the_pose(messages):
    moved = [t for _, m in messages['/tf'] for t in m.transforms]
    at = {(t.child_frame_id, decode.stamp(t, '/tf')): t for t in moved}
    compared = 0
    for _, message in messages['/pose']:
        pose = decode.pose_estimate(message)
        pair = [at.get((child, pose.stamp)) for child in ('odom', 'base_link')]
        if None not in pair:
            T = [decode.planar_pose(_pose(t), '/tf') for t in pair]
            assert np.allclose(se2.between(pose.pose, se2.compose(*T)), 0.0, atol=1e-9)
            compared += 1
    assert compared > len(messages['/pose']) / 2
    assert len({t.child_frame_id for t in moved}) == 2
    assert len(moved) == len(messages['/pose']) + len(messages['/odom'])


def _pose(transform):
    p, R = transform.transform.translation, transform.transform.rotation
    return make_bag(
        'geometry_msgs/msg/Pose',
        position=make_bag('geometry_msgs/msg/Point', x=p.x, y=p.y, z=p.z),
        orientation=R,
    )


def test_inputs_are_those_of_the_bag(room_run):
    topics = ('/scan', '/odom', '/reflectors', '/ground_truth')
    for topic in topics:
        with BagReader(ROOM) as a, BagReader(room_run / 'run.mcap') as b:
            assert topic in a.topics
            assert list(a.serialized([topic])) == list(b.serialized([topic]))


def test_errors_are_those_of_the_report(room_run, messages):
    figures = json.loads((room_run / 'run' / 'metrics.json').read_text())
    distances = np.array([m.data for _, m in messages['/estimate/error/position']])
    assert np.sqrt((distances**2).mean()) == pytest.approx(figures['live_ate_rmse_m'], abs=1e-6)
    assert len(messages['/estimate/sigma/position']) == figures['scans']


def test_map_grows_and_every_scan_has_its_health(messages):
    cells = [m.info.width * m.info.height for _, m in messages['/map']]
    assert len(cells) >= 3
    assert len(messages['/front_end/health']) == len(messages['/pose'])
    assert {m.level for _, m in messages['/front_end/health']} <= {0, 1, 2}


def test_times_go_on(messages):
    for topic in ('/pose', '/map', '/front_end/health', '/rosout'):
        times = [t for t, _ in messages.get(topic, [])]
        assert times == sorted(times), topic


def test_file_replays_as_the_bag_does(room_run):
    again = replay(room_run / 'run.mcap', Parameters())
    first = read_tum(room_run / 'run' / 'trajectory.tum')
    assert np.array_equal(again.trajectory.stamps, first.stamps)
    # the odometry comes from /tf, which has no speeds
    assert np.allclose(again.trajectory.poses, first.poses, atol=2e-3)


def test_layout_names_topics_of_the_file(messages):
    layout = json.loads((ROOT / 'config' / 'foxglove_replay.json').read_text())
    panels = layout['configById']
    shown = set(panels['3D!map']['topics'])
    plotted = {
        path['value'].removesuffix('.data')
        for name, panel in panels.items() if name.startswith('Plot') for path in panel['paths']
    }  # fmt: skip
    assert shown | plotted <= set(messages)


def test_no_frame_has_two_parents(tmp_path):
    """Recorded with another localization: its map to odom is left out, odom to base is kept."""
    with BagReader(ROOM) as bag, BagWriter(tmp_path / 'bag') as out:
        for time, topic, message in bag.messages():
            if topic != '/odom':
                out.write(topic, message, time)
                continue
            T = decode.planar_pose(message.pose.pose, topic)
            stamp = decode.stamp(message, topic)
            pairs = [('odom', 'base_link', T), ('map', 'odom', np.array([1.0, 2.0, 0.3]))]
            pairs.append(('base_link', 'fork', np.zeros(3)))
            tf = [encode.transform(make_bag, stamp, (a, b), T_ab) for a, b, T_ab in pairs]
            out.write('/tf', encode.tf_message(make_bag, tf), time)
    replay(tmp_path / 'bag', Parameters(), mcap=tmp_path / 'run.mcap')
    parents, foreign = {}, 0
    with BagReader(tmp_path / 'run.mcap') as bag:
        for _, _, message in bag.messages(['/tf', '/tf_static']):
            for t in message.transforms:
                parents.setdefault(t.child_frame_id, set()).add(t.header.frame_id)
                at = t.transform.translation
                foreign += t.child_frame_id == 'odom' and (at.x, at.y) == (1.0, 2.0)
    assert parents['odom'] == {'map'}
    assert parents['base_link'] == {'odom'}
    assert parents['fork'] == {'base_link'}
    assert all(len(p) == 1 for p in parents.values())
    assert foreign == 0


def test_file_that_exists_is_kept(tmp_path, capsys):
    kept = tmp_path / 'run.mcap'
    kept.write_bytes(b'mine')
    assert main(['replay', str(ROOM), '--out', str(tmp_path / 'out'), '--mcap', str(kept)]) != 0
    assert 'exists already' in capsys.readouterr().err
    assert kept.read_bytes() == b'mine'


def test_failed_replay_leaves_no_file(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/scan', 'sensor_msgs/msg/LaserScan')
        bag.write('/number', make_bag('std_msgs/msg/Float64', data=1.5), 7)
    mcap = tmp_path / 'run.mcap'
    args = ['replay', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), '--mcap', str(mcap)]
    assert main(args) != 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ['bag', 'out']


def test_filter_is_recorded_as_well(tmp_path):
    args = ['replay', str(ROOM), '--out', str(tmp_path / 'out'), '--system', 'ekf', '--no-report']
    assert main([*args, '--mcap', str(tmp_path / 'run.mcap')]) == 0
    with BagReader(tmp_path / 'run.mcap') as bag:
        assert bag.topics['/pose'].count > 10
        assert '/reflector_map' in bag.topics


@pytest.fixture
def damaged(tmp_path):
    """Broken messages on each topic, and an odometry with the name of an estimate."""
    path = tmp_path / 'damaged'
    with BagReader(ROOM) as bag, BagWriter(path) as out:
        for k, (time, topic, message) in enumerate(bag.messages()):
            name = '/pose' if topic == '/odom' else topic
            out.write(name, message, time)
            if k % 50 == 0:
                out.write_serialized(name, b'\x00\x01\x00\x00\x07', time)
    return path


def test_recording_changes_no_figure_of_a_damaged_bag(damaged, tmp_path):
    plain = replay(damaged, Parameters())
    shown = replay(damaged, Parameters(), mcap=tmp_path / 'run.mcap')
    assert shown.inputs == plain.inputs
    assert sum(f.get('unreadable', 0) + f.get('invalid', 0) for f in plain.inputs.values()) > 0
    assert np.array_equal(shown.trajectory.poses, plain.trajectory.poses)
    with BagReader(tmp_path / 'run.mcap') as bag:
        poses = [decode.pose_estimate(m) for _, _, m in bag.messages(['/pose'])]
        assert not bag.skipped
    assert len(poses) == len(plain.frames.stamps)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['damaged', 'run.mcap']


def test_searches_have_their_verdicts_and_places(tmp_path):
    """A robot that starts elsewhere than assumed finds itself in the map of another run."""
    run = replay(ROOM, Parameters())
    known = map_file.saved_map(run.stored)
    node = replace(Parameters().node, map_start_pose=(4.0, 3.0, 1.0))
    params = replace(Parameters(), node=node)
    replay(ROOM, params, given=Given(known), mcap=tmp_path / 'run.mcap')
    with BagReader(tmp_path / 'run.mcap') as bag:
        verdicts = [m for _, _, m in bag.messages(['/search/verdict'])]
        places = [m for _, _, m in bag.messages(['/search/places'])]
        said = [m.msg for _, _, m in bag.messages(['/rosout']) if m.msg.startswith('search: ')]
    assert len(verdicts) == len(places) == len(said) > 0
    shown = {v.key: v.value for v in verdicts[-1].values}
    assert shown['verdict'] == 'unique'
    assert int(shown['places']) == len(places[-1].poses) > 0
    best = decode.planar_pose(places[-1].poses[0], '/search/places')
    assert np.abs(best - run.frames.poses[0])[:2].max() < 0.5
