# SPDX-License-Identifier: Apache-2.0
"""YAML whose cost is bounded by the size of its text."""

import pytest
from calls import count_calls

from rlml_slam.errors import FileFormatError
from rlml_slam.plain_yaml import MAX_CHARACTERS, parse_yaml

BOMB = 'a0: &a0 [x]\n' + ''.join(
    f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]\n' for k in range(1, 12)
)


def test_plain_values_are_read():
    assert parse_yaml('a: [1, 2.5, x]\nb: {c: true}', 'f') == {
        'a': [1, 2.5, 'x'],
        'b': {'c': True},
    }


def test_exponents_need_no_point():
    assert parse_yaml('[8e-05, 1E3, -.5e+2, 2.e1]', 'f') == [8e-05, 1e3, -50.0, 20.0]
    assert parse_yaml('[1e, e5, 1e5x, 0x1e5]', 'f') == ['1e', 'e5', '1e5x', 0x1E5]


def test_long_texts_of_digits_are_no_numbers():
    """Where the cost is the square of the length, this takes a minute."""
    text = '1' * 9990 + 'x'
    assert parse_yaml('\n'.join(80 * [f'- {text}']), 'f') == 80 * [text]


@pytest.mark.parametrize(
    ('text', 'why'),
    [
        (BOMB, 'an alias is not allowed here'),
        ('a: &a\n  b: *a', 'an alias is not allowed here'),
        ('a: 2001-99-99', 'not YAML'),
        ('[' * 2000, 'not YAML'),
        ('a: ' + '9' * 5000, 'not YAML'),
        ('a: [', 'not YAML'),
        ('a: 1\nb:\n\tc: 2', 'line 3: found character'),
        ('!!python/object:os.system x', 'not YAML'),
        ('x' * (MAX_CHARACTERS + 1), 'more than'),
        ('- 1\n' * 250_000, 'more than 50 levels or 50000 events'),
        ('a: ' + '[' * 60 + ']' * 60, 'more than 50 levels'),
        ('a: 1' + ':1' * 500_000, 'a value of more than 10000 characters'),
    ],
)
def test_others_are_refused_at_once(text, why):
    def refused():
        with pytest.raises(FileFormatError, match=f'^file.yaml: .*{why}'):
            parse_yaml(text, 'file.yaml')

    assert count_calls(refused) < 500_000  # less than half of what the largest text costs


def test_the_largest_text_that_is_read_costs_some_calls_per_item():
    text = '- 1\n' * 49_000
    assert count_calls(lambda: parse_yaml(text, 'f')) < 40 * 49_000
    assert len(parse_yaml(text, 'f')) == 49_000
