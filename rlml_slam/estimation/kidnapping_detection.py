# SPDX-License-Identifier: Apache-2.0
"""Kidnapping detection: scan and reflectors that contradict the map.

A scan contradicts the map if it fits far worse than scans did lately. Reflectors contradict it if
those that were matched until now are missing all at once, and others are detected instead. Either
alone has harmless causes (a crowd, a corner), so each is overruled if the other one agrees with
the map.
"""

from __future__ import annotations

from rlml_slam.params import HealthLimits

MEMORY = 0.05  # weight of the newest score in the usual one
SETTLED = 5  # scans in a submap, or scores known, before a low score counts
RECENT = 0.5  # [s] reflectors matched within this time should still be in view
LAPSE = 5.0  # [s] some scans of a laser of 1 Hz; nothing seen for longer ends a contradiction
FEW = 2  # this many reflectors may match, or not match, by chance
MIN_SHARE = 1.0 / 3.0  # of the detections that have to match; up to half of them are ghosts


class UsualScore:
    """Running mean ``mean`` of scores; ``is_settled`` once there were a few."""

    def __init__(self) -> None:
        self.mean = 0.0
        self._number = 0

    @property
    def is_settled(self) -> bool:
        """Whether a low score counts."""
        return self._number >= SETTLED

    def learn(self, score: float) -> None:
        """Add a score."""
        self._number += 1
        weight = max(MEMORY, 1.0 / self._number)
        self.mean += weight * (score - self.mean)


class KidnappingDetection:
    """Checks every frame; ``since`` is the stamp [ns] of the first contradiction, None if none."""

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self._scores = UsualScore()
        self._last_match = -(2**62)  # stamp of the last frame whose reflectors agreed
        self._replaced = False  # in the last frame, the known reflectors by others
        self._checked = 0  # stamp of the last frame that said anything
        self.since: int | None = None

    @property
    def usual(self) -> float:
        """Running mean of the scores of matched scans."""
        return self._scores.mean

    def is_misfit(self, score: float, insertions: int) -> bool:
        """Whether a scan fits a submap of so many scans far worse than usual."""
        if not self._scores.is_settled or insertions < SETTLED:
            return False
        return score < self._limits.contradiction_ratio * self.usual

    def check(
        self,
        stamp: int,
        misfit: bool,
        scan_is_complete: bool,
        detections: int,
        matched: int,
        surveyed: bool,
    ) -> bool:
        """Whether the frame contradicts the map.

        ``scan_is_complete``: the scan matches and observes every direction. ``matched`` of its
        ``detections`` match; in a ``surveyed`` map, new reflectors are not expected.
        """
        self._checked = stamp
        agree = agree_with_map(detections, matched)
        if agree:
            self._last_match = stamp
        expected = surveyed or self.since is not None or stamp - self._last_match < RECENT * 1e9
        # some of those that replaced the known ones may leave the view
        many = detections > FEW or (self._replaced and matched == 0 and detections > 0)
        self._replaced = many and not agree and expected and not scan_is_complete
        contradicted = self._replaced or (misfit and not agree)
        if not contradicted:
            self.since = None
        elif self.since is None:
            self.since = stamp
        return contradicted

    def holds(self, stamp: int) -> bool:
        """Whether the map is contradicted at a frame in which no sensor sees anything.

        It is as it was before, until nothing has been seen for LAPSE.
        """
        if stamp - self._checked > LAPSE * 1e9:
            self.since, self._replaced = None, False
        return self.since is not None

    def learn(self, score: float) -> None:
        """Add the score of a matched scan to the usual score."""
        self._scores.learn(score)

    def has_lasted(self, stamp: int, duration: float) -> bool:
        """Whether every frame that says anything has contradicted the map for this long [s]."""
        return self.since is not None and stamp - self.since >= duration * 1e9


def agree_with_map(detections: int, matched: int) -> bool:
    """Whether enough detections match the map; one or two of many may match by chance."""
    few = matched >= min(FEW, max(detections, 1)) and matched >= MIN_SHARE * detections
    return few or matched > FEW
