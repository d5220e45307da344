# SPDX-License-Identifier: Apache-2.0
"""Frames and first angles of the messages of one stream: a rare one is not of the robot's sensor.

One message in another frame, or with another first angle, would be seen from a wrong pose. Several
lidars in turn, and scans whose first angle alternates, have kinds that are about as frequent; a
sensor that was replaced, or set up in another way, sends one kind only.
"""

from __future__ import annotations

from collections import Counter, deque

MEMORY = 100  # messages that are compared
RARE = 20  # times as frequent is another kind: lidars that share a topic differ by less
REPEATED = 5  # messages in a row of one kind: the sensor is another one now
SAME = 0.02  # [rad] between first angles of one kind


class SensorKinds:
    """Kinds (frame, first angle) of the newest messages of a stream."""

    def __init__(self) -> None:
        self._seen: deque[tuple[str, float]] = deque(maxlen=MEMORY)

    def is_foreign(self, frame_id: str, angle: float = 0.0) -> bool:
        """Add a message; whether its kind is rare beside another one."""
        kind = (frame_id, angle)
        self._seen.append(kind)
        if RARE * self._seen.count(kind) >= len(self._seen):
            return False
        newest = [self._seen[-k] for k in range(1, REPEATED + 1)]
        alike = sum(_is_same(kind, other) for other in self._seen)
        most = max(Counter(self._seen).values())
        return RARE * alike < most and not all(_is_same(kind, other) for other in newest)


def _is_same(a: tuple[str, float], b: tuple[str, float]) -> bool:
    return a[0] == b[0] and abs(a[1] - b[1]) <= SAME
