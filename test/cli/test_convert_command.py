# SPDX-License-Identifier: Apache-2.0
"""``rlml convert``: the bag holds what the file held, and the sensors' places."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rlml_slam.cli.convert import Recording, storage_of, write_recording
from rlml_slam.cli.main import main
from rlml_slam.datasets.tum import Trajectory
from rlml_slam.ros.bags.bag import BagReader
from rlml_slam.ros.codecs import decode
from rlml_slam.types import Odometry

LOG = """ODOM 0 0 0 0 0 0 1.0 h 1
FLASER 4 1.5 2.5 90.0 3.5 0.2 0 0 0 0 0 1.1 h 1
ODOM 0.5 0 0.1 0 0 0 1.2 h 1
"""


@pytest.fixture
def log(tmp_path):
    path = tmp_path / 'a.log'
    path.write_text(LOG)
    return path


def messages(path):
    with BagReader(path) as bag:
        return list(bag.messages())


def test_carmen_log_becomes_a_bag(tmp_path, log, capsys):
    assert main(['convert', 'carmen', str(log), str(tmp_path / 'bag'), '--json']) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary['messages'] == {'/tf_static': 1, '/odom': 2, '/scan': 1}
    found = messages(tmp_path / 'bag')
    assert [topic for _, topic, _ in found] == ['/tf_static', '/odom', '/scan', '/odom']
    assert [t for t, _, _ in found] == [1_000_000_000, 1_000_000_000, 1_100_000_000, 1_200_000_000]
    (transform,) = decode.transforms(found[0][2])
    assert (transform.parent, transform.child) == ('base_link', 'laser')
    assert_allclose(transform.t, [0.2, 0.0, 0.0])
    scan = decode.scan(found[2][2])
    assert scan.stamp == 1_100_000_000
    assert_array_equal(scan.ranges, np.array([1.5, 2.5, np.inf, 3.5], np.float32))
    assert_allclose(decode.odometry(found[3][2]).pose, [0.5, 0.0, 0.1])


def test_broken_line_is_told_and_costs_no_other(tmp_path, log, capsys):
    log.write_text(LOG + 'FLASER 180 1.0\n')
    assert main(['convert', 'carmen', str(log), str(tmp_path / 'bag')]) == 0
    out, err = capsys.readouterr()
    assert 'a.log:4: broken FLASER line' in err
    assert '1 broken' in out
    assert main(['convert', 'carmen', str(log), str(tmp_path / 'other'), '--strict']) == 1
    assert not (tmp_path / 'other').exists()


def test_clock_that_was_set_back_is_told(tmp_path, log, capsys):
    laser = 'FLASER 4 1.5 2.5 90.0 3.5 0.2 0 0 0 0 0 {} h 1\n'
    log.write_text(LOG + laser.format(9.0) + laser.format(2.0))
    assert main(['convert', 'carmen', str(log), str(tmp_path / 'bag')]) == 0
    assert 'set back, by 7.0 s at most' in capsys.readouterr().err


def test_bag_is_not_overwritten(tmp_path, log, capsys):
    (tmp_path / 'bag').mkdir()
    assert main(['convert', 'carmen', str(log), str(tmp_path / 'bag')]) == 1
    assert 'exists already' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('name', 'wanted', 'storage'),
    [('a', None, 'mcap'), ('a.mcap', None, 'mcap'), ('a.db3', None, 'sqlite3'),
     ('a.db3', 'mcap', 'mcap'), ('a', 'sqlite3', 'sqlite3')],
)  # fmt: skip
def test_storage_is_asked_for_or_told_by_the_suffix(tmp_path, name, wanted, storage):
    assert storage_of(tmp_path / name, wanted) == storage


def test_sqlite_bag_is_written(tmp_path, log):
    assert main(['convert', 'carmen', str(log), str(tmp_path / 'bag.db3')]) == 0
    assert list((tmp_path / 'bag.db3').glob('*.db3'))
    assert len(messages(tmp_path / 'bag.db3')) == 4


def test_positions_without_headings_become_points(tmp_path):
    truth = Trajectory(np.array([10**9]), np.array([[1.0, 2.0, np.nan]]))
    recording = Recording([Odometry(10**9, np.zeros(3))], truth=truth)
    write_recording(tmp_path / 'bag', recording)
    (point,) = (m for _, topic, m in messages(tmp_path / 'bag') if topic == '/ground_truth')
    assert point.__msgtype__ == 'geometry_msgs/msg/PointStamped'
    assert (point.point.x, point.point.y) == (1.0, 2.0)
