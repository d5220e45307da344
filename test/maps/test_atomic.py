# SPDX-License-Identifier: Apache-2.0
"""A file is the old one or the new one, and what is said to be written is on the disk."""

from __future__ import annotations

import os

import pytest

from rlml_slam.errors import MapError
from rlml_slam.maps.atomic_file import write_atomically


def test_bytes_are_on_the_disk_before_the_name_and_the_name_after(tmp_path, monkeypatch):
    done = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, 'fsync', lambda handle: (done.append('sync'), sync(handle)))
    monkeypatch.setattr(os, 'replace', lambda *names: (done.append('replace'), replace(*names)))
    path = tmp_path / 'file'
    write_atomically(path, b'a', memoryview(b'bc'), before=lambda at: done.append(at.name))
    assert done == ['sync', 'file', 'replace', 'sync']
    assert path.read_bytes() == b'abc'
    assert path.stat().st_mode & 0o777 == 0o644


def test_file_that_cannot_be_written_leaves_the_old_one_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / 'file'
    path.write_bytes(b'old')

    def full(handle):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(MapError, match='file: cannot be written: No space left'):
        write_atomically(path, b'new')
    assert path.read_bytes() == b'old'
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(MapError, match='nowhere'):
        write_atomically(tmp_path / 'nowhere' / 'file', b'new')
