# SPDX-License-Identifier: Apache-2.0
"""Counts of accepted and rejected inputs, by stream, for reports and /diagnostics."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field


@dataclass
class InputCounts:
    """Inputs by stream: used, late, duplicate, future, invalid, waited_out.

    Of the used ones, ``no_returns`` are scans without a valid beam, ``robot_parts`` those of
    which beams were left out that see the robot itself, and ``sweep_time`` those of which the time
    per ray cannot be. Not used are ``repeated`` ones, old scans of a robot that has moved since,
    those ``in_gap``, after a gap and before odometry, and turn rates where the gyro
    ``contradicts`` odometry. ``new_errors`` are those with their stream that the log has not yet.
    """

    counts: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    last_error: str = ''
    first_errors: dict[str, str] = field(default_factory=dict)
    new_errors: deque[tuple[str, str]] = field(default_factory=lambda: deque(maxlen=100))

    def count(self, stream: str, what: str, error: str = '') -> None:
        """Count one input of ``stream``; ``error`` is the message for the log."""
        self.counts[stream][what] += 1
        if error:
            self.last_error = error
            self.first_errors.setdefault(stream, error)
            self.new_errors.append((stream, error))

    def totals(self) -> dict[str, dict[str, int]]:
        """Plain dictionaries, sorted, for reports."""
        return {k: dict(sorted(v.items())) for k, v in sorted(self.counts.items())}
