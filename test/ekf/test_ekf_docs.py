# SPDX-License-Identifier: Apache-2.0
"""The page of the note's slips names checks that exist."""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent
PAGE = (HERE.parents[1] / 'docs' / 'ekf_slam.md').read_text(encoding='utf-8')


def test_every_slip_has_a_check_that_exists():
    tests = re.findall(r'^def (test_\w+)', ''.join(p.read_text() for p in HERE.glob('*.py')), re.M)
    slips = [row for row in PAGE.splitlines() if row.startswith('|') and '`' in row]
    slips = [row for row in slips if 'test_' in row or '…' in row]
    assert len(slips) == 9
    for row in slips:
        (name,) = re.findall(r'`([\w…]+)`', row.rsplit('|', 2)[1])[-1:]
        pattern = re.compile('.*'.join(re.escape(part) for part in name.split('…')))
        assert any(pattern.search(t) for t in tests), name
