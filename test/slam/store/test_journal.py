# SPDX-License-Identifier: Apache-2.0
"""A map is made again from its journal, to the last bit."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import ROOM, drive, observations

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps import map_container
from rlml_slam.maps.map_container import SIZE, Content
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.closures.loop_closure import State
from rlml_slam.slam.front_end.front_end import FrontEnd
from rlml_slam.slam.keyframes import FoundPose
from rlml_slam.slam.store import map_file
from rlml_slam.slam.store.journal import Journal, has_base, recover

PARAMS = Parameters()
DRIVE = drive((0.6, 0.0, 3.0), (0.6, 0.6, 4.0), (0.5, -0.7, 2.0))
PIECE = 10  # frames


@pytest.fixture(scope='module')
def frames():
    front_end = FrontEnd(PARAMS)
    seen = observations(ROOM, DRIVE, rng=np.random.default_rng(0))
    return [front_end.process(o) for o in seen]


def write(path, frames, back_end, base=None):
    """The journal of a drive; the number of keyframes after each of its pieces."""
    journal, counts = Journal(PARAMS, base), []
    with path.open('wb') as file:
        for k in range(0, len(frames), PIECE):
            for frame in frames[k : k + PIECE]:
                journal.add(frame, back_end.add(frame) is not None)
            journal.write(file)
            counts.append((file.tell(), len(back_end.keyframes)))
    return counts


def same(a, b):
    one, two = (map_file.content_of(x, PARAMS, None) for x in (a, b))
    assert one.arrays.keys() == two.arrays.keys()
    for name in one.arrays:
        np.testing.assert_array_equal(one.arrays[name], two.arrays[name], err_msg=name)


def test_recovered_map_is_that_of_the_process(frames, tmp_path):
    back_end = BackEnd(PARAMS)
    write(tmp_path / 'journal', frames, back_end)
    again, params = recover(tmp_path / 'journal')
    assert len(back_end.keyframes) > 10
    assert len(back_end.reflectors()) > 3
    assert params == PARAMS
    same(back_end, again)


def test_recovered_map_has_the_loop_where_a_search_has_found_the_robot(frames, tmp_path):
    """Two pieces that lie a metre apart in the local frame, and on each other in the map."""
    back_end, journal, middle = BackEnd(PARAMS), Journal(PARAMS), len(frames) // 2
    later, aside = frames[-1].stamp, np.array([1.0, 0.0, 0.0])
    again = [
        replace(f, stamp=f.stamp + later, T_local_base=f.T_local_base + aside) for f in frames
    ]
    with (tmp_path / 'journal').open('wb') as file:
        for k, frame in enumerate([*frames, *again]):
            is_found = k == len(frames) + middle
            T = frame.T_local_base
            found = FoundPose(T, T - aside, 400.0) if is_found else None
            update = back_end.add(frame, found)
            journal.add(frame, update is not None, found)
            assert not is_found or update is not None  # it is a keyframe
        journal.write(file)
    same(back_end, recover(tmp_path / 'journal')[0])


def test_continued_map_is_recovered_with_what_it_was_made_of(frames, tmp_path):
    first = BackEnd(PARAMS)
    for frame in frames:
        first.add(frame)
    saved = map_file.save(tmp_path / 'map.rlml', first, PARAMS)
    base, second = map_file.load(saved), BackEnd(PARAMS)
    map_file.restore(base, second)
    write(tmp_path / 'journal', frames, second, base)
    saved.unlink()
    same(second, recover(tmp_path / 'journal')[0])


def test_revoked_closure_stays_revoked(tmp_path):
    """Frames, a revocation and frames again: in one piece of the journal, and in three."""
    laps = drive((0.6, 0.6, 10.5), (0.6, 0.6, 10.5), (0.6, 0.6, 3.0))
    front_end, back_end = FrontEnd(PARAMS), BackEnd(PARAMS)
    journals = Journal(PARAMS), Journal(PARAMS)
    number = None
    with (tmp_path / 'a').open('wb') as a, (tmp_path / 'b').open('wb') as b:
        for o in observations(ROOM, laps, rng=np.random.default_rng(1)):
            frame = front_end.process(o)
            update = back_end.add(frame)
            accepted = back_end.loop_closer.records.accepted()
            for journal in journals:
                journal.add(frame, update is not None)
            if number is None and len(accepted) > 1:
                number = accepted[0].number
                back_end.revoke(number)
                journals[1].write(b)
                for journal in journals:
                    journal.revoke(number)
                journals[1].write(b)
        journals[0].write(a)
        journals[1].write(b)
    assert number is not None
    for name in 'ab':
        again, _ = recover(tmp_path / name)
        same(back_end, again)
        assert again.loop_closer.records.accepted()[0].status.state is State.REVOKED


def test_journal_knows_whether_it_continues_a_map(frames, tmp_path):
    back_end = BackEnd(PARAMS)
    write(tmp_path / 'first', frames[:30], back_end)
    base = map_file.content_of(back_end, PARAMS, None)
    write(tmp_path / 'second', frames[30:], back_end, base)
    assert [has_base(tmp_path / name) for name in ('first', 'second')] == [False, True]
    (tmp_path / 'other').write_bytes(b'x' * 200)
    assert not has_base(tmp_path / 'other')


def test_file_that_ends_anywhere_gives_all_whole_pieces(frames, tmp_path):
    path = tmp_path / 'journal'
    counts = write(path, frames, BackEnd(PARAMS))
    data, rng = path.read_bytes(), np.random.default_rng(1)
    for end in rng.integers(counts[0][0], len(data), 12):
        path.write_bytes(data[:end])
        whole = max(keys for size, keys in counts if size <= end)
        assert len(recover(path)[0].keyframes) == whole


def test_piece_that_is_damaged_ends_the_journal(frames, tmp_path):
    path = tmp_path / 'journal'
    counts = write(path, frames, BackEnd(PARAMS))
    data = bytearray(path.read_bytes())
    for at in (counts[2][0] + 3, counts[2][0] + SIZE + 5):
        damaged = data.copy()
        damaged[at] ^= 1
        path.write_bytes(damaged)
        assert len(recover(path)[0].keyframes) == counts[2][1]


@pytest.mark.parametrize('data', [b'', b'x' * 200])
def test_other_files_are_refused(data, tmp_path):
    path = tmp_path / 'journal'
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match='not a journal'):
        recover(path)


def test_journal_of_another_version_is_refused(tmp_path):
    path = tmp_path / 'journal'
    other = Content({}, {'format': 'rlml_slam journal', 'version': 99})
    path.write_bytes(b''.join(map_container.pack(other)))
    with pytest.raises(FileFormatError, match='another version'):
        recover(path)


def test_missing_journal_is_an_error(tmp_path):
    with pytest.raises(MapError, match='cannot be read'):
        recover(tmp_path / 'journal')
