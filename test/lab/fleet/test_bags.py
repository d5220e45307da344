# SPDX-License-Identifier: Apache-2.0
"""Bags are found here and in stores, and named by where they are."""

from __future__ import annotations

import pytest

from rlml_lab.fleet.bags import find_bags, local_copy
from rlml_slam.errors import BagError
from rlml_slam.recordings.origin import digest_of

fsspec = pytest.importorskip('fsspec')
FILES = ('r1/a/metadata.yaml', 'r1/a/a_0.mcap', 'r2/a/metadata.yaml', 'r2/a/a_0.db3', 'r2/b.bag',
         'r2/c.mcap', 'r2/notes.txt', 'r3/broken/x.db3')  # fmt: skip
NAMES = ['r1/a', 'r2/a', 'r2/b.bag', 'r2/c.mcap', 'r3/broken']


@pytest.fixture
def here(tmp_path):
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


@pytest.fixture
def in_memory(here):
    fs = fsspec.filesystem('memory')
    for name in FILES:
        fs.pipe_file(f'/found/{name}', name.encode())
    yield 'memory://found'
    fs.rm('/found', recursive=True)


def names(*urls) -> list[str]:
    return [bag.name for bag in find_bags([str(u) for u in urls])]


def test_bags_are_named_below_the_folder_given(here, in_memory):
    assert names(here) == names(in_memory) == NAMES
    assert names(here / 'r2') == ['a', 'b.bag', 'c.mcap']
    assert names(here / 'r1/a') == names(f'{in_memory}/r1/a') == ['a']
    assert names(here / 'r2/b.bag', here / 'r1') == ['a', 'b.bag']


def test_bags_below_links_are_found_and_links_in_a_circle_end(here, tmp_path_factory):
    top = tmp_path_factory.mktemp('linked')
    (top / 'robot').symlink_to(here / 'r2', target_is_directory=True)
    (top / 'again').symlink_to(top, target_is_directory=True)
    (top / 'gone').symlink_to(top / 'nothing')
    assert names(top) == ['robot/a', 'robot/b.bag', 'robot/c.mcap']


def test_globs_are_named_below_their_fixed_part(here, in_memory):
    assert names(here / 'r*/a') == names(f'{in_memory}/r*/a') == ['r1/a', 'r2/a']
    assert names(here / 'r2/*.bag') == ['b.bag']


def test_no_bag_and_two_of_one_name_are_errors(here):
    with pytest.raises(BagError, match='no bag there'):
        find_bags([str(here / 'nothing')])
    with pytest.raises(BagError, match='would both be named a'):
        find_bags([str(here / 'r1'), str(here / 'r2')])
    with pytest.raises(BagError, match='cannot be read'):
        find_bags(['nonsense://x'])


def test_copy_has_the_same_digest_wherever_it_is_from(here, in_memory, tmp_path_factory):
    for bag, remote in zip(find_bags([str(here)]), find_bags([in_memory]), strict=True):
        copy = local_copy(remote.url, tmp_path_factory.mktemp('copy'))
        assert digest_of(copy) == digest_of(local_copy(bag.url, here))


def test_digest_knows_names_and_bytes(here):
    seen = {digest_of(here)}
    (here / 'r2/c.mcap').write_text('other')
    seen.add(digest_of(here))
    (here / 'r2/c.mcap').rename(here / 'r2/d.mcap')
    seen.add(digest_of(here))
    assert len(seen) == 3
