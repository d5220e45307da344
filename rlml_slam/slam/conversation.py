# SPDX-License-Identifier: Apache-2.0
"""Events and commands of front end, back end and conductor, as frozen values.

A *session* of the front end is one local frame: it ends where the front end is restarted, where a
user sets the pose and where a map is entered. Every request of the conductor to the front end has
a number, larger than all before. A frame names its session and the newest request that the front
end has carried out, so that a frame from before a request is recognised, however late it comes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.se2 import Array
from rlml_slam.slam.keyframes import FoundPose
from rlml_slam.slam.search_area import SearchArea
from rlml_slam.types import Belief, Frame, Observation

# `request` of a session that nobody asked for, of a user's pose, and after a misplaced sensor
RESTARTED, GIVEN, MISPLACED = 0, 1, 2
FIRST_REQUEST = 3
ANY = 0  # a session, in a command that is meant for whichever there is


@dataclass(frozen=True)
class SessionFrame:
    """A frame of the front end and where it stands in the conversation.

    ``request``: number of the newest request carried out, or RESTARTED, GIVEN or MISPLACED where
    the session began without one. ``mode``: number of the newest LocalizeIn carried out, 0 before
    the first.
    """

    session: int
    frame: Frame
    request: int = RESTARTED
    mode: int = 0


# --- commands for the front end -----------------------------------------------------------------


@dataclass(frozen=True)
class StartSession:
    """Begin a session at ``pose`` (3,), ``cov`` (3, 3), map frame, which holds at ``stamp`` [ns].

    It is meant for a front end in ``session``; the robot's motion since the stamp is added. With
    ANY, the pose is that of now. ``first_key``: new reflectors get keys from here on.
    """

    number: int
    session: int
    stamp: int
    pose: Array
    cov: Array
    first_key: int = 0


@dataclass(frozen=True)
class Relocate:
    """Go on in the same session from ``pose`` (3,), ``cov`` (3, 3), map frame, at ``stamp`` [ns].

    A front end that is no longer lost stays where it is.
    """

    number: int
    session: int
    stamp: int
    pose: Array
    cov: Array


@dataclass(frozen=True)
class Correct:
    """The graph's correction of a session, by its keyframe at ``stamp`` [ns].

    ``T_map_local`` (3,), None where the graph was not solved; ``cov_map`` (3, 3) is the
    covariance of that keyframe's pose in the map, None where unknown. Reflectors ``removed`` are
    to be dropped. ``belief``: keyframe and reflectors with their joint covariance.
    """

    session: int
    stamp: int
    T_map_local: Array | None
    cov_map: Array | None = None
    removed: tuple[int, ...] = ()
    belief: Belief | None = None


@dataclass(frozen=True)
class LocalizeIn:
    """Localize in a map that does not change; None: make a map."""

    number: int
    map: SavedMap | None


FrontEndCommand = StartSession | Relocate | Correct | LocalizeIn

# --- commands for who executes ------------------------------------------------------------------


@dataclass(frozen=True)
class MapFrame:
    """Add the frame to the graph; ``on_update`` is the answer where it became a keyframe.

    ``found``: where a search has found the robot since the last frame.
    """

    session: int
    frame: Frame
    found: FoundPose | None = None


@dataclass(frozen=True)
class Search:
    """Find the pose of an observation in a map; ``on_search_result`` is the answer.

    A map in the making is not ``complete``. With a ``given`` frame, its pose is tested instead.
    Scans are searched in the ``area``, None for the whole map.
    """

    number: int
    observation: Observation | None
    map: SavedMap
    complete: bool
    given: Frame | None = None
    area: SearchArea | None = None


@dataclass(frozen=True)
class DrawMap:
    """Draw the map in the making; ``on_map_drawn`` is the answer."""

    number: int


@dataclass(frozen=True)
class KeepMap:
    """Write the map in the making to a file of its own, if it is worth it: it is about to go."""

    reason: str


@dataclass(frozen=True)
class ForgetMap:
    """Empty the graph: the next frame begins another map."""


@dataclass(frozen=True)
class TakeMap:
    """Put the map that was loaded in the place of the graph."""


@dataclass(frozen=True)
class PublishMap:
    """Publish the map at once."""


@dataclass(frozen=True)
class RememberPose:
    """Write down where the robot is in the loaded map, for the next start."""

    frame: Frame


class Severity(IntEnum):
    """Of a text for the log."""

    INFO = 0
    WARNING = 1


@dataclass(frozen=True)
class Log:
    """A text for the user."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class Answer:
    """The answer to a user's request ``number``."""

    number: int
    success: bool
    text: str


Command = (
    FrontEndCommand | MapFrame | Search | DrawMap | KeepMap | ForgetMap | TakeMap | PublishMap
    | RememberPose | Log | Answer
)  # fmt: skip


def info(text: str) -> Log:
    """A text that reports success."""
    return Log(Severity.INFO, text)


def warning(text: str) -> Log:
    """A text that a user should read."""
    return Log(Severity.WARNING, text)
