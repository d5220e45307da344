# SPDX-License-Identifier: Apache-2.0
"""Lines, stamps and numbers of plain and compressed text files."""

from __future__ import annotations

import gzip
import lzma

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlml_slam.datasets.text_file import format_stamp, parse_numbers, parse_stamp, read_lines
from rlml_slam.errors import FileFormatError

TEXT = b'# a comment\n1 2\n\n  3 4  \n'


@pytest.mark.parametrize('pack', [bytes, gzip.compress, lzma.compress])
def test_lines_are_read_whatever_packs_them(tmp_path, pack):
    # the content decides, not the name
    path = tmp_path / 'numbers.dat'
    path.write_bytes(pack(TEXT))
    assert list(read_lines(path)) == [(2, '1 2'), (4, '3 4')]


@pytest.mark.parametrize('pack', [gzip.compress, lzma.compress])
def test_truncated_archive_is_named(tmp_path, pack):
    path = tmp_path / 'numbers.dat'
    path.write_bytes(pack(bytes(range(256)) * 400)[:-20])
    with pytest.raises(FileFormatError, match=r'numbers\.dat: the compressed file is damaged'):
        list(read_lines(path))


def test_mark_of_an_editor_at_the_beginning_is_no_text(tmp_path):
    (tmp_path / 'a.tum').write_text('# stamp\n1.0\n', 'utf-8-sig')
    assert list(read_lines(tmp_path / 'a.tum')) == [(2, '1.0')]


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileFormatError, match=r'missing\.txt: cannot be read: No such file'):
        list(read_lines(tmp_path / 'missing.txt'))


@pytest.mark.parametrize(
    ('word', 'stamp'),
    [
        ('976052857.337530', 976052857_337530000),
        ('0.000000001', 1),
        ('12', 12_000_000_000),
        ('1.5e9', 1_500_000_000_000_000_000),
        ('-0.25', -250_000_000),
        ('1.0000000004', 1_000_000_000),
    ],
)
def test_stamps_are_exact(word, stamp):
    assert parse_stamp(word) == stamp


@pytest.mark.parametrize('word', ['nan', 'inf', 'abc', '', '1.2.3', '1,5'])
def test_what_is_no_time_is_refused(word):
    with pytest.raises(ValueError, match='not a time'):
        parse_stamp(word)


@given(st.integers(min_value=-(2**62), max_value=2**62))
def test_format_and_parse_are_inverse(stamp):
    assert parse_stamp(format_stamp(stamp)) == stamp


@pytest.mark.parametrize('word', ['nan', 'inf', 'x', ''])
def test_numbers_are_finite(word):
    with pytest.raises(ValueError, match=r'not finite|could not convert'):
        parse_numbers(['1', word])
