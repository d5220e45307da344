# SPDX-License-Identifier: Apache-2.0
"""/diagnostics of reflector_detector once a second: what was found and what was rejected."""

from __future__ import annotations

from collections import Counter
from typing import Any

from rlml_slam.ros.codecs import encode
from rlml_slam.ros.codecs.message_types import make_rclpy, rclpy_class
from rlml_slam.ros.diagnostics import PERIOD
from rlml_slam.ros.sensors import Sensors, input_figures
from rlml_slam.sensing.reflectors.reflector_detector import Found
from rlml_slam.types import Health, Level, Scan


class DetectorHealth:
    """Counts scans, reflectors and the bright spots that are none, by the reason."""

    def __init__(self, node: Any, sensors: Sensors) -> None:
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._sensors = sensors
        self.counts: Counter[str] = Counter()
        self._reported, self._fault = Counter[str](), ''
        self._stamp = 0
        self._last = 0
        self._publisher = node.create_publisher(
            rclpy_class('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', 10
        )
        node.every(PERIOD, self.publish)

    def update(self, scan: Scan, found: Found, fault: str) -> None:
        """One scan and what it held; ``fault`` is why its intensities show nothing, or empty."""
        self._stamp, self._last = scan.stamp, len(found)
        self._fault = fault or self._fault
        self.counts['scans'] += 1
        self.counts['scans without intensities'] += bool(fault)
        self.counts['reflectors'] += len(found)
        self.counts.update({f'rejected: {f.name.lower()}': n for f, n in found.rejected.items()})

    def health(self) -> Health:
        """OK, or DEGRADED with the reason, by the scans since the last status."""
        if not self.counts['scans']:
            return Health(Level.DEGRADED, ('no scan yet',))
        new = self.counts - self._reported
        if not new['scans']:
            return Health(Level.DEGRADED, ('no new scan',))
        if new['scans without intensities'] == new['scans']:
            return Health(Level.DEGRADED, (self._fault,))
        return Health()

    def summary(self) -> str:
        """What there was, in a line for the end of a run."""
        figures = [f'{what} {n}' for what, n in self.counts.items() if n]
        return '; '.join(['ends', *figures])

    def end(self) -> None:
        """Nothing to take back: its health is on /diagnostics alone, which keep nothing."""

    def publish(self) -> None:
        """Send the status."""
        figures: dict[str, object] = dict(self.counts)
        figures['reflectors in the last scan'] = self._last
        figures |= input_figures(self._sensors.synchronizer)
        message = encode.diagnostics(make_rclpy, self._stamp, self._name, self.health(), figures)
        self._reported = self.counts.copy()
        self._publisher.publish(message)
