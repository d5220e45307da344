# SPDX-License-Identifier: Apache-2.0
"""The services of the back end; each answers with what happened, in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.srv import AddDiagnostics
from nav_msgs.srv import GetMap, LoadMap
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Empty, SetBool, Trigger

from rlml_slam.errors import NoMapError, RlmlError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.frame_messages import FrameAssembler
from rlml_slam.ros.codecs.message_types import make_rclpy
from rlml_slam.slam.closures.closure_table import closure_table
from rlml_slam.slam.landmarks.reflector_states import state_table


class MapServices:
    """Answers in the mapper's thread, between two frames, so that no subscription waits."""

    def __init__(
        self, node: Any, params: Parameters, mapper: Mapper, join: FrameAssembler
    ) -> None:
        self._node = node
        self._p = params
        self._mapper = mapper
        self._join = join
        # in the node's group, every subscription would wait for the answer
        own = MutuallyExclusiveCallbackGroup()
        for kind, name, answer in (
            (Trigger, '~/save_map', self.save_map),
            (LoadMap, '~/load_map', self.load_map),
            (Trigger, '~/reset', self.reset),
            (Trigger, '~/closures', self.closures),
            (Trigger, '~/reflectors', self.reflectors),
            (AddDiagnostics, '~/revoke_closure', self.revoke_closure),
            (GetMap, '~/dynamic_map', self.dynamic_map),
            (SetBool, '~/pause_new_measurements', self.pause),
            (Trigger, '~/relocalize', self.relocalize),
            (SetBool, '~/set_localization_mode', self.set_localization_mode),
            (Empty, 'reinitialize_global_localization', self.reinitialize),
        ):
            node.create_service(kind, name, self._in_worker(answer), callback_group=own)

    def _in_worker(self, answer: Callable[[Any, Any], Any]) -> Any:
        async def call(request: Any, response: Any) -> Any:
            executor = self._node.executor
            done = Future(executor=executor)

            def finish(_: Any) -> None:
                done.set_result(None)
                # an executor that waits for messages does not see what became of a future
                executor.wake()

            self._mapper.worker.submit(lambda: answer(request, response)).add_done_callback(finish)
            await done
            return response

        return call

    def save_map(self, _request: Any, response: Any) -> None:
        """Write the map under map_file_name."""
        self._try(response, lambda: self._mapper.save(self._p.node.map_file_name))

    def reset(self, _request: Any, response: Any) -> None:
        """Forget the map and begin at map_start_pose; the front end does as well."""
        self._mapper.start_at(np.array(self._p.node.map_start_pose))
        localizes = self._mapper.saved is not None
        response.success = True
        response.message = (
            'begins at map_start_pose in the same map' if localizes else 'the map begins anew'
        )

    def closures(self, _request: Any, response: Any) -> None:
        """All loop closures with their records, as a table of comma-separated values."""
        response.success = True
        response.message = closure_table(self._mapper.back_end.loop_closer.records)

    def reflectors(self, _request: Any, response: Any) -> None:
        """What has become of each reflector, as a table of comma-separated values."""
        response.success = True
        response.message = state_table(self._mapper.back_end.reflector_states())

    def revoke_closure(self, request: Any, response: Any) -> None:
        """Take a loop closure out of the map; load_namespace is its number."""
        self._try(response, lambda: self._mapper.revoke(request.load_namespace))

    def pause(self, request: Any, response: Any) -> None:
        """Leave new measurements out of the map, or take them in again."""
        self._join.paused = bool(request.data)
        response.success = True
        response.message = 'paused' if request.data else 'measurements are used again'

    def relocalize(self, _request: Any, response: Any) -> None:
        """Find the newest scan anywhere in the map; while localizing, go on from there."""
        response.success, response.message = self._mapper.relocalize()

    def reinitialize(self, _request: Any, _response: Any) -> None:
        """The same for those who ask without wanting an answer: it goes to the log."""
        found, message = self._mapper.relocalize()
        logger = self._node.get_logger()
        (logger.info if found else logger.warning)(f'reinitialize_global_localization: {message}')

    def set_localization_mode(self, request: Any, response: Any) -> None:
        """Localise in the map as it is now, or begin a new one."""
        self._try(response, lambda: self._mapper.localize(bool(request.data)))

    def dynamic_map(self, _request: Any, response: Any) -> None:
        """The grid as it is now."""
        grid = self._mapper.current().grid
        if grid is not None:
            response.map = self._message(grid)

    def load_map(self, request: Any, response: Any) -> None:
        """Localise in another map of map_directory; map_url is its name."""
        try:
            saved = self._mapper.load(request.map_url or self._p.node.map_file_name)
        except RlmlError as e:
            refuse_map(self._node, response, e)
            return
        response.result = LoadMap.Response.RESULT_SUCCESS
        if saved.grid is not None:
            response.map = self._message(saved.grid)

    def _message(self, grid: OccupancyGrid) -> Any:
        return encode.occupancy_grid(make_rclpy, self._mapper.stamp, self._p.node.map_frame, grid)

    @staticmethod
    def _try(response: Any, act: Callable[[], str]) -> None:
        try:
            response.message = act()
            response.success = True
        except RlmlError as e:
            response.success, response.message = False, str(e)


def refuse_map(node: Any, response: Any, why: RlmlError) -> None:
    """Answer load_map where a map cannot be had; the answer has no text, so the log tells."""
    node.get_logger().warning(f'load_map: {why}')
    response.result = (
        LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
        if isinstance(why, NoMapError) or isinstance(why.__cause__, FileNotFoundError)
        else LoadMap.Response.RESULT_UNDEFINED_FAILURE
    )
