# SPDX-License-Identifier: Apache-2.0
"""Health with its reasons with every frame; once a second also what became of the inputs."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from rlml_slam.estimation.health import with_problems
from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.ros.sensors import LATCHED, Sensors, input_figures
from rlml_slam.types import Frame, Health, Level, Status

PERIOD = 1.0  # [s] of a clock that goes on without any input
WATCH = 0.1  # [s] between two looks whether the input has fallen silent


class HealthPublisher:
    """Publishes the health of the newest frame; without new frames, that they are missing.

    It is on ~/health with every frame and at once when it changes, on /diagnostics with all
    figures every PERIOD, and in the log where its level is another one than PERIOD before.
    """

    def __init__(
        self,
        node: Any,
        sensors: Sensors | None = None,
        figures: Callable[[], dict[str, object]] = dict,
        problems: Callable[[], tuple[str, ...]] = tuple,
    ) -> None:
        self._guard, self._logger = guard_of(node), node.get_logger()
        self._logged = Level.DEGRADED  # as it is without input
        self._problems = problems
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._sensors = sensors
        self._figures = figures
        self._frame: Frame | None = None
        self._frames = 0
        self._statuses: Counter[int] = Counter()
        self._reported = 0
        self._publisher = node.create_publisher(
            rclpy_class('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', 10
        )
        self._health = node.create_publisher(
            rclpy_class('diagnostic_msgs/msg/DiagnosticStatus'), '~/health', LATCHED
        )
        self._heard = time.monotonic()
        self._is_silent = False
        node.every(PERIOD, self.publish)
        node.every(WATCH, self.watch)
        self._publish_health()

    @property
    def newest(self) -> int:
        """Stamp of the newest frame, 0 before the first."""
        return self._frame.stamp if self._frame is not None else 0

    def update(self, frame: Frame) -> None:
        """The newest frame."""
        self._frame = frame
        self._frames += 1
        self._statuses.update(frame.statuses.tolist())
        self._heard, self._is_silent = time.monotonic(), False
        self._publish_health()

    def watch(self) -> None:
        """Say at once that the input has fallen silent."""
        if not self._is_silent and time.monotonic() - self._heard > PERIOD:
            self._is_silent = True
            self._publish_health()

    def health(self) -> Health:
        """The health as it is now."""
        if self._frame is None:
            last = '' if self._sensors is None else self._sensors.synchronizer.inputs.last_error
            reasons = ('no input yet', f'not used: {last}') if last else ('no input yet',)
            return with_problems(Health(Level.DEGRADED, reasons), self._problems())
        # who is lost stays lost in silence
        silence = ('no new scan or reflectors',) if self._is_silent else ()
        return with_problems(with_problems(self._frame.health, silence), self._problems())

    def end(self) -> None:
        """Say that the node is inactive from now on."""
        self._publish_health(with_problems(self.health(), ('the node is not active',)))

    def _publish_health(self, health: Health | None = None) -> None:
        stamp = {'stamp': f'{self.newest // 10**9}.{self.newest % 10**9:09d}'}
        self._health.publish(
            encode.diagnostic_status(make_rclpy, self._name, health or self.health(), stamp)
        )

    def _inputs(self) -> dict[str, object]:
        return {} if self._sensors is None else input_figures(self._sensors.synchronizer)

    def summary(self) -> str:
        """What there was, in a line for the end of a run."""
        inputs = [f'{what} {n}' for what, n in self._inputs().items() if n]
        refused = [f'{what} {n}' for what, n in self._guard.figures().items()]
        return '; '.join([f'ends after {self._frames} frames', *inputs, *refused])

    def publish(self) -> None:
        """Send the status."""
        figures: dict[str, object] = {
            'frames': self._frames, **self._inputs(), **self._guard.figures(),
        }  # fmt: skip
        if self._statuses:
            figures |= {f'detections {s.name.lower()}': self._statuses[s] for s in Status}
        if self._frame is not None:
            figures['wall time of the last frame [ms]'] = f'{self._frame.wall_ms:.2f}'
            self._is_silent = self._is_silent or self._frames == self._reported
        self._reported = self._frames
        health = self.health()
        message = encode.diagnostics(
            make_rclpy, self.newest, self._name, health, {**figures, **self._figures()}
        )
        self._publisher.publish(message)
        self._publish_health()
        if health.level != self._logged:
            self._logged = health.level
            text = ': '.join([f'health is {health.level.name}', *health.reasons[:1]])
            if health.level is Level.OK:  # a line of its own: ROS allows one severity for each
                self._logger.info(text)
            else:
                self._logger.warning(text)


def map_id(saved: SavedMap | None) -> str:
    """Of the saved map that a node uses."""
    return 'none: a map in the making' if saved is None else saved.id
