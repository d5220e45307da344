# SPDX-License-Identifier: Apache-2.0
"""How often a robot whose place is unknown is looked for in the map."""

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from rlml_slam.slam.relocalization.search_schedule import (
    DRAWN,
    FARTHEST,
    LONGEST,
    MOVED,
    PERIOD,
    RARER,
    TURNED,
    SearchSchedule,
)

SECOND = 1_000_000_000


def searched(lasts, pose=lambda _: np.zeros(3), period=SECOND // 10, drawn=False):
    """Seconds since the first frame without a place at which there is a search."""
    pace, at = SearchSchedule(SECOND, drawn), []
    for stamp in range(0, lasts * SECOND, period):
        if pace.is_due(SimpleNamespace(stamp=SECOND + stamp, T_map_base=pose(stamp / SECOND))):
            at.append(stamp / SECOND)
    return np.array(at)


def test_three_times_a_second_at_first():
    assert len(searched(3)) == math.ceil(3 * SECOND / PERIOD)


def test_map_that_has_to_be_drawn_is_searched_once_a_second_and_not_for_a_scan_or_two():
    wait = DRAWN / SECOND
    at = searched(60, lambda seconds: np.array([2.0 * MOVED * seconds, 0.0, 0.0]), drawn=True)
    assert at[0] == wait
    assert np.diff(at[:5]) == pytest.approx(wait)
    assert np.diff(at).min() >= wait - 1e-9
    assert searched(2, period=1_600_000_000, drawn=True).tolist() == [1.6]  # a slow laser


def test_where_it_stands_the_cost_is_bounded_and_so_is_the_wait():
    at = searched(3600)
    longest = LONGEST / SECOND
    for a, b in pairwise(at.tolist()):
        assert b - a <= max(PERIOD / SECOND, min(a / RARER, longest)) + 0.1
    geometric = RARER + math.log(RARER * longest / 3.0) / math.log(1.0 + 1.0 / RARER) + 1
    assert len(at) < geometric + 3600 / longest
    assert max(b - a for a, b in pairwise(at.tolist())) < longest + 0.1


@pytest.mark.parametrize(
    'step', [np.array([0.02 * MOVED, 0.0, 0.0]), np.array([0.0, 0.0, 0.02 * TURNED])]
)
def test_once_it_moves_on_it_is_looked_for_where_it_comes(step):
    """An hour in a room that is not mapped, then out of it: a step ten times a second."""

    def pose(seconds):
        return max(seconds - 3600.0, 0.0) * 10.0 * step

    at = searched(3720, pose)
    moving = at[at >= 3600.0]
    assert moving[0] < 3600.0 + 50 * 0.1 + 0.2
    # each time it has gone as far again, and a tenth of MOVED or TURNED more than before
    steps = np.diff(moving)
    assert steps[0] < 5.3
    assert steps.max() < 5.0 * (1.0 + len(moving) / RARER) + 0.3


def test_robot_that_drives_on_through_what_is_not_mapped_is_searched_ever_less():
    at = searched(600, lambda seconds: np.array([MOVED * seconds, 0.0, 0.0]))
    assert np.diff(at[10:15]).max() < 2.0
    assert np.diff(at)[-5:].max() < FARTHEST + 0.2
    assert len(at) < 160


def test_stamps_that_jump_back_do_not_end_the_search():
    pace = SearchSchedule(50 * SECOND)
    frame = SimpleNamespace(stamp=100 * SECOND, T_map_base=np.zeros(3))
    assert pace.is_due(frame)
    assert not pace.is_due(frame)
    frame.stamp = 60 * SECOND
    assert pace.is_due(frame)
