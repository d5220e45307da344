# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rlml_slam.motion import SECOND
from rlml_slam.params import HealthLimits, Node, Parameters
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.stamp_check import StampCheck
from rlml_slam.sensing.synchronization.waiting_queue import PAIRING, WaitingQueue
from rlml_slam.types import Detections, Scan

MS = SECOND // 1000
T0 = 10 * SECOND
PAUSE = 1.0  # [s] of the odometry
T = T0 + 2 * SECOND  # the first second, in which all wait longer, is over


def scan(stamp, frame='laser', sweep=0.0):
    ranges = np.full(10, 2.0, dtype=np.float32)
    none = np.zeros(0, dtype=np.float32)
    return Scan(stamp, frame, -1.0, 0.2, sweep / 10, 0.1, 20.0, ranges, none)


def detections(stamp):
    none = np.zeros((0, 2))
    return Detections(stamp, 'laser', none, np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros(0))


def queue(now, **node):
    """An empty queue, the newest stamp being ``now``."""
    inputs = InputCounts()
    stamps = StampCheck(inputs)
    stamps.accept('odom', T0, None)
    stamps.accept('odom', now, None)
    params = Parameters(node=Node(**node), health=HealthLimits(input_timeout=PAUSE))
    return WaitingQueue(params, stamps, inputs), stamps


def test_scan_waits_for_the_odometry_at_the_end_of_its_sweep():
    waiting, _ = queue(T + 60 * MS)
    waiting.add('scan', scan(T, sweep=0.05), 0)
    assert waiting.pop(T + 40 * MS) == []
    (w,) = waiting.pop(T + 50 * MS)
    assert (w.stamp, w.end) == (T, T + 50 * MS)
    assert len(waiting) == 0


def test_delay_of_the_measurement_moves_the_end():
    waiting, _ = queue(T + 60 * MS)
    waiting.add('scan', scan(T), 30 * MS)
    assert waiting.pop(T + 20 * MS) == []
    assert len(waiting.pop(T + 30 * MS)) == 1


def test_nothing_waits_longer_than_the_timeout():
    waiting, stamps = queue(T + 200 * MS, odom_timeout=0.2)
    waiting.add('scan', scan(T), 0)
    assert waiting.pop(T - MS) == []
    stamps.accept('imu', T + 201 * MS, None)
    assert len(waiting.pop(T - MS)) == 1
    assert waiting._inputs.totals() == {'scan': {'waited_out': 1}}


def test_detections_wait_through_a_pause_of_the_odometry():
    """Without a lidar: up to the longest gap that is bridged, counted from the odometry's end."""
    waiting, stamps = queue(T, odom_timeout=0.2)
    waiting.add('reflectors', detections(T), 0)
    stamps.accept('reflectors', T + 900 * MS, None)
    assert waiting.pop(T - 50 * MS) == []
    stamps.accept('reflectors', T + 951 * MS, None)
    assert len(waiting.pop(T - 50 * MS)) == 1


def test_pause_that_is_waited_out_changes_at_run_time():
    inputs, params = InputCounts(), Parameters(node=Node(odom_timeout=0.2))
    stamps = StampCheck(inputs)
    for stamp in (T0, T):
        stamps.accept('odom', stamp, None)
    waiting = WaitingQueue(params, stamps, inputs)
    params.health.change('input_timeout', 30.0)
    waiting.add('reflectors', detections(T), 0)
    stamps.accept('reflectors', T + 29 * SECOND, None)
    assert waiting.pop(T - 50 * MS) == []
    params.health.change('input_timeout', PAUSE)
    assert len(waiting.pop(T - 50 * MS)) == 1


def test_detections_do_not_wait_beside_a_lidar():
    waiting, stamps = queue(T, odom_timeout=0.2)
    waiting.note_lidar(scan(T - 50 * MS))
    waiting.add('reflectors', detections(T), 0)
    stamps.accept('reflectors', T + 201 * MS, None)
    assert len(waiting.pop(T - 50 * MS)) == 1


@pytest.mark.parametrize(('apart', 'size'), [(PAIRING, 2), (PAIRING + 1, 1)])
def test_scan_and_detections_of_one_instant_belong_together(apart, size):
    waiting, _ = queue(T + 60 * MS)
    waiting.add('reflectors', detections(T + apart), 0)
    waiting.add('scan', scan(T), 0)
    assert len(waiting.pop(T + 50 * MS)) == size


def test_scan_waits_for_detections_while_they_come_in_pairs():
    waiting, _ = queue(T + 20 * MS)
    waiting.note_pair(T - 100 * MS)
    waiting.add('scan', scan(T), 0)
    assert waiting.pop(T + 20 * MS) == []
    waiting.add('reflectors', detections(T), 0)
    assert len(waiting.pop(T + 20 * MS)) == 2


def test_scan_waits_for_the_scan_of_another_lidar_that_is_due():
    waiting, _ = queue(T + 60 * MS)
    for stamp in (T - 150 * MS, T - 50 * MS):
        waiting.note_lidar(scan(stamp, 'rear'))
    waiting.note_lidar(scan(T + 52 * MS, 'front'))
    waiting.add('scan', scan(T + 52 * MS, 'front'), 0)
    assert waiting.pop(T + 60 * MS) == []
    waiting.note_lidar(scan(T + 50 * MS, 'rear'))
    waiting.add('scan', scan(T + 50 * MS, 'rear'), 0)
    assert [w.item.frame_id for w in waiting.pop(T + 60 * MS)] == ['rear']
    assert [w.item.frame_id for w in waiting.pop(T + 60 * MS)] == ['front']


def test_flush_takes_everything():
    waiting, _ = queue(T)
    waiting.add('scan', scan(T), 0)
    waiting.add('scan', scan(T + 100 * MS), 0)
    assert [w.stamp for w in waiting.pop(None, flush=True)] == [T]
    assert [w.stamp for w in waiting.pop(None, flush=True)] == [T + 100 * MS]
    assert waiting.pop(None, flush=True) == []


def test_first_scan_after_a_gap_of_all_messages_waits_until_odometry_is_missing():
    waiting, stamps = queue(T, odom_timeout=0.2)
    waiting.add('scan', scan(T), 0)
    assert len(waiting.pop(T)) == 1
    after = T + 30 * SECOND
    stamps.accept('scan', after + 900 * MS, None)
    waiting.add('scan', scan(after), 0)
    assert waiting.pop(T) == []
    stamps.accept('scan', after + 1001 * MS, None)
    assert len(waiting.pop(T)) == 1
    # the odometry alone is missing: the next ones do not wait
    waiting.add('scan', scan(after + 500 * MS), 0)
    assert len(waiting.pop(T)) == 1
