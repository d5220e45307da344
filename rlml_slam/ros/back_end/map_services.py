# SPDX-License-Identifier: Apache-2.0
"""The services of the back end; each answers with what happened, in words."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.srv import AddDiagnostics
from nav_msgs.srv import GetMap, LoadMap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Empty, SetBool, Trigger

from rlml_slam.errors import MapError, NoMapError, RlmlError
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.params import Parameters
from rlml_slam.ros.back_end.mapper import Mapper
from rlml_slam.ros.back_end.user_requests import UserRequests
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy
from rlml_slam.slam.closures.closure_table import closure_table
from rlml_slam.slam.landmarks.reflector_states import state_table


class MapServices:
    """Answers in the mapper's thread, between two frames, so that no subscription waits.

    ``answers`` takes a request and its response to each service, by its name; ``refused`` is the
    newest request that was refused, and why.
    """

    def __init__(
        self, node: Any, params: Parameters, mapper: Mapper, requests: UserRequests
    ) -> None:
        self._node = node
        self._p = params
        self._mapper = mapper
        self._requests = requests
        self.answers: dict[str, Callable[[Any, Any], Any]] = {}
        self.refused = ''
        # in the node's group, every subscription would wait for the answer, and every service in
        # one that is exclusive
        own = ReentrantCallbackGroup()

        def serve(kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
            self.answers[name] = answer
            node.create_service(kind, name, self._in_worker(answer), callback_group=own)

        in_words: tuple[tuple[Any, str, Callable[[Any], str]], ...] = (
            (Trigger, 'save_map', lambda _: requests.save(params.node.map_file_name)),
            (Trigger, 'reset', lambda _: requests.reset()),
            (Trigger, 'closures', lambda _: closure_table(mapper.back_end.loop_closer.records)),
            (Trigger, 'reflectors', lambda _: state_table(mapper.back_end.reflector_states())),
            (AddDiagnostics, 'revoke_closure', lambda r: requests.revoke(r.load_namespace)),
            (SetBool, 'pause_new_measurements', lambda r: self._pause(r.data)),
            (SetBool, 'set_localization_mode', lambda r: requests.localize(r.data)),
        )
        for kind, name, act in in_words:
            serve(kind, f'~/{name}', partial(self._say, name, act))
        serve(LoadMap, '~/load_map', self.load_map)
        serve(GetMap, '~/dynamic_map', self.dynamic_map)
        serve(Trigger, '~/relocalize', self.relocalize)
        serve(Empty, 'reinitialize_global_localization', self.reinitialize)

    def _in_worker(self, answer: Callable[[Any, Any], Any]) -> Any:
        async def call(request: Any, response: Any) -> Any:
            executor = self._node.executor
            done = Future(executor=executor)

            def end(_: Any) -> None:
                done.set_result(None)
                # an executor that waits for messages does not see what became of a future
                executor.wake()

            def finish(job: concurrent.futures.Future[Any]) -> None:
                failed = 'the node ends' if job.cancelled() else job.exception()
                if failed is not None:
                    refuse(response, f'not done: {failed}')
                later = None if failed else job.result()
                if isinstance(later, concurrent.futures.Future):
                    later.add_done_callback(end)
                else:
                    end(job)

            self._mapper.worker.submit(lambda: answer(request, response)).add_done_callback(finish)
            await done
            return response

        return call

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        return {'last refused request': self.refused} if self.refused else {}

    def _say(self, service: str, act: Callable[[Any], str], request: Any, response: Any) -> None:
        """Answer with what was done, or with why it was refused."""
        try:
            response.message = act(request)
            response.success = True
        except RlmlError as e:
            refuse(response, str(e))
            self.refused = f'{service}: {e}'

    def _pause(self, on: bool) -> str:
        self._mapper.system.pause(on)
        return 'paused' if on else 'measurements are used again'

    def relocalize(self, _request: Any, response: Any) -> Any:
        """Find the newest scan anywhere in the map; while localizing, go on from there."""

        def respond(answer: Any) -> None:
            response.success, response.message = answer.result().success, answer.result().text

        return self._relocalize(respond)

    def reinitialize(self, _request: Any, _response: Any) -> Any:
        """The same for those who ask without wanting an answer: it goes to the log."""
        logger = self._node.get_logger()

        def log(answer: Any) -> None:
            found = answer.result()
            text = f'reinitialize_global_localization: {found.text}'
            if found.success:  # a line of its own: ROS allows one severity for each
                logger.info(text)
            else:
                logger.warning(text)

        return self._relocalize(log)

    def _relocalize(self, take: Callable[[Any], None]) -> Any:
        answer = self._requests.relocalize()
        answer.add_done_callback(take)
        return answer

    def dynamic_map(self, _request: Any, response: Any) -> None:
        """The grid as it is now."""
        grid = self._mapper.current().grid
        if grid is not None:
            response.map = self._message(grid)

    def load_map(self, request: Any, response: Any) -> None:
        """Localise in another map of map_directory; map_url is its name."""
        try:
            if not request.map_url:
                raise MapError('map_url is empty: it has to be the name of a map')
            saved = self._requests.load(request.map_url)
        except RlmlError as e:
            self.refused = f'load_map: {e}'
            refuse_map(self._node, response, e)
            return
        response.result = LoadMap.Response.RESULT_SUCCESS
        if saved.grid is not None:
            response.map = self._message(saved.grid)

    def _message(self, grid: OccupancyGrid) -> Any:
        return encode.occupancy_grid(make_rclpy, self._mapper.stamp, self._p.node.map_frame, grid)


def refuse(response: Any, why: str) -> None:
    """Answer that a request failed, and why.

    The answer of load_map has no text: ``map``, which is empty then, has it as its frame.
    """
    if hasattr(response, 'success'):
        response.success, response.message = False, why
    elif hasattr(response, 'result'):
        response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        response.map.header.frame_id = why


def refuse_map(node: Any, response: Any, why: RlmlError) -> None:
    """Answer load_map where a map cannot be had."""
    node.get_logger().warning(f'load_map: {why}')
    refuse(response, str(why))
    if isinstance(why, NoMapError) or isinstance(why.__cause__, FileNotFoundError):
        response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
