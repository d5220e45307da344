# SPDX-License-Identifier: Apache-2.0
"""What stays the same in the messages of a sensor: a rare other value is not of the robot's.

One message in another frame, or with other angles or times of its beams, would be seen from a
wrong pose. Several lidars in turn, and scans whose first angle alternates, have values that are
about as frequent; a sensor that was replaced, or set up in another way, sends its new values only.
How many beams there are is not compared: drivers cut scans off.
"""

from __future__ import annotations

from collections import Counter, deque

MEMORY = 100  # messages that are compared
RARE = 20  # times as frequent is another value: lidars that share a topic differ by less
REPEATED = 5  # messages in a row of one value: the sensor is another one now
SAME = 0.02  # [rad] between first angles that are one
ALIKE = 0.2  # share by which increments differ that are one, as the speed of a motor does

Kind = tuple[str, float]


class SensorKinds:
    """Frame, first angle and increments of the newest messages of a stream."""

    def __init__(self) -> None:
        self._seen: list[deque[Kind]] = []
        self._usual: list[Kind] = []  # of the last message, if none of it is rare

    def is_foreign(self, frame_id: str, angle: float = 0.0, *increments: float) -> bool:
        """Add a message; whether its frame, first angle or an increment is rare beside another."""
        kinds = [(frame_id, value) for value in (angle, *increments)]
        while len(self._seen) < len(kinds):
            self._seen.append(deque(maxlen=MEMORY))
        for seen, kind in zip(self._seen, kinds, strict=True):
            seen.append(kind)
        if kinds == self._usual:  # once more, and no rarer by that
            return False
        pairs = list(zip(self._seen, kinds, strict=True))
        rare = [RARE * seen.count(kind) < len(seen) for seen, kind in pairs]
        self._usual = [] if any(rare) else kinds
        shares = [0.0, *[ALIKE] * len(increments)]
        return any(
            is_rare and _is_foreign(seen, kind, share)
            for is_rare, (seen, kind), share in zip(rare, pairs, shares, strict=True)
        )


def _is_foreign(seen: deque[Kind], kind: Kind, share: float) -> bool:
    """Whether almost all messages, but for some newest ones, have something else."""
    newest = [seen[-k] for k in range(1, REPEATED + 1)]
    alike = sum(_is_same(kind, other, share) for other in seen)
    most = max(Counter(seen).values())
    return RARE * alike < most and not all(_is_same(kind, other, share) for other in newest)


def _is_same(a: Kind, b: Kind, share: float) -> bool:
    """Whether frames are equal and values close: by SAME, or by a ``share`` above 0 of them."""
    limit = share * max(abs(a[1]), abs(b[1])) if share else SAME
    return a[0] == b[0] and abs(a[1] - b[1]) <= limit
