# SPDX-License-Identifier: Apache-2.0
"""Where to add reflectors: greedy choice among mounts, exchanges, and fewest by exact covering."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from rlml_slam.errors import MapError
from rlml_slam.params import Parameters, SimulatorParameters
from rlml_slam.planning.bound import position_sigma, reflector_information
from rlml_slam.planning.coverage import Choice, Coverage, start
from rlml_slam.planning.driving import predicted
from rlml_slam.planning.exact_cover import fewest
from rlml_slam.planning.mounts import thin
from rlml_slam.planning.plan import Goal, Plan, headings, make_plan, scans_at, spread, within
from rlml_slam.planning.site import Site, cylinders
from rlml_slam.planning.visibility import in_sight
from rlml_slam.se2 import Array

MOST_ROWS = 1500  # places at which mounts are compared
MOST_VALUES = 1_000_000  # places times reflectors
LOST_VALUES = 50_000
LEAST_LOST, MOST_LOST = 150, 500  # places at which uniqueness is compared
TRIED, FEW = 3, 40  # best mounts that an exchange evaluates; all of a few
ROUNDS, STARTS = 3, 6
GAIN = 1e-9
NOWHERE = np.zeros((0, 2))
MOST_MORE, ATTEMPTS = 40, 5  # places that count too after each attempt; attempts
TIME = 15.0  # [s] of the processor for attempts with one less


@dataclass(frozen=True)
class Wanted:
    """How many to add, or the fewest that reach the goal: None. What counts."""

    number: int | None
    goal: Goal
    is_accurate: bool = True
    is_unique: bool = True


@dataclass(frozen=True)
class Step:
    """What is reached with the mounts until one (2,), NaN for none: shares and largest sigma."""

    mount: Array
    goal_share: float
    sigma: float
    unique_share: float | None


@dataclass(frozen=True)
class Suggestion:
    """``mounts`` (k, 2) in order of what they bring, and the ``steps``, the first without any.

    ``at_least``: no choice of fewer mounts reaches the goal, where that was shown.
    ``is_fewest``: they were asked for. ``is_complete``: nothing lacks at the places compared.
    """

    mounts: Array
    steps: tuple[Step, ...]
    at_least: int | None
    is_complete: bool
    is_fewest: bool


def suggested(
    site: Site, mounts: Array, places: Array, p: Parameters, sensor: SimulatorParameters,
    wanted: Wanted,
) -> tuple[Suggestion, Plan]:  # fmt: skip
    """Where to add reflectors, and the plan with them at all places (n, 2).

    Mounts are compared at some places. Where the fewest miss the goal at others, these count too,
    with the posts that may hide reflectors from them; in the end, more are added.
    """
    also, posts = NOWHERE, NOWHERE
    found = suggest(coverage(site, mounts, places, p, sensor, wanted, also), wanted)
    at_least = found.at_least  # without posts that hide others: no more than are needed
    for attempt in range(ATTEMPTS + 1):
        plan = make_plan(site.with_posts(found.mounts), places, p, sensor, wanted.goal)
        lacks = _lacking(plan, wanted)
        if attempt == ATTEMPTS or wanted.number is not None or not len(lacks):
            break
        also = np.concatenate([also, lacks[spread(len(lacks), MOST_MORE)]])
        posts = np.concatenate([posts, found.mounts])
        if attempt < ATTEMPTS - 2:
            of = coverage(site, mounts, places, p, sensor, wanted, also, posts)
            found = suggest(of, wanted)
            continue
        left = thin(mounts, 0.0, plan.site.reflectors.points)
        if not len(left):
            break
        more = suggest(coverage(plan.site, left, places, p, sensor, wanted, also), wanted)
        found = replace(found, mounts=np.concatenate([found.mounts, more.mounts]),
                        steps=found.steps + more.steps[1:],
                        is_complete=more.is_complete)  # fmt: skip
    return replace(found, at_least=at_least if found.is_complete else None), plan


def _lacking(plan: Plan, wanted: Wanted) -> Array:
    """Places (k, 2) that miss what is wanted."""
    short = plan.places[~plan.is_reached] if wanted.is_accurate else plan.places[:0]
    if not wanted.is_unique:
        return short
    return np.concatenate([short, plan.places[plan.sampled][~plan.is_unique]])


def coverage(
    site: Site, mounts: Array, places: Array, p: Parameters, sensor: SimulatorParameters,
    wanted: Wanted, also: Array, posts: Array = NOWHERE,
) -> Coverage:  # fmt: skip
    """The coverage of some of the places (n, 2), and ``also`` (k, 2) as ``posts`` (j, 2) hide.

    Each with all headings if the laser does not see all around.
    """
    present = site.reflectors
    m, fov = len(present), sensor.laser.field_of_view
    count = m + len(mounts)
    angles = headings(fov)
    most = max(min(MOST_ROWS, MOST_VALUES // max(count, 1)) // len(angles), 1)
    places = np.concatenate([also, places[spread(len(places), most)]])
    geometry = site.walls.joined(present.geometry())
    hiding = geometry.joined(cylinders(posts, np.arange(len(posts))).geometry())
    known, seen = (
        np.concatenate([in_sight(at, r, around, p, sensor) for at, around in
                        ((places[: len(also)], hiding), (places[len(also) :], geometry))])
        for r in (present, cylinders(mounts, np.arange(len(mounts))))
    )  # fmt: skip
    useful = seen.any(axis=0)
    seen, mounts = np.concatenate([known, seen[:, useful]], axis=1), mounts[useful]
    points = np.concatenate([present.points, mounts])
    seen = np.concatenate([seen & within(places, points, a, fov) for a in angles])
    scan = np.concatenate([scans_at(site, places, a, p, sensor) for a in angles])
    places = np.tile(places, (len(angles), 1))
    cov = np.concatenate([site.cov, np.zeros((len(mounts), 2, 2))])
    information = np.zeros((*seen.shape, 6))
    rows, columns = np.nonzero(seen)
    offsets = points[columns] - places[rows]
    information[rows, columns] = reflector_information(offsets, cov[columns], p.reflector)
    lost = np.union1d(
        np.arange(len(also)),
        spread(len(places), max(LEAST_LOST, min(MOST_LOST, LOST_VALUES // count))),
    )
    lost = lost if wanted.is_unique else lost[:0]
    return Coverage(
        places, seen, points, cov, m, information, scan, wanted.goal.variance(p, sensor),
        wanted.goal, wanted.is_accurate, lost, p,
    )  # fmt: skip


def suggest(of: Coverage, wanted: Wanted) -> Suggestion:
    """The mounts to add to what is present; MapError without any mount."""
    if len(of.points) == of.num_present:
        raise MapError('there is no place to mount a reflector; see --mountable and --clearance')
    choice, at_least = start(of), None
    if wanted.number is not None:
        choice = _best_grown(choice, wanted.number)
    else:
        choice = pruned(grown(choice, len(of.points)))
        if choice.is_complete:
            choice, at_least = fewest(start(of), choice)
            if at_least < len(choice.added):
                choice = reduced(choice)
    return _described(start(of), choice, at_least, wanted.number is None)


def _best_grown(choice: Choice, number: int) -> Choice:
    """Grown and exchanged; of few mounts, the best of several that begin with another one."""
    gains = choice.gains()
    begins = np.argsort(-gains, kind='stable')[: STARTS if len(gains) <= FEW else 0]
    found = [exchanged(grown(choice, number))]
    for k in begins[1:]:
        if found[0].is_complete:
            break
        first = choice.changed(choice.of.num_present + int(k))
        found.append(exchanged(grown(first, number - 1)))
    return min(found, key=lambda c: c.loss)


def grown(choice: Choice, number: int) -> Choice:
    """At most ``number`` mounts more, each the one that lowers the loss most."""
    for _ in range(number):
        gains = choice.gains()
        if choice.is_complete or not len(gains) or gains.max() <= GAIN:
            break
        choice = choice.changed(choice.of.num_present + int(np.argmax(gains)))
    return choice


def pruned(choice: Choice) -> Choice:
    """Without those mounts that lower the loss no more."""
    for mount in choice.added:
        fewer = choice.changed(mount)
        if fewer.loss <= choice.loss + GAIN:
            choice = fewer
    return choice


def reduced(choice: Choice) -> Choice:
    """Fewer mounts that still lack nothing: one less, and the others exchanged."""
    began = time.process_time()
    for mount in choice.added:
        if time.process_time() - began > TIME:
            break
        if choice.chosen[mount]:
            fewer = exchanged(choice.changed(mount))
            choice = fewer if fewer.is_complete else choice
    return choice


def exchanged(choice: Choice) -> Choice:
    """Each mount replaced by a better one, until none is."""
    for _ in range(ROUNDS):
        before = choice.loss
        for mount in choice.added:
            if choice.is_complete:
                return choice
            fewer = choice.changed(mount)
            gains = fewer.gains()
            # gains of uniqueness are predicted; of few mounts, each is tried
            tried = TRIED if len(gains) > FEW else FEW
            for k in np.argsort(-gains, kind='stable')[:tried]:
                other = choice.of.num_present + int(k)
                hopeless = tried == TRIED and fewer.loss - gains[k] >= choice.loss - GAIN
                if hopeless or fewer.chosen[other] or other == mount:
                    continue
                swapped = fewer.changed(other)
                if swapped.loss < choice.loss - GAIN:
                    choice = swapped
                    break
        if choice.loss >= before - GAIN:
            break
    return choice


def _described(empty: Choice, choice: Choice, at_least: int | None, is_fewest: bool) -> Suggestion:
    """The mounts in the order in which each lowers the loss most, with what they bring."""
    left, now = set(choice.added), empty
    order: list[int] = []
    steps = [_step(now, np.full(2, np.nan))]
    while left:
        gains = now.gains()
        best = max(sorted(left), key=lambda k: gains[k - now.of.num_present])
        left.discard(best)
        now = now.changed(best)
        order.append(best)
        steps.append(_step(now, now.of.points[best]))
    mounts = choice.of.points[order]
    return Suggestion(mounts, tuple(steps), at_least, choice.is_complete, is_fewest)


def _step(choice: Choice, mount: Array) -> Step:
    of = choice.of
    everywhere = np.arange(len(of.places))
    members = of.members(choice.chosen, everywhere)
    total = of.information_of(everywhere, members).sum(axis=1)
    sigma = position_sigma(total + predicted(total, of.q) + of.scan)
    unique = [not len(r.lacking) for r in choice.rivals]
    reached = of.costs(everywhere, members) == 0.0
    return Step(mount, float(reached.mean()), float(sigma.max()),
                float(np.mean(unique)) if unique else None)  # fmt: skip
