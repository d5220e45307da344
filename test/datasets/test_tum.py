# SPDX-License-Identifier: Apache-2.0
"""Trajectories as text."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rlml_slam.datasets.tum import Trajectory, read_tum, write_tum
from rlml_slam.errors import FileFormatError
from rlml_slam.se2 import wrap


def test_written_trajectory_reads_back(tmp_path):
    rng = np.random.default_rng(0)
    poses = rng.uniform(-100.0, 100.0, (50, 3))
    poses[:, 2] = wrap(poses[:, 2])
    stamps = 1_700_000_000_123_456_789 + np.arange(50, dtype=np.int64) * 10_000_001
    write_tum(tmp_path / 'a.tum', Trajectory(stamps, poses))
    back = read_tum(tmp_path / 'a.tum')
    assert_array_equal(back.stamps, stamps)
    # nine decimals are written, twelve of the quaternion
    assert_allclose(back.poses, poses, atol=1e-9)


def test_same_trajectory_gives_the_same_bytes(tmp_path):
    t = Trajectory(np.array([1], dtype=np.int64), np.array([[0.1, 0.2, np.pi]]))
    write_tum(tmp_path / 'a.tum', t)
    write_tum(tmp_path / 'b.tum', t)
    assert (tmp_path / 'a.tum').read_bytes() == (tmp_path / 'b.tum').read_bytes()


def test_yaw_of_a_tilted_pose_is_taken(tmp_path):
    # roll of 0.2 about x, then yaw of 0.5 about z: q = q_z q_x
    cz, sz, cx, sx = np.cos(0.25), np.sin(0.25), np.cos(0.1), np.sin(0.1)
    q = (cz * sx, sz * sx, sz * cx, cz * cx)
    path = tmp_path / 'a.tum'
    path.write_text('1.0 1 2 3 ' + ' '.join(map(repr, map(float, q))))
    assert_allclose(read_tum(path).poses, [[1.0, 2.0, 0.5]], atol=1e-12)


@pytest.mark.parametrize(
    ('line', 'why'),
    [
        ('2.0 0 0 0 0 0 0', '7 values, 8 expected'),
        ('2.0 0 0 0 0 0 0 2', 'not of unit length'),
        ('2.0 nan 0 0 0 0 0 1', 'not finite'),
        ('x 0 0 0 0 0 0 1', 'not a time'),
        ('1.0 0 0 0 0 0 0 1', 'stamp 1.0 does not rise'),
        ('2.0 a 0 0 0 0 0 1', 'could not convert'),
    ],
)
def test_bad_line_is_named(tmp_path, line, why):
    path = tmp_path / 'bad.tum'
    path.write_text(f'# stamp x y z qx qy qz qw\n1.0 0 0 0 0 0 0 1\n{line}\n')
    with pytest.raises(FileFormatError, match=rf'bad\.tum:3: .*{why}'):
        read_tum(path)


def test_file_without_poses_is_refused(tmp_path):
    (tmp_path / 'empty.tum').write_text('# nothing\n')
    with pytest.raises(FileFormatError, match='no poses'):
        read_tum(tmp_path / 'empty.tum')
