# SPDX-License-Identifier: Apache-2.0
"""Every "eq. n" of code, configuration and documentation is a number of docs/equations.md."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / 'docs' / 'equations.md').read_text(encoding='utf-8')
NUMBERED = [int(n) for n in re.findall(r'<a id="eq-(\d+)"></a>\(\1\) ', PAGE)]
# "eq. 3", "eq. 3 and 11", "eqs. 5, 7-9", "eq. 12–14"
REFERENCE = re.compile(r'\beqs?\. ?(\d+(?:(?:-|–|, | and | to )\d+)*)', re.IGNORECASE)
FOLDERS = ('rlml_slam', 'rlml_lab', 'test', 'docs', 'config')


def numbers(reference):
    """The numbers of "5, 7-9": 5, 7, 8, 9."""
    for part in re.split(r', | and ', reference):
        ends = [int(n) for n in re.split(r'-|–| to ', part)]
        yield from range(ends[0], ends[-1] + 1)


def test_equations_are_numbered_from_1_on_without_gaps():
    assert list(range(1, len(NUMBERED) + 1)) == NUMBERED


def test_every_reference_to_an_equation_resolves():
    found = 0
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob('*')):
            if path.suffix not in ('.py', '.md', '.yaml') or path == Path(__file__):
                continue
            for match in REFERENCE.finditer(path.read_text(encoding='utf-8')):
                found += 1
                wrong = set(numbers(match[1])) - set(NUMBERED)
                assert not wrong, f'{path.relative_to(ROOT)}: {match[0]}: no such equation'
    assert found > 30


def test_equations_name_code_that_exists():
    files = set(re.findall(r'`(rlml_(?:slam|lab)/[\w/]+\.py)`', PAGE))
    assert len(files) > 30
    assert not [f for f in files if not (ROOT / f).is_file()]


def test_references_are_read_as_written():
    assert list(numbers(REFERENCE.search('(eq. 5, 7-9)')[1])) == [5, 7, 8, 9]
    assert list(numbers(REFERENCE.search('Eqs. 3 and 11.')[1])) == [3, 11]
