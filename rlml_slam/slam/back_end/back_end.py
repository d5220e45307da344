# SPDX-License-Identifier: Apache-2.0
"""The RLML back end: keyframes and reflectors in one graph, loop closures, the map (eq. 12-14)."""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.estimation.correction import Correction, ReferencePose, either, turned
from rlml_slam.graph.batch.marginals import Marginals
from rlml_slam.graph.incremental.online_solver import OnlineSolver
from rlml_slam.graph.model.factors import relative_information
from rlml_slam.graph.model.graph import Graph
from rlml_slam.graph.model.robust_loss import Loss, Losses, LossKind
from rlml_slam.maps.occupancy import OccupancyGrid, render
from rlml_slam.maps.survey import Survey, same
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.path_covariance import PathCovariance, held
from rlml_slam.slam.back_end.scan_graph import ScanGraph
from rlml_slam.slam.back_end.sparsification import Sparsifier
from rlml_slam.slam.back_end.trajectory import Path
from rlml_slam.slam.closures.closure_monitor import ClosureMonitor
from rlml_slam.slam.closures.constellation_closure import Constellations
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import Interval, Keyframe
from rlml_slam.slam.landmarks.delayed_association import DelayedAssociation
from rlml_slam.slam.landmarks.landmark_persistence import LandmarkPersistence
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.slam.landmarks.reflector_states import ReflectorState, reflector_states
from rlml_slam.slam.landmarks.survey_frame import SurveyFrame
from rlml_slam.types import Belief, EdgeKind, Frame, Reflectors


@dataclass(frozen=True)
class Update:
    """What one keyframe did; ``T_map_local`` (3,) corrects the front end where ``optimized``.

    ``known``: how well the keyframe's pose is known with it, None where no one asked the graph.
    ``closures`` were tried with it; ``changed`` are those, of any time, that it had disabled or
    enabled again. ``gone`` are all keys of reflectors that are no longer there. ``cpu_ms`` is the
    time that the thread computed, without what it waited for others.
    """

    keyframe: int
    T_map_local: Array
    optimized: bool
    closures: tuple[Closure, ...]
    wall_ms: float
    known: ReferencePose | None = None
    changed: tuple[Closure, ...] = ()
    gone: tuple[int, ...] = ()
    cpu_ms: float = 0.0


class BackEnd:
    """The graph over all keyframes; ``add`` each frame, read the map at any time.

    With a ``survey``, its frame becomes that of the map as soon as the reflectors tell it.
    """

    def __init__(self, params: Parameters, survey: Survey | None = None) -> None:
        self._p = params
        self._survey = survey
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        p = self._p
        self.is_told = False  # which detection is of which reflector: not to be asked again
        # wheels slip; the front end's own motion, without any, does not
        slips = Loss(LossKind.CAUCHY, p.back_end.odometry_robust_scale)
        self.graph = Graph(
            Losses(
                odometry=slips if p.node.use_odom else Loss(),
                closure=Loss(LossKind.HUBER, p.back_end.closure_robust_scale),
                scan=Loss(LossKind.CAUCHY, p.back_end.scan_robust_scale),
                reflector=Loss(LossKind.CAUCHY, p.reflector.robust_scale),
            )
        )
        self.live = OnlineSolver(self.graph, p.solver)
        self.keyframes: list[Keyframe] = []
        self.scans = ScanGraph(p, self.live)
        self.reflector_graph = ReflectorGraph(p.reflector, self.live)
        self.constellations = Constellations(p, self.graph, self.reflector_graph)
        self.delayed_association = DelayedAssociation(p.reflector, self.reflector_graph)
        self.sparsifier = Sparsifier(p, self.live, self.scans, self.reflector_graph)
        self.path = Path(p.back_end.max_trajectory_frames)
        self.persistence = LandmarkPersistence(p, self.graph, self.reflector_graph)
        self._gone: tuple[int, ...] = ()  # since the newest keyframe began
        self.closure_monitor = ClosureMonitor(p, self.live)
        self.path_covariance = PathCovariance()
        self.survey_frame = self._plant_frame(self._survey)
        self._changed: tuple[Closure, ...] = ()  # since the newest keyframe began
        self.T_map_local = np.zeros(3)
        self.known: ReferencePose | None = None
        self._optimized = False
        self._interval: Interval | None = None
        self._since_optimized = 0
        # what keeps the graph small takes as long as a solve or a closure: each is put off until
        # a keyframe that had neither, or until the next solve
        self._chores: deque[Callable[[], None]] = deque()

    def _plant_frame(self, survey: Survey | None) -> SurveyFrame | None:
        if survey is None:
            return None
        return SurveyFrame(self._p, self.live, self.reflector_graph, survey)

    def add(self, frame: Frame) -> Update | None:
        """Take one frame of the front end; an Update where it became a keyframe."""
        began = time.perf_counter(), time.thread_time()
        if self._interval is not None:
            self._interval.add_motion(frame)
            if frame.jumped:
                self._interval.jump(frame)
                self.scans.begin_piece()
        update = None
        if self._is_key(frame):
            update = self._add_keyframe(frame, began)
        assert self._interval is not None
        if not frame.unconfirmed:
            self._interval.add_detections(frame)
        newest = self.keyframes[-1]
        self.path.add(frame.stamp, se2.between(newest.T_local, frame.T_local_base))
        return update

    def _is_key(self, frame: Frame) -> bool:
        if not self.keyframes:
            return True
        if frame.unconfirmed or frame.jumped:
            return frame.jumped  # of a robot that does not know where it is, nothing is mapped
        p, last = self._p.back_end, self.keyframes[-1]
        step = se2.between(last.T_local, frame.T_local_base)
        distance, turn = math.hypot(step[0], step[1]), abs(step[2])
        if distance >= p.minimum_travel_distance or turn >= p.minimum_travel_heading:
            return True
        moved = distance > 0.02 or turn > 0.02
        return moved and (frame.stamp - last.stamp) * 1e-9 >= p.minimum_time

    def _add_keyframe(self, frame: Frame, began: tuple[float, float]) -> Update:
        self._optimized, self._changed, self._gone = False, (), ()
        key = self._node(frame)
        closures = () if self.is_told else self._return()
        if key.points is not None:
            closures += self.scans.add(key)
        self._join(self.scans.take_pairs())
        self._since_optimized += 1
        due = self._since_optimized >= self._p.back_end.optimize_every
        if due and self._is_behind:
            self.optimize()
            self.sparsifier.thin()
            while self._chores:
                self._chores.popleft()()
            self._chores.extend((self._sparsify, self._prune))
        elif self._chores and not closures:
            self._chores.popleft()()
        return Update(
            key.index,
            self.T_map_local,
            self._optimized,
            closures,
            (time.perf_counter() - began[0]) * 1e3,
            self.known,
            self._changed,
            self._gone,
            (time.thread_time() - began[1]) * 1e3,
        )

    def _sparsify(self) -> None:
        if self.sparsifier.sparsify(self.keyframes, self.path):
            self.path_covariance.keep(self.keyframes)

    def _prune(self) -> None:
        self.sparsifier.prune(len(self.keyframes))

    def _node(self, frame: Frame) -> Keyframe:
        """A new pose, tied to the last one by the relative motion (e^P of eq. 12)."""
        o, interval = frame.observation, self._interval
        if interval is None:
            # the first keyframe is the gauge
            index = self.graph.add_pose(frame.T_local_base, fixed=True)
        else:
            self._see_reflectors(interval)
            since, scanned = interval.motion, interval.scanned
            last = self.keyframes[-1]
            # with scans the front end's motion is the better mean; without, it holds the
            # reflectors already, which have their own factors; but where odometry knows nothing,
            # its covariance is so wide that this counts for little and the mean for much
            ours = scanned or not since.known
            motion = se2.between(last.T_local, frame.T_local_base)
            delta = motion if ours else since.delta
            self.path.begin_keyframe(motion)
            index = self.graph.add_pose(se2.compose(self.graph.poses[last.index], motion))
            cov = since.cov + np.diag(np.array(self._p.back_end.edge_variance_floor))
            if self._p.back_end.edge_covariance == 'sum':
                # eq. 14 to the letter, in the axes of the frame it is used in
                R = np.eye(3)
                R[:2, :2] = se2.rotation(last.T_local[2]).T
                cov = R @ (last.cov_local + frame.cov_local) @ R.T + 1e-9 * np.eye(3)
            self.graph.add_edge(
                EdgeKind.ODOMETRY, index - 1, index, delta, relative_information(delta, cov)
            )
            self.delayed_association.move(delta, cov)
        # a scan that the front end could not place has no place in the map either
        placed = frame.scan_used or not self.keyframes
        points = o.points.astype(np.float32) if placed and o.points is not None else None
        key = Keyframe(
            index, frame.stamp, frame.T_local_base, frame.cov_local,
            points, o.origin if placed else None, frame.stamp, jumped=frame.jumped,
        )  # fmt: skip
        self.keyframes.append(key)
        if frame.jumped:
            self.path_covariance.begin(key)
        self._interval = Interval(frame.T_local_base)
        return key

    def _return(self) -> tuple[Closure, ...]:
        """Loops closed by reflectors at the keyframe before the newest, which saw none yet."""
        place = self.constellations.look(self.keyframes[:-1])
        return () if place is None else self.scans.enter(place)

    def _join(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Reflectors that a closure tells to be the same are one from then on."""
        alive = {m.key for m in self.reflector_graph.alive()}
        resolve = self.reflector_graph.resolve
        here = [(a, b) for a, b in pairs if {resolve(a), resolve(b)} <= alive]
        for old, new in here:
            self.reflector_graph.join(old, new)
        if here:
            self.delayed_association.drop()
            self.rejoin()

    @property
    def _is_behind(self) -> bool:
        """Whether the graph has gained anything that the estimate does not show."""
        return self.scans.changed or self.reflector_graph.changed

    def _see_reflectors(self, interval: Interval) -> None:
        """The reflectors seen near the newest keyframe, and what they tell of earlier ones."""
        pose = len(self.keyframes) - 1
        if not self.is_told and self.delayed_association.begins(interval):
            if self._is_behind:
                self.optimize()
            self.delayed_association.begin(pose)
        self.delayed_association.see(interval)
        self.reflector_graph.add(pose, interval)
        if self.delayed_association.decide():
            self.rejoin()
        self._gone += self.persistence.look(self.keyframes, interval)
        if self._gone and self.survey_frame is not None:
            self.survey_frame.hold()
        forgotten = interval.last_look - int(2e9 * self._p.reflector.candidate_timeout)
        self.reflector_graph.drop_candidates(forgotten, self.delayed_association.pending)

    def rejoin(self) -> None:
        """Solve after reflectors were joined that stood apart, as far as the drift had gone.

        To the robust losses such a joint looks like an outlier: they come second.
        """
        robust = self.graph.losses
        self.graph.losses = replace(robust, odometry=Loss(), reflector=Loss())
        self.live.solve_all()
        self.graph.losses = robust
        self.optimize()

    def optimize(self, final: bool = False) -> None:
        """Solve eq. 13, merge reflectors that turned out to be one, correct the local frame.

        Closures that turn out wrong are disabled; with ``final`` no doubt about them is put off.
        """
        if len(self.keyframes) < 2:
            return
        solve = self.live.solve_all if final else self.live.solve
        solve()
        if not self.is_told and self.reflector_graph.merge(self.delayed_association.pending):
            solve()
        # open hypotheses are about places in the frame of now
        if (
            self.survey_frame is not None
            and not self.delayed_association.pending
            and self.survey_frame.update()
        ):
            solve()
        changed = self.closure_monitor.review(self.scans.closures, final)
        if changed:
            self._changed += changed
            self.path_covariance.forget()
        self.live.solve()
        self._optimized = True
        self._since_optimized = 0
        self.scans.solved()
        self.reflector_graph.changed = False
        last = self.keyframes[-1]
        self.T_map_local = se2.compose(self.graph.poses[last.index], se2.inverse(last.T_local))
        self.known = self._known()

    def _known(self) -> ReferencePose:
        """How well the newest keyframe is known in the map.

        Nothing that was seen near it is in the graph yet: that is of the keyframe before, from
        which the front end's covariance has grown. What the graph and any way that leads there
        have both seen neither judges better; of the survey the graph alone knows, and of loops
        where reflectors hold the pose.
        """
        before, last = self.keyframes[-2:]
        cov = self.live.joint([before.index])
        if self.survey_frame is None or not self.survey_frame.found:
            self.path_covariance.close(self.scans.closures, self.keyframes, self.graph.edges)
            if not self._is_held(before):
                heading = float(self.T_map_local[2] + before.T_local[2])
                cov = either(cov, turned(self.path_covariance.cov(before), heading))
        since = Correction(self.T_map_local, ReferencePose(before.T_local, before.cov_local, cov))
        _, cov_map = since.apply(last.T_local, last.cov_local)
        return ReferencePose(last.T_local, last.cov_local, cov_map)

    def _is_held(self, key: Keyframe) -> bool:
        """Whether reflectors that were in the map when it was last tied together hold a pose."""
        enabled = self.graph.edges.enabled
        if not enabled[self.scans.closures.edges].any():
            return False
        newest = self.path_covariance.newest
        until = bisect_right(self.keyframes, newest, key=lambda k: k.stamp) - 1
        return held(self.graph.sightings, key.index, until)

    def revoke(self, number: int) -> Closure:
        """Take a loop closure out of the map for good; SolverError if there is no such one."""
        closure = self.closure_monitor.revoke(self.scans.closures, number)
        self.path_covariance.forget()
        self.optimize()
        return closure

    def belief(self) -> Belief | None:
        """The newest keyframe and the reflectors, with joint covariance; None without any."""
        if not self.keyframes or not self.reflector_graph.found:
            return None
        return self.reflector_graph.belief(self.keyframes[-1].index)

    def finish(self) -> None:
        """Use what is still collected, look for the last closures and optimise."""
        if self._interval is not None and self.keyframes:
            self._see_reflectors(self._interval)
            self._interval = Interval(self.keyframes[-1].T_local)
            self.scans.finish()
            if self.delayed_association.decide(final=True):
                self.rejoin()
            self.optimize(final=True)

    def start_from(
        self,
        keys: list[Keyframe],
        arrays: Mapping[str, NDArray[Any]],
        survey: Survey | None = None,
    ) -> None:
        """Go on with a map whose graph is there already; the local frame is the map's from now on.

        The next frame has to be one that ``jumped``: no motion leads to it. A ``survey`` is that
        whose frame the map has. Raises MapError if that is another one than was given to be used.
        """
        if survey is not None:
            if self._survey is not None and not same(survey, self._survey):
                raise MapError('the map has the frame of another survey')
            self.survey_frame = self._plant_frame(survey)
            assert self.survey_frame is not None
            self.survey_frame.found = True
        last = keys[-1]
        for key in keys:
            if key.jumped:
                self.path_covariance.begin(key)
        T_map = self.graph.poses[last.index].copy()
        last.cov_local = turned(last.cov_local, float(T_map[2] - last.T_local[2]))
        last.T_local = T_map
        self.keyframes = keys
        self.scans.restore(arrays, keys)
        self.reflector_graph.restore(arrays)
        self.path.restore(arrays)
        self._interval = Interval(last.T_local)

    # --- products ------------------------------------------------------------------------------

    def trajectory(self) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Array]:
        """Stamps (n,) and poses (n, 3) in the map frame of every frame so far."""
        poses = self.graph.poses
        return self.path.stamps(), self.path.poses(poses) if self.keyframes else np.zeros((0, 3))

    def marginals(self) -> Marginals:
        """Covariances at the current estimate."""
        return Marginals(self.graph)

    def reflectors(self) -> Reflectors:
        """The reflector map with marginal covariances, map frame."""
        return self.reflector_graph.reflectors()

    def reflector_states(self) -> list[ReflectorState]:
        """What has become of each reflector, those that are gone and ghosts among them."""
        return reflector_states(self.reflector_graph, self._p.reflector)

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The map rendered from the keyframes' scans, None without any scan."""
        keys = [k for k in self.keyframes if k.points is not None and len(k.points)]
        if not keys:
            return None
        return render(
            self.graph.poses[[k.index for k in keys]],
            [k.points for k in keys if k.points is not None],
            [k.origin for k in keys if k.origin is not None],
            self._p.back_end.resolution,
        )
