# SPDX-License-Identifier: Apache-2.0
"""The services of ekf_slam: those of the back end that a filter can answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nav_msgs.srv import LoadMap
from std_srvs.srv import Trigger

from rlml_slam.ekf.estimator import Estimator
from rlml_slam.errors import MapError, RlmlError
from rlml_slam.maps.saved_map import SavedMap, require_reflectors
from rlml_slam.params import Node
from rlml_slam.ros.back_end.map_folder import MapFolder
from rlml_slam.ros.back_end.map_services import refuse_map
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy


class EkfServices:
    """save_map, load_map and reset; ``begin(saved)`` restarts, in a map or without one."""

    def __init__(
        self,
        node: Any,
        params: Node,
        estimator: Estimator,
        begin: Callable[[SavedMap | None], None],
    ) -> None:
        self._node, self._p, self._estimator, self._begin = node, params, estimator, begin
        self._folder = MapFolder(params.map_directory)
        self.saved: SavedMap | None = None
        if params.mode == 'localization':
            self.saved = require_reflectors(self._folder.load(params.map_file_name))
        node.create_service(Trigger, '~/save_map', self.save_map)
        node.create_service(LoadMap, '~/load_map', self.load_map)
        node.create_service(Trigger, '~/reset', self.reset)

    def save_map(self, _request: Any, response: Any) -> Any:
        """Write landmarks and grid under map_file_name."""
        try:
            response.message = self._save()
            response.success = True
        except RlmlError as e:
            response.success, response.message = False, str(e)
        return response

    def _save(self) -> str:
        saved = SavedMap(self._estimator.reflectors(), self._estimator.occupancy_grid())
        if not len(saved.reflectors) and saved.grid is None:
            raise MapError('there is no map yet')
        name = self._p.map_file_name
        return f'{self._folder.save(name, saved)}: {len(saved.reflectors)} landmarks'

    def load_map(self, request: Any, response: Any) -> Any:
        """Localise in another map of map_directory, from map_start_pose; map_url is its name."""
        try:
            name = request.map_url or self._p.map_file_name
            self.saved = require_reflectors(self._folder.load(name))
        except RlmlError as e:
            refuse_map(self._node, response, e)
            return response
        self._begin(self.saved)
        response.result = LoadMap.Response.RESULT_SUCCESS
        if self.saved.grid is not None:
            stamp = self._node.get_clock().now().nanoseconds
            response.map = encode.occupancy_grid(
                make_rclpy, stamp, self._p.map_frame, self.saved.grid
            )
        return response

    def reset(self, _request: Any, response: Any) -> Any:
        """Forget what was estimated and begin at map_start_pose; a loaded map stays."""
        self._begin(self.saved)
        response.success, response.message = True, 'the map was discarded and restarted'
        return response
