# SPDX-License-Identifier: Apache-2.0
"""A node with the lifecycle of ROS 2, which makes its transitions itself unless told not to.

Unconfigured, it has parameters only. Inactive, it has its map and its topics, takes nothing from
sensors and publishes nothing. Nothing that was estimated is lost by deactivate.
"""

from __future__ import annotations

import gc
import math
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from rlml_slam.errors import ParameterError, RlmlError
from rlml_slam.params import Parameters
from rlml_slam.ros.declare import Check, declare
from rlml_slam.ros.kernels import prepare
from rlml_slam.ros.run import SIGNALS

BELOW = 'shadow'
RECENT = 1.0  # [s] for which who publishes a topic is not asked again
# what a node hears from the other end; all else is from the robot and its user
OURS = ('rlml/', 'deskewed_points', 'reflectors/associated')
KINDS = {
    'timers': 'timer', 'subscriptions': 'subscription', 'services': 'service',
    'clients': 'client', 'guards': 'guard_condition', 'publishers': 'publisher',
}  # fmt: skip


class ManagedNode(LifecycleNode):
    """Makes what it needs in ``build``, and registers in ``exits`` what is to be done at its end.

    What is made there is managed: publishers send and timers run only while the node is active,
    but for the topics by which front end and back end talk. In shadow mode, no name is one that
    another localization may have. With the parameter ``autostart``, it is active at once; then
    whatever prevents that is raised.
    """

    is_configured = is_active = False
    _is_managing = False

    def __init__(self, name: str, of: type[Any] = Parameters, **options: Any) -> None:
        super().__init__(name, **options)
        self.checks: dict[str, Check] = {}
        self._own: dict[str, set[Any]] = {}
        self._heard_of: dict[str, tuple[float, list[str]]] = {}  # by topic, and when they were
        self._failure: Exception | None = None
        self.exits = ExitStack()
        self.params: Any = declare(self, of, self.checks)
        prepare(self)
        SIGNALS.is_held = True  # until the node is made, so that it is there to be ended
        self._is_managing = True
        self._service_change_state.callback = self._answer(self._service_change_state.callback)
        if self.params.node.autostart:
            self.start()

    def start(self) -> None:
        """Configure and activate; raises what prevents it."""
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                assert self._failure is not None
                raise self._failure

    # --- what a node does at its transitions ---------------------------------------------------

    def build(self) -> None:
        """Make everything; RlmlError where a parameter or a file does not permit it."""
        raise NotImplementedError

    def begin(self) -> None:
        """Active from now on."""

    def rest(self) -> None:
        """Inactive from now on."""

    # --- transitions ---------------------------------------------------------------------------

    def on_configure(self, state: Any) -> Any:
        """Make everything; on failure, the node is as it was."""
        self._own = self._entities()
        self.is_configured = True
        out = self._attempt(self.build)
        return super().on_configure(state) if out == TransitionCallbackReturn.SUCCESS else out

    def on_activate(self, state: Any) -> Any:
        """Take messages and publish."""
        super().on_activate(state)
        self.is_active = True
        for timer in self._made('timers'):
            timer.reset()
        out = self._attempt(self.begin)
        if out != TransitionCallbackReturn.SUCCESS:
            self._halt()
            super().on_deactivate(state)
        elif hasattr(self, 'health'):
            self.health.publish()
        return out

    def on_deactivate(self, state: Any) -> Any:
        """Take and publish nothing."""
        if hasattr(self, 'health'):
            self.health.end()  # it is latched: who comes later would hear that all is well
        self._halt()
        out = self._attempt(self.rest)
        return super().on_deactivate(state) if out == TransitionCallbackReturn.SUCCESS else out

    def on_cleanup(self, state: Any) -> Any:
        """Save, and take everything away that ``build`` made."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup
    on_error = on_cleanup

    def destroy_node(self) -> None:
        """Save first."""
        self._release()
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()  # it would keep the node in the graph

    def _attempt(self, act: Any) -> Any:
        """Run a step; an error is logged, kept, and leaves nothing behind."""
        try:
            act()
        except RlmlError as e:
            self._failure, out = e, TransitionCallbackReturn.FAILURE
            self.get_logger().error(f'{e}')
        except Exception as e:
            self._failure, out = e, TransitionCallbackReturn.ERROR
            self.get_logger().error(''.join(traceback.format_exception(e)))
        else:
            return TransitionCallbackReturn.SUCCESS
        if not self.is_active:
            self._release()
        return out

    def _halt(self) -> None:
        self.is_active = False
        for timer in self._made('timers'):
            timer.cancel()

    def _release(self) -> None:
        """End what ``build`` made; the node is as before it."""
        if not self.is_configured:
            return
        self._halt()
        if hasattr(self, 'health'):
            self.get_logger().info(self.health.summary())
        self.exits.close()
        self.is_configured = False
        for kind, name in KINDS.items():
            for entity in self._made(kind):
                getattr(self, f'destroy_{name}')(entity)
        self._managed_entities.clear()
        group = self.default_callback_group  # keeps references to what is no more
        group.entities = {ref for ref in group.entities if ref() is not None}
        self.checks.clear()
        if gc.get_freeze_count():  # by the run of the executable: see there
            gc.unfreeze()
            gc.collect()

    def _entities(self) -> dict[str, set[Any]]:
        return {kind: set(getattr(self, kind)) for kind in KINDS}

    def _made(self, kind: str) -> list[Any]:
        clock = self._time_source._clock_sub  # made when use_sim_time is set, and the node's own
        return [e for e in getattr(self, kind) if e not in self._own[kind] and e is not clock]

    def _answer(self, change: Any) -> Any:
        """The service of transitions; one that the present state does not have is refused."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RCLError:
                state = self._state_machine.current_state[1]
                what = request.transition.label or request.transition.id
                self.get_logger().warning(f'transition {what} refused: the node is {state}')
                response.success = False
                return response

        return answer

    # --- what is made ---------------------------------------------------------------------------

    def _name(self, name: str) -> str:
        is_shared = self._is_managing and self.params.node.shadow and not name.startswith('~')
        return f'{BELOW}/{name.lstrip("/")}' if is_shared else name

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
        """A publisher that sends while the node is active."""
        name = self._name(topic)
        if not self._is_managing or topic.startswith(OURS):
            return super().create_publisher(msg_type, name, qos_profile, **options)
        publisher = self.create_lifecycle_publisher(msg_type, name, qos_profile, **options)
        if self.is_active:
            publisher.on_activate(None)
        return publisher

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Any:
        """A subscription; in shadow mode, to the other end in shadow mode."""
        name = self._name(topic) if topic.startswith(OURS) else topic
        try:
            return super().create_subscription(msg_type, name, callback, qos_profile, **options)
        except RCLError as e:
            full = self.resolve_topic_name(name)
            raise ParameterError(
                f'{name}: {full} cannot be heard as {msg_type.__name__}: this process has it with '
                'another type; two inputs must not be on one topic'
            ) from e

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **options: Any) -> Any:
        """A service, which answers while the node is inactive as well."""
        return super().create_service(srv_type, self._name(srv_name), callback, **options)

    def publishers_of(self, topic: str) -> list[str]:
        """Full names of the nodes that publish a topic, itself among them; at most RECENT old."""
        now, (since, names) = time.monotonic(), self._heard_of.get(topic, (-math.inf, []))
        if now - since > RECENT:
            found = self.get_publishers_info_by_topic(topic)
            names = sorted(f'{i.node_namespace.rstrip("/")}/{i.node_name}' for i in found)
            self._heard_of[topic] = now, names
        return names

    def every(self, period: float, act: Callable[[], object]) -> Any:
        """A timer [s] of the wall clock, whatever /clock does: its silence has to be noticed."""
        return self.create_timer(period, act, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def create_timer(self, *args: Any, **options: Any) -> Any:
        """A timer that runs while the node is active."""
        timer = super().create_timer(*args, **options)
        if self._is_managing and not self.is_active:
            timer.cancel()
        return timer
