# SPDX-License-Identifier: Apache-2.0
"""Front end and back end in one process over DDS, against the replay of the same bag."""

from __future__ import annotations

import gc
import re
from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.srv import AddDiagnostics
from live import LATCHED, room
from nav_msgs.srv import GetMap, LoadMap
from rclpy.parameter import Parameter
from std_srvs.srv import Empty, SetBool, Trigger

from rlml_slam import se2
from rlml_slam.cli.closures import parse
from rlml_slam.errors import MapError
from rlml_slam.maps import reflector_file
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end import searcher
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import make_rclpy as make
from rlml_slam.ros.codecs.message_types import rclpy_class
from rlml_slam.ros.codecs.reflector_clouds import read_reflector_map
from rlml_slam.ros.sensor_input import SensorInput
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.offline.slam import Slam
from rlml_slam.types import EdgeKind

SECOND = 1_000_000_000
SECONDS = 8.0
HAS_TF = rclpy_class('tf2_msgs/msg/TFMessage') is not None
TF = ('/tf', 'tf2_msgs/msg/TFMessage')
if not HAS_TF:
    TF = ('/back_end/map_to_odom', 'geometry_msgs/msg/TransformStamped')
MAP_TOPICS = {
    'map': 'nav_msgs/msg/OccupancyGrid',
    'map_metadata': 'nav_msgs/msg/MapMetaData',
    'trajectory': 'nav_msgs/msg/Path',
    'reflector_map': 'visualization_msgs/msg/MarkerArray',
    'reflector_map_points': 'sensor_msgs/msg/PointCloud2',
    'graph': 'visualization_msgs/msg/MarkerArray',
    'correction': 'geometry_msgs/msg/PoseWithCovarianceStamped',
}


def start(live, **values):
    front = live.start(FrontEndNode, **values)
    back = live.start(BackEndNode, **values)
    front.sensors.stop_waiting()
    live.listen('pose', 'geometry_msgs/msg/PoseWithCovarianceStamped')
    for topic, kind in MAP_TOPICS.items():
        live.listen(topic, kind, LATCHED)
    live.listen(*TF)
    talk = ('rlml/frames', 'deskewed_points', 'reflectors/associated', 'pose')
    live.spin_until(
        lambda: (
            all(front.count_subscribers(topic) == 1 for topic in talk)
            and front.count_publishers('rlml/graph_correction') == 1
            and front.control.session.mode
        )
    )
    return front, back


def drive(live, front, back, start=0.0, end=SECONDS):
    """The front end gets the bag's messages; the spinning between them carries the nodes' talk."""
    for stream, msg in room(seconds=end):
        if decode.stamp(msg, '') < (1.0 + start) * SECOND:
            continue
        front.sensors.add(stream, msg)
        live.executor.spin_once(timeout_sec=0.0)
    for observation in front.sensors.synchronizer.flush():  # as after a second of silence
        front.process(observation)
    live.spin_until(lambda: back.health.newest == front.last.stamp)
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    live.drain()


def replayed(seconds=SECONDS):
    slam = Slam(Parameters())
    feed = SensorInput(Parameters(), slam, slam.synchronizer.inputs)
    for stream, msg in room(seconds=seconds):
        feed.add(stream, msg)
    for observation in slam.synchronizer.flush():
        slam.back_end.add(slam.front_end.process(observation))
    return slam


def test_live_nodes_end_where_the_replay_ends(live):
    front, back = start(live)
    drive(live, front, back)
    slam = replayed()
    stamps, poses = slam.trajectory()
    live_stamps, live_poses = back.mapper.back_end.trajectory()
    np.testing.assert_array_equal(live_stamps, stamps)
    # points and detections travel as float32, whose rounding at 10 m is below 1e-6 m
    np.testing.assert_allclose(se2.between(poses, live_poses), 0.0, atol=1e-5)
    assert len(back.mapper.back_end.keyframes) == len(slam.back_end.keyframes)


def test_everything_of_the_map_is_published(live):
    front, back = start(live)
    drive(live, front, back)
    live.spin_until(lambda: all(live.heard[topic] for topic in MAP_TOPICS))
    live.spin_until(lambda: len(live.heard['trajectory'][-1].poses) > 50)
    grid = live.heard['map'][-1]
    assert grid.header.frame_id == 'map'
    assert (np.array(grid.data) == 100).sum() > 100
    assert live.heard['map_metadata'][-1] == grid.info
    path = live.heard['trajectory'][-1].poses
    assert path[0].header.stamp != path[-1].header.stamp
    points = read_reflector_map(live.heard['reflector_map_points'][-1])
    names = [m.ns for m in live.heard['reflector_map'][-1].markers]
    assert names.count('reflectors') == names.count('ellipses') == len(points) >= 3
    kinds = {m.ns for m in live.heard['graph'][-1].markers}
    assert {'keyframes', 'odometry', 'scan', 'sightings'} <= kinds


def test_map_to_odom_joins_the_two_estimates(live):
    front, back = start(live, transform_tolerance=0.0)
    drive(live, front, back, end=6.0)
    newest = front.last

    def is_sent():
        sent = live.heard[TF[0]]
        return (
            sent
            and decode.stamp(getattr(sent[-1], 'transforms', [sent[-1]])[0], '') == newest.stamp
        )

    live.spin_until(is_sent)
    (got,) = decode.transforms(live.heard[TF[0]][-1])
    assert (got.parent, got.child) == ('map', 'odom')
    T = np.array([*got.t[:2], decode.yaw(got.R, '')])
    # it waits for no optimisation: one of the corrections, the newest but for a busy machine
    corrections = [np.zeros(3)]
    for heard in live.heard['correction']:
        p = heard.pose.pose
        corrections.append(
            np.array(
                [p.position.x, p.position.y, 2.0 * np.arctan2(p.orientation.z, p.orientation.w)]
            )
        )
    assert len(corrections) > 2
    in_map = se2.compose(T, newest.observation.odom_pose)
    off = [np.abs(se2.between(se2.compose(C, newest.T_local_base), in_map)).max()
           for C in corrections]  # fmt: skip
    assert min(off) < 1e-9, off


def test_back_end_is_told_of_by_its_diagnostics(live):
    front, back = start(live)
    drive(live, front, back, end=3.0)
    figures = back.figures()
    assert figures['keyframes'] >= 2
    assert figures['frames without their points or detections'] == 0
    assert figures['constellations not searched'] == 0
    back.mapper.back_end.constellation_search.not_searched = 2
    assert back.figures()['constellations not searched'] == 2


def test_front_end_that_begins_anew_begins_a_new_map(live):
    front, back = start(live)
    drive(live, front, back, end=4.0)
    there = np.array([50.0, 0.0, 0.0])
    front.control.start_at(
        encode.pose_with_covariance(make, SECOND, 'map', there, 1e-4 * np.eye(3))
    )
    drive(live, front, back, start=4.0, end=5.0)
    _, poses = back.mapper.back_end.trajectory()
    assert 1 <= len(poses) <= 15
    assert (poses[:, 0] > 45.0).all()


# --- services -------------------------------------------------------------------------------


def test_services_answer_in_words(live, tmp_path):
    front, back = start(live, map_directory=str(tmp_path))
    early = live.call(Trigger, 'back_end/save_map', Trigger.Request())
    assert not early.success
    assert early.message == 'there is no map yet'
    drive(live, front, back, end=6.0)

    saved = live.call(Trigger, 'back_end/save_map', Trigger.Request())
    assert saved.success, saved.message
    saved_files = {p.name for p in tmp_path.iterdir() if '.journal-' not in p.name}
    assert saved_files == {'map.csv', 'map.pgm', 'map.rlml', 'map.yaml'}
    assert len(reflector_file.load(tmp_path / 'map.csv')) >= 3

    grid = live.call(GetMap, 'back_end/dynamic_map', GetMap.Request()).map
    assert grid.info.width * grid.info.height == len(grid.data) > 0

    keyframes = len(back.mapper.back_end.keyframes)
    load = LoadMap.Request
    refused = live.call(LoadMap, 'back_end/load_map', load(map_url='none'))
    assert refused.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
    answer = live.call(LoadMap, 'back_end/load_map', load(map_url='map'))
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    assert len(back.mapper.back_end.keyframes) == keyframes

    answer = live.call(SetBool, 'back_end/pause_new_measurements', SetBool.Request(data=True))
    assert answer.success
    assert back.mapper.system.frames.is_paused
    assert len(back.mapper.back_end.keyframes) == keyframes

    reset = live.call(Trigger, 'back_end/reset', Trigger.Request())
    assert reset.success
    live.spin_until(lambda: np.abs(front.front_end.state.pose).max() < 1e-9)
    assert back.mapper.back_end.keyframes == []


def test_loop_closures_are_listed_and_revoked_by_service(live):
    front, back = start(live)
    drive(live, front, back, end=3.0)
    back_end = back.mapper.back_end
    i, j = 0, len(back_end.keyframes) - 1
    delta = se2.between(back_end.graph.poses[i], back_end.graph.poses[j])
    edge = back_end.graph.add_edge(EdgeKind.CLOSURE, i, j, delta, np.eye(3))
    back_end.loop_closer.records.append(Closure(i, j, delta, 0.7, edge, 'fits', number=0))
    listed = live.call(Trigger, 'back_end/closures', Trigger.Request())
    assert listed.success
    assert parse(listed.message, 'back_end')[0]['state'] == 'active'

    ask = AddDiagnostics.Request
    for number, reason in (('7', 'there is no loop closure 7'), ('x', 'is not the number')):
        answer = live.call(AddDiagnostics, 'back_end/revoke_closure', ask(load_namespace=number))
        assert not answer.success
        assert reason in answer.message
    answer = live.call(AddDiagnostics, 'back_end/revoke_closure', ask(load_namespace='0'))
    assert answer.success, answer.message
    assert not back_end.graph.edges.enabled[edge]
    assert back.figures()['closures revoked'] == 1


@pytest.mark.parametrize('name', ['../map', '/etc/map', '.'])
def test_maps_stay_inside_their_folder(live, tmp_path, name):
    folder = str(tmp_path / 'maps')
    with pytest.raises(MapError, match='is not inside of map_directory'):
        live.start(BackEndNode, map_directory=folder, map_file_name=name)
    gc.collect()  # the node that was not made
    back = live.start(BackEndNode, map_directory=folder)
    answer = back.set_parameters([Parameter('map_file_name', value=name)])[0]
    assert not answer.successful
    assert 'is not inside of map_directory' in answer.reason
    assert back.params.node.map_file_name == 'map'


def test_saved_map_serves_for_localization(live, tmp_path):
    slam = replayed(20.0)
    slam.finish()
    reflectors = slam.reflectors()
    reflector_file.save(reflectors, tmp_path / 'map.csv')
    front, back = start(live, map_directory=str(tmp_path), mode='localization')
    live.spin_until(lambda: front.control.session.map is not None)
    assert len(front.control.session.map.reflectors) == len(reflectors)
    drive(live, front, back)
    assert back.mapper.back_end.keyframes == []
    stamps, poses = slam.trajectory()
    got = decode.pose_estimate(live.heard['pose'][-1])
    want = poses[np.flatnonzero(stamps == got.stamp)[0]]
    # the map's reflectors are known to a few millimetres
    np.testing.assert_allclose(se2.between(want, got.pose), 0.0, atol=0.03)
    loaded = live.call(LoadMap, 'back_end/load_map', LoadMap.Request(map_url='map'))
    assert loaded.result == LoadMap.Response.RESULT_SUCCESS
    missing = live.call(LoadMap, 'back_end/load_map', LoadMap.Request(map_url='none'))
    assert missing.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST


def test_robot_that_was_carried_away_finds_itself_in_its_map(live, tmp_path):
    """Mapped, then localizing, then given a wrong pose: one call brings it back."""
    front, back = start(live)
    drive(live, front, back, end=6.0)
    call = live.call
    here = call(Trigger, 'back_end/relocalize', Trigger.Request())
    assert here.success, here.message
    assert 'this is where it is believed to be' in here.message

    switched = call(SetBool, 'back_end/set_localization_mode', SetBool.Request(data=True))
    assert switched.success
    assert 'reflectors and a grid' in switched.message
    live.spin_until(lambda: front.front_end._p.node.mode == 'localization')
    keys = len(back.mapper.back_end.keyframes)
    drive(live, front, back, start=6.0, end=9.0)
    assert len(back.mapper.back_end.keyframes) == keys

    wrong = se2.compose(front.last.T_map_base, np.array([1.0, -0.8, 2.0]))
    front.control.start_at(
        encode.pose_with_covariance(make, SECOND, 'map', wrong, 1e-4 * np.eye(3))
    )
    drive(live, front, back, start=9.0, end=10.0)
    believed = front.last.T_map_base
    found = call(Trigger, 'back_end/relocalize', Trigger.Request())
    assert found.success, found.message
    session = front.control.session.session
    live.spin_until(
        lambda: (
            front.control.session.session != session
            or np.hypot(*(front.front_end.state.pose - believed)[:2]) > 0.5
        )
    )
    slam = replayed(10.0)
    stamps, poses = slam.trajectory()
    want = poses[np.flatnonzero(stamps == front.last.stamp)[0]]
    # a cell of the grid
    error = se2.between(want, front.front_end.state.pose)
    assert np.hypot(*error[:2]) < 0.05
    assert abs(error[2]) < 0.03

    back_to_mapping = call(SetBool, 'back_end/set_localization_mode', SetBool.Request(data=False))
    assert back_to_mapping.success
    live.spin_until(lambda: front.front_end._p.node.mode == 'mapping')
    drive(live, front, back, start=10.0, end=12.0)
    assert 0 < len(back.mapper.back_end.keyframes) < keys


def test_place_that_cannot_be_told_is_told_as_such(live):
    start(live, use_reflectors=False)
    for request in (True, False):
        answer = live.call(
            SetBool, 'back_end/set_localization_mode', SetBool.Request(data=request)
        )
        assert answer.success is not request
        assert answer.message.startswith('there is no map yet' if request else 'maps already')
    lost = live.call(Trigger, 'back_end/relocalize', Trigger.Request())
    assert not lost.success
    assert lost.message.startswith('not found: there is no map')
    assert 'initialpose' in lost.message
    live.call(Empty, 'reinitialize_global_localization', Empty.Request())


def test_search_without_an_answer_is_logged_whether_it_finds_or_not(live, monkeypatch):
    services = start(live)[1].map_services
    live.listen('/rosout', 'rcl_interfaces/msg/Log', 100)
    live.spin_until(lambda: live.ear.count_publishers('/rosout') > 2)
    for found in (False, True, False):
        answer = Future()
        monkeypatch.setattr(services._requests, 'relocalize', lambda answer=answer: answer)
        services.reinitialize(None, None)
        answer.set_result(SimpleNamespace(success=found, text=f'found: {found}'))

    def said():
        return [m.msg[-11:].strip() for m in live.heard['/rosout'] if 'reinitialize' in m.msg]

    live.spin_until(lambda: len(said()) == 3, what='not all answers are in the log')


def test_search_that_fails_is_answered_and_holds_up_no_service(live, monkeypatch):
    def fail(*_):
        raise np.linalg.LinAlgError('singular')

    monkeypatch.setattr(searcher, 'locate', fail)
    back = live.start(BackEndNode)
    lost = live.call(Trigger, 'back_end/relocalize', Trigger.Request())
    assert not lost.success
    assert 'the search failed: singular' in lost.message
    assert back.message_guard.unexpected.total() == 1
    saved = live.call(Trigger, 'back_end/save_map', Trigger.Request())
    assert saved.message == 'there is no map yet'


def test_search_that_takes_its_time_holds_up_no_other_service(live):
    back = live.start(BackEndNode)
    back.mapper.searcher.delay = 600.0
    client = live.ear.create_client(Trigger, 'back_end/relocalize')
    live.spin_until(client.service_is_ready)
    lost = client.call_async(Trigger.Request())
    live.spin_until(lambda: back.mapper.answers)
    saved = live.call(Trigger, 'back_end/save_map', Trigger.Request())
    assert saved.message == 'there is no map yet'
    assert not lost.done()


def test_map_in_the_making_does_not_jump(live):
    front, back = start(live)
    drive(live, front, back, end=6.0)
    # as if odometry and scans had lied together
    back.mapper.system.T_map_local = np.array([3.0, 0.0, 0.0])
    poses = back.mapper.back_end.graph.poses.copy()
    answer = live.call(Trigger, 'back_end/relocalize', Trigger.Request())
    assert not answer.success
    assert re.search(r'(2\.9|3\.0)\d m from where it is believed', answer.message)
    assert 'set_localization_mode' in answer.message
    np.testing.assert_array_equal(back.mapper.back_end.graph.poses, poses)
