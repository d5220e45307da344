# SPDX-License-Identifier: Apache-2.0
"""Back end of RLML: keyframes and reflectors in one graph, loop closures, the map (eq. 12-14)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rlml_slam import se2
from rlml_slam.errors import MapError
from rlml_slam.estimation.correction import ReferencePose
from rlml_slam.graph import Graph, Loss, Losses, LossKind, OnlineSolver, relative_information
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.survey import Survey, same
from rlml_slam.params import Parameters
from rlml_slam.se2 import Array
from rlml_slam.slam.back_end.keyframe_selection import (
    draw,
    is_keyframe,
    keyframe_of,
    odometry_edge,
)
from rlml_slam.slam.back_end.maintenance import GraphMaintenance
from rlml_slam.slam.back_end.path_covariance import PathCovariance, newest_covariance
from rlml_slam.slam.back_end.scan_graph import ScanGraph
from rlml_slam.slam.back_end.sparsification import Sparsifier
from rlml_slam.slam.back_end.trajectory import FrameTrajectory
from rlml_slam.slam.closures.constellation_closure import ConstellationSearch
from rlml_slam.slam.closures.loop_closer import LoopCloser
from rlml_slam.slam.closures.loop_closure import Closure
from rlml_slam.slam.keyframes import FoundPose, Interval, Keyframe
from rlml_slam.slam.landmarks.delayed_association import DelayedAssociation
from rlml_slam.slam.landmarks.landmark_persistence import LandmarkPersistence
from rlml_slam.slam.landmarks.reflector_graph import ReflectorGraph
from rlml_slam.slam.landmarks.reflector_states import ReflectorState, reflector_states
from rlml_slam.slam.landmarks.survey_frame import SurveyFrame
from rlml_slam.types import Belief, EdgeKind, Frame, Reflectors


@dataclass(frozen=True)
class Update:
    """Result of one keyframe; ``T_map_local`` (3,) corrects the front end where ``optimized``.

    ``known`` is the covariance of the keyframe's pose, None before the first solve. ``closures``
    were accepted or rejected with this keyframe; ``changed`` are earlier ones that were disabled
    or enabled with it, ``removed`` the keys of reflectors removed from the map. ``cpu_ms`` is the
    processor time of the thread.
    """

    keyframe: int
    T_map_local: Array
    optimized: bool
    closures: tuple[Closure, ...]
    wall_ms: float
    known: ReferencePose | None = None
    changed: tuple[Closure, ...] = ()
    removed: tuple[int, ...] = ()
    cpu_ms: float = 0.0


class BackEnd:
    """Graph of keyframes and reflectors; ``add`` each frame, read the map at any time.

    With a ``survey``, the map moves to its frame as soon as the reflectors match it.
    """

    def __init__(self, params: Parameters, survey: Survey | None = None) -> None:
        self._p = params
        self._survey = survey
        self.reset()

    def reset(self) -> None:
        """Start with an empty map."""
        p = self._p
        # frames come with final associations (a second pass): none is delayed, merged or closed
        self.associations_are_final = False
        self.graph = Graph(_losses(p))
        self.solver = OnlineSolver(self.graph, p.solver)
        self.keyframes: list[Keyframe] = []
        self.scan_graph = ScanGraph(p, self.graph)
        self.reflector_graph = ReflectorGraph(p.reflector, self.solver)
        self.loop_closer = LoopCloser(p, self.solver)
        self.constellation_search = ConstellationSearch(p, self.graph, self.reflector_graph)
        self.delayed_association = DelayedAssociation(p.reflector, self.reflector_graph)
        self.sparsifier = Sparsifier(
            p, self.solver, self.scan_graph, self.loop_closer, self.reflector_graph
        )
        self.frame_trajectory = FrameTrajectory(p.back_end.max_trajectory_frames)
        self.persistence = LandmarkPersistence(p, self.graph, self.reflector_graph)
        self.path_covariance = PathCovariance()
        self.survey_frame = None if self._survey is None else self._frame_of(self._survey)
        self.T_map_local = np.zeros(3)
        self.known: ReferencePose | None = None
        self.interval: Interval | None = None
        self._keyframes_since_solve = 0
        self._optimized = False  # as below: of the newest keyframe, for its update
        self._changed: tuple[Closure, ...] = ()
        self._removed: tuple[int, ...] = ()
        self.maintenance = GraphMaintenance(
            self.sparsifier, self.frame_trajectory, self.path_covariance
        )

    def _frame_of(self, survey: Survey) -> SurveyFrame:
        return SurveyFrame(self._p, self.solver, self.reflector_graph, survey)

    def use_survey_of_map(self, survey: Survey) -> None:
        """Use the survey whose frame a saved map has; MapError if another one was given."""
        if self._survey is not None and not same(survey, self._survey):
            raise MapError('the map has the frame of another survey')
        self.survey_frame = self._frame_of(survey)
        self.survey_frame.found = True

    def add(self, frame: Frame, found: FoundPose | None = None) -> Update | None:
        """Add a frame, and where a search has found the robot; an Update if it is a keyframe."""
        start = time.perf_counter(), time.thread_time()
        if self.interval is not None:
            self.interval.add_motion(frame)
            if frame.jumped:
                self.interval.jump(frame)
        self.loop_closer.follow(frame, found)
        update, last = None, self.keyframes[-1] if self.keyframes else None
        if self.loop_closer.is_due or is_keyframe(last, frame, self._p.back_end):
            update = self._add_keyframe(frame, start)
        assert self.interval is not None
        if not frame.unconfirmed:
            self.interval.add_detections(frame)
        T_key_base = se2.between(self.keyframes[-1].T_local, frame.T_local_base)
        self.frame_trajectory.add(frame.stamp, T_key_base)
        return update

    def _add_keyframe(self, frame: Frame, start: tuple[float, float]) -> Update:
        self._optimized, self._changed, self._removed = False, (), ()
        key = self._add_pose(frame)
        at_once = self.loop_closer.is_due
        closures = self._close_loops(key)
        self._join_reflectors()
        self._keyframes_since_solve += 1
        is_due = self._keyframes_since_solve >= self._p.back_end.optimize_every
        if frame.jumped or ((is_due or at_once) and self._has_changed):
            self.optimize()
            self.maintenance.after_solve(self.keyframes)
        elif not closures:
            self.maintenance.run_step(self.keyframes)
        return Update(
            key.index, self.T_map_local, self._optimized, closures,
            (time.perf_counter() - start[0]) * 1e3, self.known, self._changed, self._removed,
            (time.thread_time() - start[1]) * 1e3,
        )  # fmt: skip

    def _add_pose(self, frame: Frame) -> Keyframe:
        """New pose, with an odometry edge from the last one (e^P of eq. 12)."""
        interval = self.interval
        if interval is None:  # the first keyframe is the gauge
            index = self.graph.add_pose(frame.T_local_base, fixed=True)
        else:
            self._add_sightings(interval)
            last = self.keyframes[-1]
            self.scan_graph.follow(last, frame)
            motion = se2.between(last.T_local, frame.T_local_base)
            self.frame_trajectory.begin_keyframe(motion)
            index = self.graph.add_pose(se2.compose(self.graph.poses[last.index], motion))
            delta, cov = odometry_edge(last, frame, interval, self._p.back_end)
            information = relative_information(delta, cov)
            self.graph.add_edge(EdgeKind.ODOMETRY, index - 1, index, delta, information)
            self.delayed_association.move(delta, cov)
        key = keyframe_of(index, frame, self.keyframes[-1] if self.keyframes else None)
        self.keyframes.append(key)
        if frame.jumped:
            self.path_covariance.start(key)
        self.interval = Interval(frame.T_local_base)
        return key

    def _add_sightings(self, interval: Interval) -> None:
        """Reflectors seen near the newest keyframe: sightings, association, persistence."""
        pose = len(self.keyframes) - 1
        if not self.associations_are_final and self.delayed_association.begins(interval):
            if self._has_changed:
                self.optimize()
            self.delayed_association.begin(pose)
        self.delayed_association.add(interval)
        self.reflector_graph.add(pose, interval)
        if self.delayed_association.decide():
            self.optimize_after_join()
        self._removed += self.persistence.update(self.keyframes, interval)
        if self._removed and self.survey_frame is not None:
            self.survey_frame.update_gauge()
        oldest = interval.last_stamp - int(2e9 * self._p.reflector.candidate_timeout)
        self.reflector_graph.drop_candidates(oldest, self.delayed_association.pending)

    def _close_loops(self, key: Keyframe) -> tuple[Closure, ...]:
        """Closures by reflectors at the keyframe before, and by the scan of the new one."""
        closures: tuple[Closure, ...] = ()
        if not self.associations_are_final:
            proposed = self.constellation_search.search(self.keyframes[:-1])
            if proposed is not None:
                points = self.scan_graph.thinned(proposed.key)
                closures += self.loop_closer.confirm(proposed, points, self.scan_graph.finished)
        points = self.scan_graph.add(key)
        if points is not None:
            closures += self.loop_closer.search(key, points, self.scan_graph.finished)
        return closures

    def _join_reflectors(self) -> None:
        """Join the reflectors that new closures have identified."""
        if self.reflector_graph.join_mapped(self.loop_closer.take_reflector_pairs()):
            self.delayed_association.drop()
            self.optimize_after_join()

    def revoke(self, number: int) -> Closure:
        """Remove a loop closure for good; raises SolverError if there is none of this number."""
        closure = self.loop_closer.revoke(number)
        self.path_covariance.remove_closures()
        self.optimize()
        return closure

    @property
    def _has_changed(self) -> bool:  # since the last solve
        return self.loop_closer.changed or self.reflector_graph.changed

    def optimize(self, final: bool = False) -> None:
        """Solve eq. 13, merge reflectors, align with the survey, check closures, correct.

        Solved is what came since the last time, or, at the end, all by the batch solver.
        """
        if len(self.keyframes) < 2:
            return
        solve = self.solver.solve_all if final else self.solver.solve
        solve()
        for has_changed in (self._merge_reflectors, self._align_with_survey):
            if has_changed():
                solve()
        if self.loop_closer.needs_selection(final):
            self._select_closures()
        self.solver.solve()  # the incremental factorization, unless it is there already
        self._correct_local_frame()

    def _select_closures(self) -> None:
        """Disable the closures that contradict the others; a selection moves the estimate."""
        enabled = self.loop_closer.select()
        self.solver.solve_all()
        if changed := self.loop_closer.update_states(enabled):
            self._changed += changed
            self.path_covariance.remove_closures()

    def optimize_after_join(self) -> None:
        """Optimize after reflectors were joined that are as far apart as the drift.

        To a robust loss such a join looks like an outlier: the first solve is quadratic.
        """
        robust = self.graph.losses
        self.graph.losses = replace(robust, odometry=Loss(), reflector=Loss())
        self.solver.solve_all()
        self.graph.losses = robust
        self.optimize()

    def _merge_reflectors(self) -> bool:
        merge, pending = self.reflector_graph.merge, self.delayed_association.pending
        return not self.associations_are_final and merge(pending)

    def _align_with_survey(self) -> bool:
        """Whether the survey changed the graph; pending hypotheses keep the current frame."""
        frame, undecided = self.survey_frame, self.delayed_association.pending
        return frame is not None and not undecided and frame.update()

    def _correct_local_frame(self) -> None:
        """Set ``T_map_local`` and its covariance from the newest keyframe."""
        self._optimized, self._keyframes_since_solve = True, 0
        self.loop_closer.mark_solved()
        self.reflector_graph.mark_solved()
        last = self.keyframes[-1]
        self.T_map_local = T = se2.compose(self.graph.poses[last.index], se2.inverse(last.T_local))
        survey, records = self.survey_frame, self.loop_closer.records
        bound = None if survey is not None and survey.found else self.path_covariance
        self.known = newest_covariance(self.solver, bound, records, self.keyframes, T)

    def finish(self) -> None:
        """Add what came since the last keyframe, decide what is pending, optimize."""
        if self.interval is not None:
            self._add_sightings(self.interval)
            self.interval = Interval(self.keyframes[-1].T_local)
            if self.delayed_association.decide(final=True):
                self.optimize_after_join()
            self.optimize(final=True)
            if self.loop_closer.decide_pending():
                self._join_reflectors()
                self.optimize(final=True)

    def belief(self) -> Belief | None:
        """Newest keyframe and all reflectors, with joint covariance; None without reflectors."""
        if not self.keyframes or not self.reflector_graph.found:
            return None
        return self.reflector_graph.belief(self.keyframes[-1].index)

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3) in the map frame of every frame so far."""
        if not self.keyframes:
            return self.frame_trajectory.stamps(), np.zeros((0, 3))
        return self.frame_trajectory.stamps(), self.frame_trajectory.poses(self.graph.poses)

    def reflectors(self) -> Reflectors:
        """The reflector map with marginal covariances, map frame."""
        return self.reflector_graph.reflectors()

    def reflector_states(self) -> list[ReflectorState]:
        """State of each reflector, removed ones and ghosts included."""
        return reflector_states(self.reflector_graph, self._p.reflector)

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The occupancy grid from the keyframes' scans, None without any scan."""
        return draw(self.graph.poses, self.keyframes, self._p.back_end.resolution)


def _losses(p: Parameters) -> Losses:
    """Robust losses; the front end's own motion, without wheels that may slip, has none.

    The pull of odometry does not fade with its error: else one wrong closure could take a keyframe
    anywhere.
    """
    odometry = Loss(LossKind.HUBER, p.back_end.odometry_robust_scale)
    return Losses(
        odometry=odometry if p.node.use_odom else Loss(),
        closure=Loss(LossKind.HUBER, p.back_end.closure_robust_scale),
        scan=Loss(LossKind.CAUCHY, p.back_end.scan_robust_scale),
        reflector=Loss(LossKind.CAUCHY, p.reflector.robust_scale),
    )
