# SPDX-License-Identifier: Apache-2.0
import hashlib
import io
import os
import resource
import signal
import struct
import subprocess
import sys
import textwrap
import tracemalloc
import zipfile

import numpy as np
import pytest

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.pieces import Pieces

OLD, NEW = (
    Content(
        {
            'poses': np.full((20, 3), float(which)),
            'grid': np.full((300, 300), which, dtype=np.uint16),
            'none': np.zeros((0, 2)),
        },
        {'which': which, 'name': 'hall ä'},
    )
    for which in (1, 2)
)


def same(a, b):
    assert a.description == b.description
    assert a.arrays.keys() == b.arrays.keys()
    for name, array in a.arrays.items():
        assert array.dtype == b.arrays[name].dtype
        np.testing.assert_array_equal(array, b.arrays[name])


def test_what_was_written_is_read(tmp_path):
    path = map_container.write(tmp_path / 'deep' / 'a.rlml', NEW)
    same(map_container.read(path), NEW)
    assert sorted(p.name for p in path.parent.iterdir()) == ['a.rlml']
    # other tools open it
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        assert 'poses.npy' in archive.namelist()


def test_equal_maps_are_equal_files(tmp_path):
    a, b = (map_container.write(tmp_path / name, NEW).read_bytes() for name in 'ab')
    assert a == b


def test_pieces_are_one_array_in_the_file(tmp_path):
    rows = [np.arange(5, dtype=np.uint16), np.full(200_000, 7, dtype=np.uint16)]
    pieces = Pieces(np.uint16, [lambda a=a: a for a in rows], [len(a) for a in rows])
    path = map_container.write(tmp_path / 'a.rlml', Content({'cells': pieces}, {}))
    same(map_container.read(path), Content({'cells': np.concatenate(rows)}, {}))
    np.testing.assert_array_equal(pieces, np.concatenate(rows))
    empty = Content({'cells': Pieces(np.uint16, [], [])}, {})
    assert map_container.read(map_container.write(path, empty)).arrays['cells'].shape == (0,)


def test_a_large_array_is_never_there_twice(tmp_path):
    size = 8 << 20  # bytes of a piece, of which there are eight
    pieces = Pieces(np.uint8, [lambda: np.zeros(size, dtype=np.uint8)] * 8, [size] * 8)
    tracemalloc.start()
    path = map_container.write(tmp_path / 'a.rlml', Content({'cells': pieces}, {}))
    written = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    content = map_container.read(path)
    read = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert written < 4 * size
    assert content.arrays['cells'].nbytes == 8 * size
    assert read < 12 * size


def test_map_before_stays(tmp_path):
    path = map_container.write(tmp_path / 'a.rlml', OLD)
    map_container.write(path, NEW)
    same(map_container.read(path), NEW)
    same(map_container.read(f'{path}.previous'), OLD)


@pytest.mark.parametrize('seed', range(4))
def test_damage_anywhere_is_refused_and_the_map_before_named(tmp_path, seed):
    path = map_container.write(tmp_path / 'a.rlml', OLD)
    map_container.write(path, NEW)
    good, rng = path.read_bytes(), np.random.default_rng(seed)
    for k in range(250):
        bad = bytearray(good)
        if k % 3 == 0:
            del bad[rng.integers(len(bad)) :]
        elif k % 3 == 1:
            # the header as often as all the rest
            at = rng.integers(map_container.SIZE if k % 2 else len(bad))
            bad[at] ^= 1 << int(rng.integers(8))
        else:
            at = int(rng.integers(len(bad)))
            bad[at : at + 512] = rng.bytes(min(512, len(bad) - at))
        path.write_bytes(bad)
        with pytest.raises(FileFormatError, match=r'a\.rlml.*before it is whole.*previous'):
            map_container.read(path)
    same(map_container.read(f'{path}.previous'), OLD)


@pytest.mark.parametrize('is_full', [False, True])
def test_map_before_stays_where_files_have_one_name(is_full, tmp_path, monkeypatch):
    def none(*_):
        raise PermissionError(1, 'Operation not permitted')

    path = map_container.write(tmp_path / 'a.rlml', OLD)
    monkeypatch.setattr('os.link', none)
    if is_full:
        monkeypatch.setattr('shutil.copy2', none)
        with pytest.raises(MapError, match='Operation not permitted'):
            map_container.write(path, NEW)
        same(map_container.read(path), OLD)
        assert [*tmp_path.iterdir()] == [path]
        return
    map_container.write(path, NEW)
    same(map_container.read(path), NEW)
    same(map_container.read(f'{path}.previous'), OLD)
    assert len([*tmp_path.iterdir()]) == 2


def test_every_bit_of_the_header_counts(tmp_path):
    path = map_container.write(tmp_path / 'a.rlml', NEW)
    good = path.read_bytes()
    for bit in range(8 * map_container.SIZE):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(bad)
        with pytest.raises(FileFormatError):
            map_container.read(path)


def test_damaged_map_does_not_replace_the_one_before(tmp_path):
    path = map_container.write(tmp_path / 'a.rlml', OLD)
    map_container.write(path, NEW)
    path.write_bytes(path.read_bytes()[:-1])
    map_container.write(path, NEW)
    same(map_container.read(path), NEW)
    same(map_container.read(f'{path}.previous'), OLD)


WRITER = textwrap.dedent("""
    import sys
    import numpy as np
    from rlml_slam.maps import map_container
    which = 3
    while True:
        arrays = {'poses': np.full((20, 3), float(which)), 'grid': np.full((600, 600), which)}
        map_container.write(sys.argv[1], map_container.Content(arrays, {'which': which}))
        print(which, flush=True)
        which += 1
""")


def test_kill_while_saving_never_loses_a_map(tmp_path):
    path = map_container.write(tmp_path / 'a.rlml', OLD)
    rng = np.random.default_rng(0)
    for _ in range(6):
        with subprocess.Popen(
            [sys.executable, '-c', WRITER, str(path)], stdout=subprocess.PIPE, text=True
        ) as child:
            for _ in range(int(rng.integers(1, 4))):
                child.stdout.readline()
            # into the middle of the next one
            try:
                child.wait(float(rng.uniform(0.0, 0.02)))
            except subprocess.TimeoutExpired:
                os.kill(child.pid, signal.SIGKILL)
        found = map_container.read(path)
        which = found.description['which']
        assert (found.arrays['poses'] == which).all()
        assert (found.arrays['grid'] == which).all()
        map_container.read(f'{path}.previous')


def test_unwritable_folder_leaves_the_map(tmp_path, monkeypatch):
    path = map_container.write(tmp_path / 'a.rlml', OLD)

    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(MapError, match='No space left'):
        map_container.write(path, NEW)
    monkeypatch.undo()
    same(map_container.read(path), OLD)
    assert [p.name for p in tmp_path.iterdir()] == ['a.rlml']


def test_file_of_another_kind_is_refused(tmp_path):
    with pytest.raises(MapError, match='cannot be read'):
        map_container.read(tmp_path / 'none.rlml')
    other = tmp_path / 'other.rlml'
    for data in (b'', b'PK\x03\x04 and so on' * 20, b'RLMLMAP'):
        other.write_bytes(data)
        with pytest.raises(FileFormatError, match='not a map'):
            map_container.read(other)


def test_object_is_never_unpickled(tmp_path):
    objects = Content({'bad': np.array([{}], dtype=object)}, {})
    with pytest.raises(ValueError, match=r'[Oo]bject'):
        map_container.write(tmp_path / 'a.rlml', objects)
    assert list(tmp_path.iterdir()) == []


def packed(members):
    """A container of which the checksums are right, whatever is in it."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    body = out.getvalue()
    head = map_container.HEAD.pack(
        map_container.MAGIC, map_container.VERSION, len(body), hashlib.sha256(body).digest()
    )
    return head + hashlib.sha256(head).digest()[:16] + body


def npy(shape, data=b''):
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + '\n'
    return b'\x93NUMPY\1\0' + struct.pack('<H', len(text)) + text.encode() + data


@pytest.mark.parametrize(
    'members',
    [
        {'description.json': b'{}', 'a.npy': bytes(300_000_000)},
        {'description.json': b'[' * 100_000},
        {'description.json': b'3'},
        {'description.json': b'{}', 'a.npy': npy((10**12,))},
        {'description.json': b'{}', 'a.npy': npy((10, 10), bytes(8))},
        {'description.json': b'{}', 'a.npy': npy('(' * 500)},
        {'a.npy': npy((1,), bytes(8))},
    ],
    ids=['bomb', 'depth', 'number', 'declared', 'short', 'header', 'no description'],
)
def test_foreign_content_with_a_right_checksum_is_refused(members, tmp_path):
    path = tmp_path / 'a.rlml'
    path.write_bytes(packed(members))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileFormatError, match='not a map of this program'):
        map_container.read(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # [KB]


def test_array_with_its_own_size_is_read(tmp_path):
    path = tmp_path / 'a.rlml'
    path.write_bytes(packed({'description.json': b'{}', 'a.npy': npy((1,), bytes(8))}))
    np.testing.assert_array_equal(map_container.read(path).arrays['a'], [0.0])
