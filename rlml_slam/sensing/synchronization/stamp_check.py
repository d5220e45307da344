# SPDX-License-Identifier: Apache-2.0
"""Clocks of the inputs: which stamps to believe.

A message whose stamp is far ahead of all others is held back: if it were believed, all later
messages would be late. It is rejected if the other streams go on as before, and accepted if more
messages follow it: then time really jumped ahead. Messages that are far behind are late if they
are few; if all messages in a row are behind, the newest stamp was wrong or the clock was set back.
A stamp nearer ahead is accepted at once; it was wrong if two in a row of its source are before it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import TypeAlias

from rlml_slam.errors import InputError
from rlml_slam.motion import SECOND
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.types import Detections, Imu, Odometry, Scan

Message: TypeAlias = Odometry | Imu | Scan | Detections

MAX_AHEAD = SECOND  # [ns] a stamp farther ahead of all others is suspicious; sensors lag by less
BACK = SECOND // 10  # [ns] a message farther behind its stream is not of a stream that is late
CONFIRM = 3  # messages that confirm, or refute, a suspicious stamp
RECENT = 5  # stamps of a source that are remembered
PERSISTENT = 10  # messages in a row that are behind: fewer are late, more are of a new clock
# [ns] from the first to the last of these, or it is the clock of a late burst, not that of all;
# at the pace of all stamps it arrives in BURST of the time or more
LASTING = SECOND
BURST = 0.3
PACE = 2 * SECOND  # over which the pace of the stamps is measured


class StampCheck:
    """Newest stamps of the streams; rejects invalid, duplicate, late and future messages.

    ``newest`` is the newest accepted stamp of all streams, ``first`` the first one. Sources are
    the sensors of a stream, such as several lidars.
    """

    def __init__(self, inputs: InputCounts) -> None:
        self._inputs = inputs
        self.newest = -(2**62)
        self.first: int | None = None
        self._newest_of: dict[str, int] = {}  # by stream
        # newest accepted stamps by stream and source, and the last one that was before them
        self._recent: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
        self._overtaken: dict[tuple[str, str], int] = {}
        self._step: dict[str, int] = {}  # by stream: between its last two stamps
        self._num_behind = 0  # messages in a row that are far behind
        self._seen: dict[str, int] = {}  # by stream: the newest stamp, of late messages too
        self._num_back = 0  # of these, the last ones in a row that are behind their stream
        self._back_since = 0  # stamp of the first of these
        self._back_at = 0.0  # when it arrived
        self._goes_on = False  # messages that are on time have arrived as well
        self._now: float | None = None  # when they arrived, if that is known
        self._pace, self._mark = 1.0, (0, 0.0)  # seconds of stamps in a second; since when
        self._held: list[tuple[str, Message]] = []  # messages that are far ahead
        self._held_after = self.newest  # when the last one was held
        self._num_passed = 0  # messages since the newest of these that were not

    def newest_of(self, stream: str) -> int | None:
        """Newest stamp of a stream, None before the first."""
        return self._newest_of.get(stream)

    @property
    def is_starting(self) -> bool:
        """Whether less than a second has been received."""
        return self.first is not None and self.newest - self.first < SECOND

    @property
    def has_held(self) -> bool:
        """Whether messages are held back."""
        return bool(self._held)

    def holds(self, stream: str, message: Message) -> bool:
        """Hold a message back if its stamp is too far ahead; whether it is."""
        stamp = message.stamp
        ahead, limit = stamp - self.newest, MAX_AHEAD + 3 * self._step.get(stream, 0)
        if self.first is not None and ahead > limit:
            if self.newest != self._held_after:
                # time went on as before: random stamps far ahead confirm nothing
                for other, held in self._held:
                    if abs(held.stamp - stamp) > limit:
                        self._count_future(other, held.stamp)
                self._held = [h for h in self._held if abs(h[1].stamp - stamp) <= limit]
            self._held_after = self.newest
            self._held.append((stream, message))
            self._num_passed = 0
            return True
        if self._held and stamp > self._newest_of.get(stream, stamp):
            self._num_passed += 1
        return False

    def release_held(self, least: int) -> Iterator[tuple[str, Message]]:
        """Held messages to accept now, once ``least`` of them or the other streams decide.

        If the other streams went on, those are accepted that these have caught up with, each one
        after the one before was added; the rest is rejected.
        """
        others_went_on = self._num_passed >= CONFIRM
        if not self._held or (len(self._held) < least and not others_went_on):
            return
        held, self._held, self._num_passed = self._held, [], 0
        if not others_went_on:
            self.newest = max(self.newest, held[0][1].stamp)
        for stream, message in held:
            if not others_went_on or self._is_reached(stream, message):
                yield stream, message

    def _is_reached(self, stream: str, message: Message) -> bool:
        if message.stamp - self.newest <= MAX_AHEAD:
            return True
        self._count_future(stream, message.stamp)
        return False

    def _count_future(self, stream: str, stamp: int) -> None:
        ahead = (stamp - self.newest) / SECOND
        error = f'{stream} at {stamp} ns is {ahead:.1f} s ahead of all other stamps: rejected'
        self._inputs.count(stream, 'future', error)

    def accept(self, stream: str, stamp: int, limit: int | None, source: str = '') -> bool:
        """Accept a stamp if it is after ``limit`` [ns]; else count it as late."""
        newest = self._newest_of.get(stream)
        if limit is not None and stamp <= limit:
            by = (limit - stamp) / SECOND
            digits = '.3g' if by < 1.0 else '.1f'
            why = f'is late by {by:{digits}} s' if by else 'is not after what was used before'
            self._inputs.count(stream, 'late', f'{stream} at {stamp} ns {why}')
            return False
        self._step[stream] = 0 if newest is None else max(stamp - newest, 0)
        self._newest_of[stream] = stamp if newest is None else max(newest, stamp)
        self._recent[stream, source] = sorted([*self._recent[stream, source], stamp])[-RECENT:]
        self.newest = max(self.newest, stamp)
        if self.first is None:
            self.first = stamp
        return True

    def is_duplicate(self, stream: str, stamp: int, source: str) -> bool:
        """Whether the stamp is the newest of its source already; counts it."""
        if stamp not in self._recent[stream, source][-1:]:
            return False
        self._inputs.count(stream, 'duplicate')
        return True

    def expect(self, stamps: Iterable[int], now: float) -> None:
        """Messages with these stamps [ns] arrived together, at ``now`` [s] of a steady clock.

        Without it, all that is known of a message is its stamp, as in a replay.
        """
        self._now = now
        self._goes_on = any(abs(stamp - self.newest) <= MAX_AHEAD for stamp in stamps)
        (stamp, then), newest = self._mark, self.newest
        if self.first is not None and not stamp <= newest < stamp + PACE:
            if stamp:
                self._pace = max((newest - stamp) / SECOND / max(now - then, 1e-3), 1.0)
            self._mark = newest, now

    def wrong_after(self, stream: str, stamp: int, last_used: int | None) -> int | None:
        """Time [ns] after which stamps were wrong, if too many messages are far behind; or None.

        InputError if such stamps were used already (``last_used``) and all of them went back: the
        clock was set back. A stream that goes on, but behind the others, is merely late.
        """
        behind = self.newest - stamp
        seen = max(self._newest_of.get(stream, stamp), self._seen.get(stream, stamp))
        self._seen[stream] = max(seen, stamp)
        if self.first is None or behind <= MAX_AHEAD:
            self._num_behind = self._num_back = 0
            return None
        self._num_behind += 1
        went_back = seen - stamp > BACK
        self._num_back = self._num_back + 1 if went_back else 0
        if self._num_back == 1:
            self._back_since, self._back_at = stamp, self._now or 0.0
        if self._num_behind < PERSISTENT:
            return None
        if last_used is not None and last_used - stamp > MAX_AHEAD:
            lasted = self._num_back >= PERSISTENT and stamp - self._back_since >= LASTING
            if not lasted or self._goes_on or self._is_burst():
                return None
            raise InputError(f'the clock of {stream} jumped back by {behind / SECOND:.1f} s')
        self._num_behind = 0
        return stamp + MAX_AHEAD

    def _is_burst(self) -> bool:
        """Whether what is behind arrived faster than its stamps say, compared with all others."""
        if self._now is None:
            return False
        return (self._now - self._back_at) * self._pace * SECOND < BURST * LASTING

    def early_after(self, stream: str, stamp: int, source: str) -> int | None:
        """Time [ns] after which the newest stamps of a source were wrong, or None.

        They were if the last two, one after the other, lie BACK before them, and after older ones.
        """
        key, recent = (stream, source), self._recent[stream, source]
        first = self._overtaken.pop(key, None)
        if not recent or not recent[0] < stamp < recent[-1] - BACK:
            return None
        if first is not None and recent[0] < first < stamp:
            return first
        self._overtaken[key] = stamp
        return None

    def forget_early(self, stream: str, stamp: int, source: str) -> None:
        """Drop the stamps of a source after ``stamp`` [ns], which were wrong."""
        recent = self._recent[stream, source]
        for wrong in (s for s in recent if s > stamp):
            error = f'{stream} at {wrong} ns was ahead of the next ones of its stream: dropped'
            self._inputs.count(stream, 'future', error)
        self._recent[stream, source] = [s for s in recent if s <= stamp]
        of = [s[-1] for (other, _), s in self._recent.items() if other == stream and s]
        self._newest_of[stream] = max(of)
        self._seen.pop(stream, None)
        self.newest = max(self._newest_of.values())

    def forget_after(self, stamp: int) -> None:
        """Drop the stamps after ``stamp`` [ns], which were wrong."""
        for stream in [s for s, newest in self._newest_of.items() if newest > stamp]:
            error = f'{stream} at {self._newest_of.pop(stream)} ns is far ahead of all other '
            self._inputs.count(stream, 'future', error + 'stamps: rejected')
        for key, recent in self._recent.items():
            self._recent[key] = [s for s in recent if s <= stamp]
        self._seen = {k: s for k, s in self._seen.items() if s <= stamp}
        self.newest = max(self._newest_of.values(), default=stamp)
