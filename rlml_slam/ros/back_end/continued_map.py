# SPDX-License-Identifier: Apache-2.0
"""Going on with a saved map, live: where the front end enters it, and which key is which there.

The front end numbers its reflectors from 0 in every session, and the map has keys already: those
of the session come after them. A reflector of the map that one of the session turned out to be is
known to the front end by the session's key.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rlml_slam.maps.map_container import Content
from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.relocalization.global_localization import localize_globally
from rlml_slam.slam.relocalization.scan_relocalization import Relocation, scan_fits
from rlml_slam.slam.relocalization.search_schedule import SearchSchedule
from rlml_slam.slam.store import map_file
from rlml_slam.types import Belief, Frame, Verdict

FOREIGN = -2  # keys from here down are of no reflector of the session


class Continued:
    """A saved map in a back end, which is not ``entered`` until the robot's place in it is known.

    That is a place that was found and offered, or one that a person told and where the scan fits:
    in either case the front end begins anew there. ``why`` says in words how far that has come.

    Raises MapError or FileFormatError if the map cannot be gone on with; the back end is then
    empty.
    """

    def __init__(self, params: Parameters, content: Content, back_end: BackEnd) -> None:
        self._p = params
        self._saved = map_file.saved_map(content)
        back_end.reset()
        try:
            map_file.restore(content, back_end)
        except BaseException:
            back_end.reset()
            raise
        self._first = back_end.reflector_graph.next_key
        self._pace: SearchSchedule | None = None
        self._offered = self._begun = self._jumped = False
        self.entered = False
        self.why = 'the place in the map is looked for'

    def begin_session(self) -> None:
        """The front end began anew: its poses may be in the map from now on."""
        self._begun = True

    def enter(self, frame: Frame) -> Relocation | None:
        """Look whether a frame is in the map; a place to offer where it may begin anew there."""
        if self._begun and (self._offered or self._fits(frame)):
            self.entered = True
            return None
        found = self._look(frame)
        if found is not None:
            self._offered, self._begun = True, False
        return found

    def _fits(self, frame: Frame) -> bool:
        grid, points = self._saved.grid, frame.observation.points
        if grid is None or points is None or len(points) < self._p.scan_match.min_points:
            return False
        score = float(scan_fits(grid, points, frame.T_map_base[None], self._p)[0, 0])
        return score >= self._p.loop_closure.min_score

    def _look(self, frame: Frame) -> Relocation | None:
        """Where a frame was taken, if the map tells."""
        if self._pace is None or frame.stamp < self._pace.since:
            self._pace = SearchSchedule(frame.stamp)
        if not self._pace.is_due(frame):
            return None
        found = localize_globally(
            self._saved.grid, self._saved.reflectors, frame.observation, self._p
        )
        self.why = found.why
        return found if found.verdict is Verdict.UNIQUE else None

    def to_map(self, frame: Frame) -> Frame:
        """A frame of the front end with the keys of the map; the first one jumped into it."""
        known = frame.landmarks >= 0
        jumped = frame.jumped or not self._jumped
        self._jumped = True
        landmarks = np.where(known, frame.landmarks + self._first, frame.landmarks)
        return replace(frame, landmarks=landmarks, jumped=jumped)

    def to_session(self, belief: Belief) -> Belief:
        """A belief about the map with the keys of the front end."""
        own = {key: key - self._first for key in belief.aliases if key >= self._first}
        names: dict[int, int] = {}  # of reflectors of the map that the session knows
        for key in sorted(own):
            names.setdefault(belief.aliases[key], own[key])

        def name(key: int) -> int:
            if key >= self._first:
                return key - self._first
            return names.get(key, FOREIGN - key)

        aliases = {own[key]: name(belief.aliases[key]) for key in own}
        return replace(
            belief,
            keys=np.array([name(key) for key in belief.keys.tolist()], dtype=np.int64),
            aliases={key: other for key, other in aliases.items() if key != other},
            removed=tuple(key - self._first for key in belief.removed if key >= self._first),
        )
