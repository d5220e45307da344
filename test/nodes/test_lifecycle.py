# SPDX-License-Identifier: Apache-2.0
"""Managed nodes: what each state has, takes and publishes, and what a transition must not lose."""

from __future__ import annotations

import gc

import pytest
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from live import LATCHED, room
from nav_msgs.srv import LoadMap
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from rlml_slam.errors import MapError
from rlml_slam.maps.reflector_file import COLUMNS
from rlml_slam.nodes import front_end
from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.deformable_slam import DeformableSlamNode
from rlml_slam.nodes.ekf_slam import EkfSlamNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.nodes.reflector_detector import ReflectorDetectorNode
from rlml_slam.nodes.slam import connected
from rlml_slam.ros.managed_node import KINDS
from rlml_slam.slam.conversation import LocalizeIn
from rlml_slam.slam.store import map_file

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
STATES = {1: 'unconfigured', 2: 'inactive', 3: 'active', 4: 'finalized'}
BY_NAME = {
    'configure': Transition.TRANSITION_CONFIGURE,
    'cleanup': Transition.TRANSITION_CLEANUP,
    'activate': Transition.TRANSITION_ACTIVATE,
    'deactivate': Transition.TRANSITION_DEACTIVATE,
    'unconfigured shutdown': Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    'inactive shutdown': Transition.TRANSITION_INACTIVE_SHUTDOWN,
    'active shutdown': Transition.TRANSITION_ACTIVE_SHUTDOWN,
}


def change(live, node, name):
    """Whether a client's transition succeeded, and the state that the node answers with."""
    request = ChangeState.Request(transition=Transition(id=BY_NAME[name]))
    answer = live.call(ChangeState, f'{node.get_name()}/change_state', request)
    state = live.call(GetState, f'{node.get_name()}/get_state', GetState.Request())
    return answer.success, STATES[state.current_state.id]


def feed(front, since, until):
    """Messages of the room between two seconds of it, as subscriptions give them."""
    index = {stream: k for k, (stream, _) in enumerate(front.sensors._queues)}
    for stream, msg in room(seconds=until):
        stamp = msg.header.stamp.sec + 1e-9 * msg.header.stamp.nanosec - 1.0
        if stamp >= since:
            front.sensors.receive(index[stream], msg)


def pair(live, **values):
    front = live.start(FrontEndNode, **values)
    front.take = None
    back = connected(front, context=live.context)
    live.add(back)
    front.sensors.stop_waiting()
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    live.spin_until(lambda: front.control.session.mode)
    return front, back


def entities(node):
    return {kind: len(list(getattr(node, kind))) for kind in KINDS}


@pytest.mark.parametrize(
    'kind', [FrontEndNode, BackEndNode, EkfSlamNode, DeformableSlamNode, ReflectorDetectorNode]
)
def test_client_walks_through_every_transition(live, kind):
    node = live.start(kind, autostart=False)
    bare = entities(node)
    for name, after in (
        ('activate', (False, 'unconfigured')),
        ('configure', (True, 'inactive')),
        ('configure', (False, 'inactive')),
        ('deactivate', (False, 'inactive')),
        ('activate', (True, 'active')),
        ('cleanup', (False, 'active')),
        ('deactivate', (True, 'inactive')),
        ('activate', (True, 'active')),
        ('deactivate', (True, 'inactive')),
        ('cleanup', (True, 'unconfigured')),
    ):
        assert change(live, node, name) == after, name
    assert entities(node) == bare  # nothing of the work is left
    for name, after in (('configure', 'inactive'), ('inactive shutdown', 'finalized')):
        assert change(live, node, name) == (True, after)
    assert entities(node) == bare


@pytest.mark.parametrize('state', ['unconfigured', 'active'])
def test_shutdown_ends_the_work_in_every_state(live, state):
    node = live.start(BackEndNode, autostart=state == 'active')
    assert change(live, node, f'{state} shutdown') == (True, 'finalized')
    assert not node.is_configured


def test_unconfigured_node_has_parameters_that_all_may_change(live):
    node = live.start(BackEndNode, autostart=False)
    assert not hasattr(node, 'mapper')
    (answer,) = node.set_parameters([Parameter('map_directory', value='elsewhere')])
    assert answer.successful
    assert change(live, node, 'configure') == (True, 'inactive')
    assert node.mapper.archive.folder.root.name == 'elsewhere'
    (answer,) = node.set_parameters([Parameter('map_directory', value='again')])
    assert not answer.successful
    assert 'restart it, or clean it up first' in answer.reason


def test_configure_fails_in_words_and_may_be_tried_again(live):
    node = live.start(BackEndNode, autostart=False, mode='localization', map_file_name='none')
    bare = entities(node)
    assert change(live, node, 'configure') == (False, 'unconfigured')
    assert entities(node) == bare
    node.set_parameters([Parameter('mode', value='mapping')])
    assert change(live, node, 'configure') == (True, 'inactive')


def test_autostart_raises_what_prevents_it(live):
    with pytest.raises(MapError, match='none'):
        live.start(BackEndNode, mode='localization', map_file_name='none')


def test_error_of_our_own_leads_to_unconfigured(live, monkeypatch):
    node = live.start(BackEndNode, autostart=False)
    monkeypatch.setattr(node, 'build', lambda: 1 / 0)
    assert change(live, node, 'configure') == (False, 'unconfigured')


@pytest.mark.parametrize(
    ('error', 'state'), [(MapError('no'), 'inactive'), (ValueError('bug'), 'unconfigured')]
)
def test_failed_activation_leaves_nothing_active(live, monkeypatch, error, state):
    node = live.start(BackEndNode, autostart=False)

    def fail():
        raise error

    monkeypatch.setattr(node, 'begin', fail)
    assert change(live, node, 'configure') == (True, 'inactive')
    assert change(live, node, 'activate') == (False, state)
    assert not node.is_active


def test_inactive_front_end_takes_and_publishes_nothing_and_goes_on_in_its_session(live):
    front, _ = pair(live)
    live.listen('pose', POSE)
    live.spin_until(lambda: front.count_subscribers('pose') == 1)
    feed(front, 0.0, 3.0)
    live.drain()
    frames, session, heard = (
        front.last.stamp,
        front.control.session.session,
        len(live.heard['pose']),
    )
    assert heard > 5
    assert change(live, front, 'deactivate') == (True, 'inactive')
    feed(front, 3.0, 4.0)
    live.drain()
    assert front.last.stamp == frames
    assert len(live.heard['pose']) == heard
    assert change(live, front, 'activate') == (True, 'active')
    feed(front, 4.0, 6.0)
    live.drain()
    assert front.last.stamp > frames + 2_000_000_000
    assert front.control.session.session == session
    assert len(live.heard['pose']) > heard + 5


def test_back_end_goes_on_with_its_map_after_a_pause(live):
    front, back = pair(live)
    feed(front, 0.0, 4.0)
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    before = [k.stamp for k in back.mapper.back_end.keyframes]
    assert change(live, back, 'deactivate') == (True, 'inactive')
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    assert back.mapper.journal._file is not None  # what was mapped is on the disk
    feed(front, 4.0, 5.0)
    assert change(live, back, 'activate') == (True, 'active')
    feed(front, 5.0, 8.0)
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    after = [k.stamp for k in back.mapper.back_end.keyframes]
    assert after[: len(before)] == before
    assert len(after) > len(before)
    assert back.mapper.system.session == front.control.session.session


def test_inactive_back_end_is_reported_by_the_front_end_beside_it(live):
    front, back = pair(live)
    feed(front, 0.0, 2.0)
    assert change(live, back, 'deactivate') == (True, 'inactive')
    assert any('back_end is not active' in p for p in front.problems())
    assert change(live, back, 'activate') == (True, 'active')
    assert front.problems() == ()


def test_cleanup_saves_the_map_and_frees_it(live, tmp_path):
    gc.unfreeze()
    gc.collect()
    own = gc.get_freeze_count()  # of the interpreter: some in Python 3.12
    front, back = pair(live)
    feed(front, 0.0, 8.0)
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    keys = len(back.mapper.back_end.keyframes)
    assert keys > 5
    gc.freeze()  # as the run of the executable does
    for name in ('deactivate', 'cleanup'):
        assert change(live, back, name)[0]
    (saved,) = (tmp_path / 'maps').glob('*.rlml')
    assert len(map_file.load(saved).arrays['pose']) == keys
    gc.collect()
    assert gc.get_freeze_count() <= own
    for name in ('configure', 'activate'):
        assert change(live, back, name)[0]
    assert back.mapper.back_end.keyframes == []


def test_map_that_is_loaded_before_the_activation_is_the_one_that_is_used(live, tmp_path):
    for name in 'ab':
        row = f'0,-1,{ord(name)},0,1e-4,0,1e-4,9,'
        (tmp_path / f'{name}.csv').write_text('\n'.join([','.join(COLUMNS), row, '']))
    given = {'map_directory': str(tmp_path), 'mode': 'localization', 'map_file_name': 'a'}
    front = live.start(FrontEndNode)
    back = live.start(BackEndNode, **given, autostart=False)
    assert change(live, back, 'configure')[0]
    live.call(LoadMap, 'back_end/load_map', LoadMap.Request(map_url='b'))
    assert change(live, back, 'activate')[0]
    back.mapper.worker.submit(lambda: None).result()
    live.listen('reflector_map', 'visualization_msgs/msg/MarkerArray', LATCHED)
    live.spin_until(lambda: live.heard['reflector_map'])
    live.drain()
    assert front.control.session.map.id == back.mapper.system.map.id


def test_localization_goes_on_after_a_front_end_was_configured_again(live, tmp_path):
    front, back = pair(live)
    feed(front, 0.0, 8.0)
    live.spin_until(lambda: back.mapper.worker.backlog == 0)
    back.mapper.worker.submit(lambda: back.requests.save('map')).result()
    back.mapper.worker.submit(lambda: back.requests.localize(True)).result()
    live.spin_until(lambda: front.control.session.map is not None)
    for name in ('deactivate', 'cleanup', 'configure', 'activate'):
        assert change(live, front, name)[0]
    front.sensors.stop_waiting()
    live.spin_until(lambda: front.control.session.map is not None)


def test_front_end_that_is_configured_again_knows_that_the_back_end_runs(live, start):
    front = live.start(FrontEndNode)
    start('back_end')
    live.spin_until(lambda: front.control._absent is None)
    for name in ('deactivate', 'cleanup', 'configure', 'activate'):
        assert change(live, front, name)[0]
    live.spin_until(lambda: front.control._absent is None, what='is back_end running?')


@pytest.mark.parametrize('is_first', [True, False])
def test_command_that_comes_while_the_front_end_is_configured_is_carried_out(
    live, monkeypatch, is_first
):
    front = live.start(FrontEndNode, autostart=not is_first)
    command, make = LocalizeIn(7, None), front_end.FramePublisher

    def publisher(*of):
        front.command(command)
        return make(*of)

    for name in () if is_first else ('deactivate', 'cleanup'):
        assert change(live, front, name)[0]
    monkeypatch.setattr(front_end, 'FramePublisher', publisher)
    executed = []
    monkeypatch.setattr(
        front_end.FrontEndControl, 'execute', lambda control, c: executed.append((control, c))
    )
    for name in ('configure', 'activate'):
        assert change(live, front, name)[0]
    live.spin_until(lambda: executed)
    assert executed == [(front.control, command)]


def test_command_to_a_front_end_that_is_not_configured_costs_nothing(live):
    front = live.start(FrontEndNode)
    for name in ('deactivate', 'cleanup'):
        assert change(live, front, name)[0]
    front.command(LocalizeIn(7, None))


def test_simulated_time_that_was_chosen_at_run_time_goes_on_after_cleanup(live):
    node = live.start(BackEndNode)
    node.set_parameters([Parameter('use_sim_time', value=True)])
    for name in ('deactivate', 'cleanup', 'configure', 'activate'):
        assert change(live, node, name)[0]
    clock = live.ear.create_publisher(Clock, '/clock', 10)

    def is_heard():
        clock.publish(Clock(clock=Time(sec=200)))
        return node.get_clock().now().nanoseconds == 200_000_000_000

    live.spin_until(is_heard)
    for use in (False, True):
        assert node.set_parameters([Parameter('use_sim_time', value=use)])[0].successful


def test_process_waits_for_its_manager_and_ends_cleanly(live, start):
    process = start('slam', '--ros-args', '-p', 'autostart:=false')
    for name in ('front_end', 'back_end'):
        for transition, after in (('configure', 2), ('activate', 3)):
            request = ChangeState.Request(transition=Transition(id=BY_NAME[transition]))
            # it answers once the kernels are there
            answer = live.call(ChangeState, f'{name}/change_state', request, timeout=300.0)
            assert answer.success
            state = live.call(GetState, f'{name}/get_state', GetState.Request())
            assert state.current_state.id == after
    live.listen('front_end/health', 'diagnostic_msgs/msg/DiagnosticStatus')
    live.spin_until(lambda: live.heard['front_end/health'])
    process.interrupt()
    code, out = process.finish()
    assert code == 0
    assert 'Traceback' not in out
