# SPDX-License-Identifier: Apache-2.0
"""/diagnostics once a second: health with its reasons, and what became of the inputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.ros.sensors import Sensors
from rlml_slam.types import Frame, Health, Level, Status

PERIOD = 1.0  # [s] of a clock that goes on without any input


class HealthPublisher:
    """Publishes the health of the newest frame; without new frames, that they are missing."""

    def __init__(
        self,
        node: Any,
        sensors: Sensors | None = None,
        figures: Callable[[], dict[str, object]] = dict,
        problems: Callable[[], tuple[str, ...]] = tuple,
    ) -> None:
        self._guard = guard_of(node)
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
        # steady: with simulated time, silence of /clock must be reported as well
        node.create_timer(PERIOD, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def newest(self) -> int:
        """Stamp of the newest frame, 0 before the first."""
        return self._frame.stamp if self._frame is not None else 0

    def update(self, frame: Frame) -> None:
        """The newest frame."""
        self._frame = frame
        self._frames += 1
        self._statuses.update(frame.statuses.tolist())

    def _inputs(self) -> dict[str, object]:
        if self._sensors is None:
            return {}
        inputs = self._sensors.synchronizer.inputs
        figures: dict[str, object] = {
            f'{stream} {what}': n
            for stream, counts in inputs.totals().items()
            for what, n in counts.items()
        }
        if inputs.last_error:
            figures['last refused input'] = inputs.last_error
        return figures

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
        health, stamp = Health(Level.DEGRADED, ('no input yet',)), 0
        if self._frame is not None:
            health, stamp = self._frame.health, self._frame.stamp
            figures['wall time of the last frame [ms]'] = f'{self._frame.wall_ms:.2f}'
            if self._frames == self._reported:
                level = max(health.level, Level.DEGRADED)  # who is lost stays lost in silence
                health = Health(level, (*health.reasons, 'no new scan or reflectors'))
        self._reported = self._frames
        problems = self._problems()
        if problems:
            level = max(health.level, Level.DEGRADED)
            health = Health(level, (*health.reasons, *problems))
        message = encode.diagnostics(
            make_rclpy, stamp, self._name, health, {**figures, **self._figures()}
        )
        self._publisher.publish(message)
