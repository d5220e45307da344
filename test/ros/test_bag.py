# SPDX-License-Identifier: Apache-2.0
"""Bags written by the project read back, and damaged ones cost only what is damaged."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from rlml_slam.errors import BagError
from rlml_slam.params import Node
from rlml_slam.ros.bags.bag import BagReader, BagWriter, Topic, choose_topics
from rlml_slam.ros.bags.bag_recovery import BagRecovery
from rlml_slam.ros.codecs import decode, encode
from rlml_slam.ros.codecs.message_types import bag_types, make_bag
from rlml_slam.types import Imu

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(__file__).resolve().parents[3] / 'shared' / 'data'
SECOND = 1_000_000_000
STORAGES = ['mcap', 'sqlite3']


def write(path, storage='mcap', n=20):
    with BagWriter(path, storage) as bag:
        bag.add_topic('/tf_static', 'tf2_msgs/msg/TFMessage', latched=True)
        T = encode.transform(make_bag, SECOND, ('base_link', 'laser'), np.array([0.2, 0.0, 0.1]))
        bag.write('/tf_static', encode.tf_message(make_bag, [T]), SECOND)
        for k in range(n):
            stamp = SECOND + k * 10_000_000
            pose = np.array([0.1 * k, 0.0, 0.0])
            odom = encode.odometry(make_bag, stamp, ('odom', 'base_link'), pose, np.eye(3))
            bag.write('/odom', odom, stamp)
            bag.write('/imu', encode.imu(make_bag, Imu(stamp, 0.1 * k), 'imu'), stamp + 1)
    return path


def storage_file(folder) -> Path:
    (file,) = (f for f in folder.iterdir() if f.suffix in ('.mcap', '.db3'))
    return file


@pytest.mark.parametrize('storage', STORAGES)
def test_what_was_written_is_read(tmp_path, storage):
    with BagReader(write(tmp_path / 'bag', storage)) as bag:
        assert bag.topics['/odom'] == Topic('/odom', 'nav_msgs/msg/Odometry', 20)
        assert bag.start == SECOND
        messages = list(bag.messages())
    assert len(messages) == 41
    assert [t for t, _, _ in messages] == sorted(t for t, _, _ in messages)
    odom = [decode.odometry(m) for _, topic, m in messages if topic == '/odom']
    np.testing.assert_allclose([o.pose[0] for o in odom], 0.1 * np.arange(20))


@pytest.mark.parametrize('storage', STORAGES)
def test_single_file_is_a_bag_too(tmp_path, storage):
    with BagReader(storage_file(write(tmp_path / 'bag', storage))) as bag:
        assert len(list(bag.messages(['/imu']))) == 20


@pytest.mark.parametrize('storage', STORAGES)
def test_same_messages_give_the_same_bytes(tmp_path, storage):
    a, b = (write(tmp_path / folder / 'bag', storage) for folder in 'ab')
    for name in sorted(f.name for f in a.iterdir()):
        assert (a / name).read_bytes() == (b / name).read_bytes()


def test_failed_writing_leaves_nothing_behind(tmp_path):
    with pytest.raises(AttributeError), BagWriter(tmp_path / 'bag') as bag:
        bag.write('/imu', 'no message', SECOND)
    assert list(tmp_path.iterdir()) == []


def test_existing_bag_is_not_overwritten(tmp_path):
    write(tmp_path / 'bag')
    with pytest.raises(BagError, match='exists already'):
        BagWriter(tmp_path / 'bag')


@pytest.mark.parametrize(
    ('name', 'content'),
    [
        ('a.mcap', b'no bag'),
        ('a.db3', b'no bag'),
        ('a.bag', b'no bag'),
        ('a.txt', b''),
        ('b', None),
    ],
)
def test_what_is_no_bag_is_named_in_one_line(tmp_path, name, content):
    path = tmp_path / name
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    with pytest.raises(BagError, match=name) as error:
        BagReader(path)
    assert '\n' not in str(error.value)


def test_folder_named_like_a_ros1_bag_is_read(tmp_path):
    with BagReader(write(tmp_path / 'drive.bag')) as bag:
        assert not bag.is_ros1
        assert bag.count(['/odom']) == 20


def test_missing_bag_is_named(tmp_path):
    with pytest.raises(BagError, match='absent: no such bag'):
        BagReader(tmp_path / 'absent')


def topics(*names_and_types):
    return {n: Topic(n, t, 1) for n, t in names_and_types}


SCAN, ODOM = 'sensor_msgs/msg/LaserScan', 'nav_msgs/msg/Odometry'


def test_topic_is_chosen_by_name_then_namespace_then_type():
    both = topics(('/scan', SCAN), ('/rear/laser', SCAN))
    assert choose_topics(both, Node())['scan'] == '/scan'
    assert choose_topics(both, Node(scan_topic='laser'))['scan'] == '/rear/laser'
    only = topics(('/base_scan', SCAN), ('/wheels', ODOM))
    assert choose_topics(only, Node()) == {'scan': '/base_scan', 'odom': '/wheels'}


def test_switched_off_streams_are_not_chosen():
    only = topics(('/base_scan', SCAN), ('/wheels', ODOM))
    assert choose_topics(only, Node(use_odom=False)) == {'scan': '/base_scan'}


def test_several_fitting_topics_are_listed():
    with pytest.raises(BagError, match=r'fit scan: /a, /b; .* scan_topic, .* scan_topics'):
        choose_topics(topics(('/a', SCAN), ('/b', SCAN)), Node())


def test_bag_without_anything_to_measure_is_refused_with_its_topics():
    with pytest.raises(BagError, match=r'no scan and no reflectors .* /wheels \(nav_msgs'):
        choose_topics(topics(('/wheels', ODOM)), Node())


@pytest.mark.parametrize(
    ('kind', 'hint'), [('MultiEchoLaserScan', 'laser_proc'), ('PointCloud2', 'reflectors_topic')]
)
def test_what_might_have_been_meant_is_named(kind, hint):
    with pytest.raises(BagError, match=f'no scan and no reflectors .*; .*{hint}'):
        choose_topics(topics(('/a', f'sensor_msgs/msg/{kind}')), Node())


def test_any_cloud_is_not_taken_for_reflectors():
    clouds = topics(('/points', 'sensor_msgs/msg/PointCloud2'), ('/scan', SCAN))
    assert choose_topics(clouds, Node()) == {'scan': '/scan'}


@pytest.mark.skipif(not SHARED.is_dir(), reason='the recordings of ../shared are not here')
@pytest.mark.parametrize(
    ('name', 'topic', 'count'),
    [
        ('ros-bags-misc/turtlebot3_sim.bag', '/scan', 457),
        ('ros-bags-misc/jackal_odom_imu.bag', '/imu/data', 3061),
        ('ros-bags-misc/nav2_turtlebot_amcl.mcap', '/odom', 2639),
        ('reflector-r2000/r2000_locate0.bag', '/scan', 38),
    ],
)
def test_recorded_bags_are_read(name, topic, count):
    read = {'scan': decode.scan, 'data': decode.imu, 'odom': decode.odometry}
    with BagReader(SHARED / name) as bag:
        values = [read[topic.split('/')[-1]](m) for _, _, m in bag.messages([topic])]
    assert len(values) == count
    assert not bag.skipped


# --- damage ---------------------------------------------------------------------------------


def readable(path):
    with BagReader(path) as bag:
        return [(time, topic) for time, topic, _ in bag.messages()], bag.damage


def test_mcap_cut_off_gives_what_came_before(tmp_path):
    file = storage_file(write(tmp_path / 'bag', n=2000))
    whole, _ = readable(file)
    data = file.read_bytes()
    for share in (0.5, 0.9):
        cut = tmp_path / f'cut{share}.mcap'
        cut.write_bytes(data[: int(share * len(data))])
        got, damage = readable(cut)
        assert damage.endswith('cut off')
        assert got == whole[: len(got)]
        # the rest of the file is its index
        assert len(got) > (share - 0.2) * len(whole)


def test_sqlite_cut_off_is_refused_in_one_line(tmp_path):
    file = storage_file(write(tmp_path / 'bag', 'sqlite3', n=2000))
    cut = tmp_path / 'cut.db3'
    cut.write_bytes(file.read_bytes()[:500_000])
    with pytest.raises(BagError, match=r'cut\.db3: not a readable bag: .*malformed') as error:
        BagReader(cut)
    assert '\n' not in str(error.value)


def test_sqlite_of_large_messages_cut_off_gives_what_came_before(tmp_path):
    """Large messages lie on pages of their own, which read as NULL where they are cut off."""
    folder = ROOT / 'bags' / 'hall'
    whole, _ = readable(folder)
    data = (folder / 'hall.db3').read_bytes()
    cut = tmp_path / 'hall.db3'
    cut.write_bytes(data[: int(0.6 * len(data))])
    got, damage = readable(cut)
    assert 'malformed' in damage
    assert len(got) > 0.5 * len(whole)
    assert set(got) <= set(whole)


def test_sqlite_cut_off_within_a_page_gives_no_message_that_ends_in_zeros(tmp_path):
    file = storage_file(write(tmp_path / 'bag', 'sqlite3', n=2000))
    with BagReader(file) as bag:
        whole = set(bag.serialized())
    data, cut, most = file.read_bytes(), tmp_path / 'cut.db3', 0
    for k in range(60):
        cut.write_bytes(data[: len(data) - 4096 * 30 + 2003 * k])
        with BagReader(cut) as bag:
            got = set(bag.serialized())
        assert got <= whole
        most = max(most, len(got))
    assert most > 0.9 * len(whole)


@pytest.mark.parametrize('column', ['type', 'name'])
def test_sqlite_topic_without_a_name_or_type_costs_itself_alone(tmp_path, column):
    file = storage_file(write(tmp_path / 'bag', 'sqlite3'))
    with closing(sqlite3.connect(file)) as base:
        base.execute('PRAGMA writable_schema=ON')
        base.execute("UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', '')")
        base.commit()
    with closing(sqlite3.connect(file)) as base:
        base.execute(f"UPDATE topics SET {column} = NULL WHERE name = '/imu'")
        base.commit()
    with BagReader(file) as bag:
        assert {t for _, t, _ in bag.messages()} == {'/odom', '/tf_static'}


@pytest.mark.parametrize(
    'change',
    [
        "topics SET type = x'01' WHERE name = '/imu'",
        "messages SET topic_id = 'two' WHERE topic_id = imu",
        "messages SET timestamp = 'now' WHERE topic_id = imu",
        'messages SET data = 7 WHERE topic_id = imu',
    ],
)
def test_sqlite_row_with_values_of_other_types_costs_itself_alone(tmp_path, change):
    file = storage_file(write(tmp_path / 'bag', 'sqlite3'))
    with closing(sqlite3.connect(file)) as base:
        (imu,) = base.execute("SELECT id FROM topics WHERE name = '/imu'").fetchone()
        changed = base.execute(f'UPDATE {change.replace("= imu", f"= {imu}")}').rowcount
        base.commit()
    assert changed > 0
    bag = BagRecovery(file)
    assert {c.topic for c, _, _ in bag.messages(bag.connections)} == {'/odom', '/tf_static'}


def test_scratched_sqlite_gives_what_comes_before_the_scratch(tmp_path):
    file = storage_file(write(tmp_path / 'bag', 'sqlite3', n=2000))
    whole, _ = readable(file)
    data = bytearray(file.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 8192] = bytes(8192)
    file.write_bytes(data)
    got, damage = readable(file)
    assert damage
    assert got == whole[: len(got)]
    assert len(got) > 0.2 * len(whole)


@pytest.mark.parametrize('at', [24, 28])
def test_sqlite_whose_header_does_not_know_the_number_of_pages_is_read(tmp_path, at):
    """An old SQLite wrote 0, or left the number as it was and changed the counter alone."""
    file = storage_file(write(tmp_path / 'bag', 'sqlite3', n=50))
    whole, _ = readable(file)
    data = bytearray(file.read_bytes())
    data[at : at + 4] = bytes(4) if at == 28 else b'\x00\x00\x77\x77'
    data[28:32] = bytes(4) if at == 28 else (3).to_bytes(4, 'big')
    file.write_bytes(data)
    bag = BagRecovery(file)
    assert len(list(bag.messages(bag.connections))) == len(whole)


def test_sqlite_with_broken_definitions_of_messages_is_read(tmp_path):
    file = storage_file(write(tmp_path / 'bag', 'sqlite3', n=50))
    whole, _ = readable(file)
    with closing(sqlite3.connect(file)) as base:
        where = "SELECT rootpage FROM sqlite_master WHERE name = 'message_definitions'"
        (page,) = base.execute(where).fetchone()
    data = bytearray(file.read_bytes())
    data[(page - 1) * 4096 : page * 4096] = bytes(4096)
    file.write_bytes(data)
    bag = BagRecovery(file)
    assert len(list(bag.messages(bag.connections))) == len(whole)


@pytest.mark.parametrize('metadata', [None, '- 1'])
def test_folder_without_files_of_a_bag_is_named(tmp_path, metadata):
    if metadata is not None:
        (tmp_path / 'metadata.yaml').write_text(metadata)
    (tmp_path / 'bag').mkdir()  # one is named, not the folder of all
    with pytest.raises(BagError, match='no bag: there is no recording in this folder'):
        BagReader(tmp_path)


@pytest.mark.parametrize('storage', STORAGES)
def test_folder_that_lost_its_metadata_is_read(tmp_path, storage):
    folder = write(tmp_path / 'bag', storage)
    whole, _ = readable(folder)
    (folder / 'metadata.yaml').unlink()
    got, damage = readable(folder)
    assert got == whole
    assert 'has no metadata.yaml' in damage


def write_imu(path, stamps, storage='mcap', topics=('/imu',)):
    """Topic by topic."""
    with BagWriter(path, storage) as bag:
        for topic in topics:
            for stamp in stamps:
                bag.write(topic, encode.imu(make_bag, Imu(stamp, 0.1), 'imu'), stamp)
    return path


@pytest.mark.parametrize('storage', STORAGES)
def test_split_recording_without_metadata_comes_in_the_order_of_log_time(tmp_path, storage):
    split = tmp_path / 'split'
    split.mkdir()
    for k in range(12):
        part = write_imu(tmp_path / f'{k}', range(SECOND + 9 * k, SECOND + 9 * k + 9), storage)
        file = storage_file(part)
        file.rename(split / f'split_{k}{file.suffix}')
    got, damage = readable(split)
    assert got == [(SECOND + t, '/imu') for t in range(12 * 9)]
    assert 'has no metadata.yaml' in damage


@pytest.mark.parametrize('storage', STORAGES)
def test_files_without_metadata_that_were_recorded_side_by_side_are_merged(tmp_path, storage):
    both = tmp_path / 'both'
    both.mkdir()
    for k, name in enumerate(('odd', 'even')):
        stamps = range(SECOND + 1 - k, SECOND + 100, 2)
        file = storage_file(write_imu(tmp_path / name, stamps, storage, [f'/{name}']))
        file.rename(both / file.name)
    got, _ = readable(both)
    assert got == [(SECOND + t, '/odd' if t % 2 else '/even') for t in range(100)]


@pytest.mark.parametrize('storage', STORAGES)
def test_file_written_topic_by_topic_comes_in_the_order_of_log_time(tmp_path, storage):
    folder = write_imu(tmp_path / 'bag', range(SECOND, SECOND + 50), storage, ['/a', '/b'])
    with BagReader(folder) as bag:
        whole = sorted(bag.serialized(), key=lambda m: m[:2])
    (folder / 'metadata.yaml').unlink()
    with BagReader(folder) as bag:
        assert list(bag.serialized()) == whole
        assert list(bag.serialized(['/b'])) == [m for m in whole if m[1] == '/b']
        assert (bag.start, bag.end) == (SECOND, SECOND + 50)


def killed(folder, whole, all_in_wal):
    """A SQLite bag whose recorder was killed after it had recorded the messages of one twice."""
    folder.mkdir()
    made = folder.with_name('made.db3')
    if not all_in_wal:
        shutil.copy(whole, made)
    with closing(sqlite3.connect(made)) as base, closing(sqlite3.connect(whole)) as source:
        base.execute('PRAGMA journal_mode=WAL')
        base.execute('PRAGMA wal_autocheckpoint=0')
        if all_in_wal:
            base.executescript('\n'.join(source.iterdump()))
        base.execute(
            'INSERT INTO messages (topic_id, timestamp, data) '
            f'SELECT topic_id, timestamp + {SECOND}, data FROM messages'
        )
        base.commit()
        for end in ('', '-wal'):  # as they are while it is open
            shutil.copy(f'{made}{end}', folder / f'bag.db3{end}')
    return folder / 'bag.db3'


@pytest.mark.parametrize('all_in_wal', [True, False])
@pytest.mark.parametrize('what', ['file', 'folder', 'folder with metadata'])
def test_sqlite_of_a_killed_recorder_is_read_with_its_wal(tmp_path, monkeypatch, all_in_wal, what):
    whole = storage_file(write(tmp_path / 'whole', 'sqlite3', n=20))
    file = killed(tmp_path / 'killed', whole, all_in_wal)
    if what == 'folder with metadata':
        text = (whole.parent / 'metadata.yaml').read_text()
        (file.parent / 'metadata.yaml').write_text(text.replace(whole.name, file.name))
    before = {f.name: f.read_bytes() for f in file.parent.iterdir()}
    (tmp_path / 'temporary').mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'temporary'))
    got, damage = readable(file if what == 'file' else file.parent)
    once, _ = readable(whole)
    assert got == once + [(time + SECOND, topic) for time, topic in once]
    assert ('has no metadata' if what == 'folder' else 'was not closed') in damage
    assert {f.name: f.read_bytes() for f in file.parent.iterdir()} == before
    assert list((tmp_path / 'temporary').iterdir()) == []


def test_wal_that_does_not_fit_in_the_temporary_folder_is_named(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, 'No space left on device')

    whole = storage_file(write(tmp_path / 'whole', 'sqlite3'))
    file = killed(tmp_path / 'killed', whole, all_in_wal=False)
    monkeypatch.setattr(shutil, 'copyfile', full)
    with pytest.raises(BagError, match=r'bag\.db3: cannot be read: No space left on device'):
        BagReader(file)


def write_ros1(path, stamps):
    types, msgtype = get_typestore(Stores.ROS1_NOETIC), 'sensor_msgs/msg/Imu'
    with Ros1Writer(path) as bag:
        imu = bag.add_connection('/imu', msgtype, typestore=types)
        for stamp in stamps:
            message = encode.imu(make_bag, Imu(stamp, 0.1), 'imu')
            raw = bag_types().serialize_cdr(message, msgtype)
            bag.write(imu, stamp, bag_types().cdr_to_ros1(raw, msgtype))
    return path


def test_ros1_bag_is_known_by_its_first_bytes(tmp_path):
    bag = write_ros1(tmp_path / 'a.bag', range(SECOND, SECOND + 50))
    active = shutil.copy(bag, tmp_path / 'a.bag.active')
    assert readable(active) == readable(bag) == ([(SECOND + t, '/imu') for t in range(50)], '')


def test_ros1_bag_of_a_killed_recorder_gives_what_came_before(tmp_path):
    """Sizes and index are written last: the header of the bag and of its last chunk have zeros."""
    bag = write_ros1(tmp_path / 'a.bag', range(SECOND, SECOND + 50))
    data, active = bytearray(bag.read_bytes()), tmp_path / 'a.bag.active'
    for name, size in ((b'index_pos=', 8), (b'compression=none\t\0\0\0size=', 8)):
        at = data.index(name) + len(name)
        data[at : at + size] = bytes(size)
    active.write_bytes(data[: at + 10_000])
    got, damage = readable(active)
    assert got == [(SECOND + t, '/imu') for t in range(len(got))]
    assert len(got) > 10
    assert damage.endswith('a.bag.active is cut off')


def test_scratched_mcap_loses_the_scratched_chunk_alone(tmp_path):
    file = storage_file(write(tmp_path / 'bag', n=2000))
    data = bytearray(file.read_bytes())
    data[-37:] = bytes(37)  # the footer, so that the index is not found
    file.write_bytes(data)
    got, damage = readable(file)
    assert len(got) == 4001
    assert damage


@pytest.mark.skipif(not SHARED.is_dir(), reason='the recordings of ../shared are not here')
@pytest.mark.parametrize('share', [0.3, 0.8])
def test_ros1_bag_cut_off_gives_what_came_before(tmp_path, share):
    data = (SHARED / 'ros-bags-misc' / 'turtlebot3_sim.bag').read_bytes()
    cut = tmp_path / 'cut.bag'
    cut.write_bytes(data[: int(share * len(data))])
    whole, _ = readable(SHARED / 'ros-bags-misc' / 'turtlebot3_sim.bag')
    got, damage = readable(cut)
    assert damage.endswith('cut.bag: cut.bag is cut off')
    assert (share - 0.2) * len(whole) < len(got) < share * 1.1 * len(whole)
    assert set(got) <= set(whole)


def test_broken_messages_are_skipped_and_counted(tmp_path):
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        good = encode.imu(make_bag, Imu(SECOND, 0.1), 'imu')
        bag.write('/imu', good, SECOND)
        bag._writer.write(bag._connections['/imu'], SECOND + 1, b'\x00\x01\x00\x00\xff')
        bag.write('/imu', good, SECOND + 2)
    with BagReader(path) as bag:
        assert [t for t, _, _ in bag.messages()] == [SECOND, SECOND + 2]
        assert bag.skipped == {'/imu': 1}


def test_messages_of_unknown_types_are_skipped_and_counted(tmp_path):
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        bag._connections['/secret'] = bag._writer.add_connection(
            '/secret', 'acme/msg/Secret', msgdef='this is no definition', rihs01='RIHS01_0'
        )
        bag._writer.write(bag._connections['/secret'], SECOND, b'\x00\x01\x00\x00')
        bag.write('/imu', encode.imu(make_bag, Imu(SECOND, 0.1), 'imu'), SECOND)
    with BagReader(path) as bag:
        assert [topic for _, topic, _ in bag.messages()] == ['/imu']
        assert bag.skipped == {'/secret': 1}
        assert [topic for _, topic, _ in bag.serialized()] == ['/secret', '/imu']
