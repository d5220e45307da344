# SPDX-License-Identifier: Apache-2.0
"""Message time along the wall clock at a chosen rate."""

from __future__ import annotations


class PlaybackClock:
    """Says when a moment of message time is due; it never drifts, and it forgives stalls.

    Times are seconds: ``now`` of a steady wall clock, ``moment`` since the beginning of the data.
    What is late by more than ``max_lag`` (a machine too slow, a laptop that slept) is not made up
    for, because a burst of old messages would flood the queues; ``stalls`` counts such losses.
    """

    def __init__(self, rate: float, now: float, max_lag: float = 0.5) -> None:
        self._rate = rate
        self._zero = now
        self._max_lag = max_lag
        self.stalls = 0

    def is_due(self, moment: float, now: float) -> bool:
        """Whether the moment has come."""
        late = now - self._zero - moment / self._rate
        if late > self._max_lag:
            self._zero += late
            self.stalls += 1
        return late >= 0.0
