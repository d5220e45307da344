# SPDX-License-Identifier: Apache-2.0
"""What counts as worse, bag by bag and on average."""

from __future__ import annotations

import numpy as np
import pytest

from rlml_lab.fleet.comparison import LIMITS, compare, effects, limits_with
from rlml_lab.fleet.page import fleet_page
from rlml_lab.fleet.results import Record
from rlml_slam.errors import ParameterError

ROW = {
    'name': 'a', 'status': 'ok', 'problem': '', 'bag': 'b', 'results': 'r', 'frames': 100,
    'lost_s': 0.0, 'closures': 10, 'live_ate_rmse_m': 0.02, 'relations_trans_mean_m': 0.03,
}  # fmt: skip


def record(key='k', **changes) -> Record:
    return Record(key, ROW | changes)


def worse(new: Record, **options) -> tuple[str, ...]:
    (verdict,) = compare([record()], [new], **options)
    return verdict.worse


@pytest.mark.parametrize(
    ('change', 'what'),
    [
        ({'frames': 94}, 'poses'), ({'lost_s': 1.1}, 'LOST'), ({'closures': 6}, 'closures'),
        ({'live_ate_rmse_m': 0.031}, 'live error'), ({'live_ate_rmse_m': None}, 'none'),
        ({'relations_trans_mean_m': 0.034}, 'relations'),
        ({'status': 'failed', 'problem': 'broken'}, 'broken'),
    ],
)  # fmt: skip
def test_worse_figure_is_named(change, what):
    (why, *_) = worse(record('other', results='s', **change))
    assert what in why


@pytest.mark.parametrize(
    'change',
    [{'frames': 95}, {'lost_s': 0.9}, {'closures': 8}, {'live_ate_rmse_m': 0.029},
     {'relations_trans_mean_m': 0.031}, {'lost_s': -5.0}, {'closures': 100}],
)  # fmt: skip
def test_small_or_good_change_is_not_worse(change):
    assert worse(record('other', results='s', **change)) == ()


def test_other_bytes_are_worse_only_where_they_must_not_be():
    assert worse(record('k', results='s')) == ('other bytes',)  # same bag, parameters, code
    assert worse(record('other', results='s')) == ()
    assert worse(record('other', results='s'), same_bytes=True) == ('other bytes',)
    assert worse(record('other', results='s', bag='c'), same_bytes=True) == ()
    assert worse(record()) == ()


def test_limits_can_be_changed():
    limits = limits_with(['lost_s=3', 'closures=0,0'])
    assert worse(record('o', lost_s=2.9), limits=limits) == ()
    assert worse(record('o', closures=9), limits=limits)
    assert limits['lost_s'].share == LIMITS['lost_s'].share
    for wrong in ('lost_s', 'nothing=1', 'lost_s=x', 'lost_s=nan', 'lost_s=-1', 'lost_s='):
        with pytest.raises(ParameterError, match='--limit'):
            limits_with([wrong])


def test_interval_of_an_effect_holds_it():
    """95 % of the intervals should; of 100, fewer than 85 has a probability below 1e-4."""
    rng = np.random.default_rng(0)
    holds = 0
    for _ in range(100):
        base = rng.normal(0.05, 0.02, 40)
        old = [record(name=str(k), live_ate_rmse_m=float(x)) for k, x in enumerate(base)]
        new = [record(name=str(k), live_ate_rmse_m=float(x + rng.normal(0.004, 0.01)))
               for k, x in enumerate(base)]  # fmt: skip
        (e,) = effects(old, new, ['live_ate_rmse_m'])
        holds += e.low <= 0.004 <= e.high
        assert e.bags == 40
    assert holds >= 85


def test_page_names_what_got_worse_and_needs_no_network():
    old, new = [record()], [record('o', name='a', lost_s=9.0)]
    new += [Record('', {'name': '<b>', 'status': 'failed', 'problem': 'x & y'})]
    html = fleet_page(new, compare(old, new), effects(old, new))
    assert 'LOST [s] 0 → 9' in html
    assert '&lt;b&gt;' in html
    assert '<b>' not in html.replace('<b>0', '')
    assert 'http' not in html.replace('http-equiv', '')


def test_one_bag_is_one_in_the_page():
    one = record(duration_s=8.0)
    html = fleet_page([one], compare([one], [record(lost_s=9.0)]))
    for text in ('1 bag, 8 s;', '1 bag compared', '1 bag got worse'):
        assert text in html
    assert '2 bags, 16 s;' in fleet_page([one, one])


def test_distribution_of_equal_figures_invents_no_others():
    html = fleet_page([record(), record()])
    assert 'LOST [s]: 0 to 0, median 0' in html
    assert '-0.5' not in html
