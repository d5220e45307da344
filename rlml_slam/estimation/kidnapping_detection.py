# SPDX-License-Identifier: Apache-2.0
"""Whether what is seen contradicts the map: a robot that was carried away, before it is known.

A scan contradicts where it fits far worse than scans did lately; reflectors do where those that
were matched until now are gone all at once and others stand in their place. Either alone has
harmless causes (a crowd, a corner), so each is overruled by the other one's consent.
"""

from __future__ import annotations

from rlml_slam.params import HealthLimits

MEMORY = 0.05  # share of the newest fit in the usual one
SETTLED = 5  # scans in a submap, or fits known, before a poor fit means anything
RECENT = 0.5  # [s] reflectors matched within this should still be there
FEW = 2  # reflectors below this may be chance
SHARE = 1.0 / 3.0  # of the detections that must match, ghosts being up to half of them


class KidnappingDetection:
    """Judges frame by frame; ``since`` is the stamp [ns] of the first contradiction, or None.

    ``usual`` is the score of scans lately.
    """

    def __init__(self, limits: HealthLimits) -> None:
        self._limits = limits
        self.usual = 0.0
        self._fits = 0
        self._matched = -(2**62)
        self.since: int | None = None

    def misfits(self, score: float, insertions: int) -> bool:
        """Whether a scan fits far worse than usual a submap of so many scans."""
        if self._fits < SETTLED or insertions < SETTLED:
            return False
        return score < self._limits.contradiction_ratio * self.usual

    def judge(
        self,
        stamp: int,
        misfit: bool,
        held: bool,
        detections: int,
        matched: int,
        surveyed: bool,
    ) -> bool:
        """Whether the frame contradicts the map.

        ``held``: its scan fits and holds every direction. Of its ``detections``, so many are
        ``matched``; with a ``surveyed`` map there is nothing new to be seen.
        """
        agree = consents(detections, matched)
        if agree:
            self._matched = stamp
        expected = surveyed or self.since is not None or stamp - self._matched < RECENT * 1e9
        replaced = detections > FEW and not agree and expected
        contradicted = (misfit and not agree) or (replaced and not held)
        if not contradicted:
            self.since = None
        elif self.since is None:
            self.since = stamp
        return contradicted

    def learn(self, score: float) -> None:
        """How well a scan fitted that was used."""
        self._fits += 1
        weight = max(MEMORY, 1.0 / self._fits)
        self.usual += weight * (score - self.usual)

    def lasts(self, stamp: int, duration: float) -> bool:
        """Whether every frame has contradicted for this long [s]."""
        return self.since is not None and stamp - self.since >= duration * 1e9


def consents(detections: int, matched: int) -> bool:
    """Whether so many matched detections agree with the map; one or two of many may be chance."""
    few = matched >= min(FEW, max(detections, 1)) and matched >= SHARE * detections
    return few or matched > FEW
