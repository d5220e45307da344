# SPDX-License-Identifier: Apache-2.0
"""Two runs of a fleet, bag by bag: what got worse, and by how much on average."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rlml_lab.fleet.results import Record
from rlml_slam.errors import ParameterError

RESAMPLES, SEED = 2000, 0  # of the bootstrap
INTERVAL = (2.5, 97.5)  # [%]


@dataclass(frozen=True)
class Limit:
    """How far a figure may change: the larger of an absolute step and a share of the old value.

    ``sign`` is +1 where more is worse, -1 where less is.
    """

    title: str
    sign: int
    step: float
    share: float

    def is_worse(self, old: float, new: float) -> bool:
        """Whether the change is beyond the limit."""
        return self.sign * (new - old) > max(self.step, self.share * abs(old))


# figure of a row -> its limit
LIMITS: Mapping[str, Limit] = {
    'frames': Limit('poses', -1, 5.0, 0.01),
    'lost_s': Limit('LOST [s]', 1, 1.0, 0.1),
    'degraded_s': Limit('DEGRADED [s]', 1, 2.0, 0.5),
    'closures': Limit('closures', -1, 2.0, 0.3),
    'live_ate_rmse_m': Limit('live error [m]', 1, 0.01, 0.3),
    'ate_rmse_m': Limit('optimised error [m]', 1, 0.01, 0.3),
    'relations_trans_mean_m': Limit('relations [m]', 1, 0.002, 0.1),
    'relations_rot_mean_deg': Limit('relations [°]', 1, 0.05, 0.1),
}


@dataclass(frozen=True)
class Verdict:
    """One bag against the baseline: what got worse, and whether its files have the same bytes."""

    name: str
    worse: tuple[str, ...]
    is_same: bool


@dataclass(frozen=True)
class Effect:
    """Mean of the paired differences of a figure over ``bags``, with a 95 % interval."""

    figure: str
    bags: int
    mean: float
    low: float
    high: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval excludes no change."""
        return self.low > 0.0 or self.high < 0.0


def limits_with(changes: Sequence[str]) -> dict[str, Limit]:
    """The limits with some changed: NAME=STEP or NAME=STEP,SHARE. ParameterError if it is not."""
    limits = dict(LIMITS)
    for text in changes:
        name, _, values = text.partition('=')
        if name not in limits:
            raise ParameterError(f'--limit {text}: {name!r} is none of {", ".join(limits)}')
        old = limits[name]
        try:
            step, share = [*map(float, values.split(',')), old.share][:2]
            if not (0.0 <= step < np.inf and 0.0 <= share < np.inf):
                raise ValueError
        except ValueError:
            raise ParameterError(f'--limit {text}: is not NAME=STEP or NAME=STEP,SHARE') from None
        limits[name] = Limit(old.title, old.sign, step, share)
    return limits


def compare(
    old: Sequence[Record],
    new: Sequence[Record],
    limits: Mapping[str, Limit] = LIMITS,
    same_bytes: bool = False,
) -> list[Verdict]:
    """A verdict for each bag of both. With ``same_bytes`` equal bags must give equal bytes."""
    before = {r.name: r for r in old}
    return [_verdict(before[r.name], r, limits, same_bytes) for r in new if r.name in before]


def _verdict(old: Record, new: Record, limits: Mapping[str, Limit], same_bytes: bool) -> Verdict:
    a, b = old.row, new.row
    is_same = bool(a.get('results')) and a.get('results') == b.get('results')
    worse = []
    if b['status'] != a['status'] and b['status'] != 'ok':
        worse.append(f'{b["status"]}: {b["problem"]}')
    for figure, limit in limits.items():
        x, y = a.get(figure), b.get(figure)
        if x is not None and y is not None and limit.is_worse(x, y):
            worse.append(f'{limit.title} {x:g} → {y:g}')
        elif x is not None and y is None and b['status'] == 'ok':
            worse.append(f'{limit.title} {x:g} → none')
    must_be_same = old.key == new.key != '' or (same_bytes and a.get('bag') == b.get('bag'))
    if must_be_same and not is_same and b['status'] != 'failed':
        worse.append('other bytes')
    return Verdict(new.name, tuple(worse), is_same)


def effects(
    old: Sequence[Record], new: Sequence[Record], figures: Sequence[str] = tuple(LIMITS)
) -> list[Effect]:
    """What changed on average: paired by bag, 95 % by bootstrap over the bags (fixed seed)."""
    before = {r.name: r.row for r in old}
    out = []
    for figure in figures:
        pairs = [(before[r.name].get(figure), r.row.get(figure)) for r in new if r.name in before]
        d = np.array([y - x for x, y in pairs if x is not None and y is not None], dtype=float)
        if len(d):
            pick = np.random.default_rng(SEED).integers(0, len(d), (RESAMPLES, len(d)))
            low, high = np.percentile(d[pick].mean(axis=1), INTERVAL)
            out.append(Effect(figure, len(d), float(d.mean()), float(low), float(high)))
    return out


def effect_rows(found: Sequence[Effect]) -> list[list[str]]:
    """Cells for a table of effects."""
    return [
        [
            LIMITS[e.figure].title, str(e.bags), f'{e.mean:+.4g}',
            f'{e.low:+.4g} … {e.high:+.4g}', _word(e),
        ]
        for e in found
    ]  # fmt: skip


def _word(e: Effect) -> str:
    if not e.is_clear:
        return 'no clear change'
    return 'worse' if LIMITS[e.figure].sign * e.mean > 0.0 else 'better'
