# SPDX-License-Identifier: Apache-2.0
"""What the parts of EKF-SLAM cost: lines of a dense scan, an update among many landmarks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rlml_slam.ekf.filter import Filter
from rlml_slam.estimation.landmark_models import POINT
from rlml_slam.params import Ransac
from rlml_slam.se2 import Array
from rlml_slam.sensing.features import lines as ransac
from rlml_slam.types import Motion

BEAMS = 1440
HALF_ROOM = (4.0, 3.0)  # [m]
LANDMARKS, NEAR, SEEN = 500, 60, 10  # in the state, in the local region, in one look
RANGE, NOISE = 60.0, 0.01  # [m] of the landmarks, of a beam
R = np.diag([1e-4, 1e-5])
Q = np.diag([4e-3, 2e-3, 4e-3]) ** 2


def figures() -> dict[str, float]:
    """Times [ms] of the processor: RANSAC, and one look (predict and updates) of both filters."""
    postponed, plain = make_filter(), make_filter()
    near = np.hypot(*(postponed.points - postponed.x[:2]).T)
    postponed.choose(near <= np.sort(near)[NEAR - 1])
    quick, slow = median_ms(lambda: look(postponed), 20), median_ms(lambda: look(plain), 5)
    points = room()
    return {
        'ransac_ms': median_ms(lambda: ransac.extract(points, np.zeros(2), Ransac()), 50),
        'look_postponed_ms': quick,
        'look_plain_ms': slow,
        'settle_ms': median_ms(postponed.settle, 1),
    }


def lines(speed: Mapping[str, Any]) -> list[str]:
    """The figures in words."""
    return [
        f'RANSAC lines of {BEAMS} beams: {speed["ransac_ms"]:.2f} ms.',
        f'Predict and update with {SEEN} of {LANDMARKS} landmarks, {NEAR} of them near: '
        f'{speed["look_postponed_ms"]:.2f} ms; the filter that updates all of them each time: '
        f'{speed["look_plain_ms"]:.1f} ms. The others follow when the region changes, in '
        f'{speed["settle_ms"]:.1f} ms.',
    ]


def median_ms(function: Callable[[], Any], times: int) -> float:
    """Median time [ms] of the processor that a call takes, after a first one if there are more."""
    spent = []
    for _ in range(times):
        began = time.process_time()
        function()
        spent.append(1e3 * (time.process_time() - began))
    return round(float(np.median(spent)), 3)


def room() -> Array:
    """End points (n, 2) of one sweep in a rectangular room, with noise."""
    a = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    c, s = np.cos(a), np.sin(a)
    with np.errstate(divide='ignore'):
        r = np.minimum(HALF_ROOM[0] / np.abs(c), HALF_ROOM[1] / np.abs(s))
    r += NOISE * np.random.default_rng(0).standard_normal(BEAMS)
    return r[:, None] * np.stack([c, s], -1)


def make_filter() -> Filter:
    """A filter that has seen every landmark once."""
    rng = np.random.default_rng(0)
    out = Filter(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]), 0.01, POINT)
    for _ in range(LANDMARKS):
        out.augment(np.array([rng.uniform(1.0, RANGE), rng.uniform(-np.pi, np.pi)]), R)
    return out


def look(filter_: Filter) -> None:
    """A step of the robot, and the first landmarks of the region as they are expected."""
    filter_.predict(Motion(np.array([0.1, 0.0, 0.01]), Q))
    for slot in range(SEEN):
        h = POINT.observe(filter_.x[:3], filter_.points[slot][None])[0][0]
        filter_.update(slot, h, R)
