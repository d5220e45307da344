# SPDX-License-Identifier: Apache-2.0
"""``python -m rlml_lab.support.config_file``: a parameter file with every default."""

from __future__ import annotations

import math
import sys
from typing import Any

from rlml_slam.params import (
    Declaration,
    DeformableParameters,
    DetectorParameters,
    EkfParameters,
    Parameters,
    SimulatorParameters,
    declarations,
)
from rlml_slam.ros.sensor_input import STREAMS

FILES: dict[str, tuple[type[Any], str]] = {
    'default.yaml': (Parameters, 'Every parameter of front_end, back_end, slam and `rlml replay`'),
    'simulator.yaml': (SimulatorParameters, 'Every parameter of the simulator'),
    'deformable_slam.yaml': (DeformableParameters, 'Every parameter of deformable_slam'),
    'ekf_slam.yaml': (EkfParameters, 'Every parameter of ekf_slam and `rlml replay --system ekf`'),
    'reflector_detector.yaml': (DetectorParameters, 'Every parameter of reflector_detector'),
}


# what a node declares, because it shares the group, but does not read: names and groups
UNREAD: dict[str, tuple[str, ...]] = {
    'ekf_slam.yaml': (
        'motion.scale_error_sigma_without_lidar', 'motion.drift_sigma', 'motion.pivot_sigma',
        'continue_map',
        'restore_pose', 'estimate_odometry_delay', 'scan_match', 'loop_closure',
        'relocalization', 'solver', 'incident',
    ),
    'deformable_slam.yaml': (
        'motion.scale_error_sigma', 'motion.scale_error_sigma_without_lidar',
        'motion.scale_error_time', 'motion.drift_sigma', 'motion.pivot_sigma',
        'estimate_odometry_delay', 'trust_ids',
    ),
    'reflector_detector.yaml': (
        'motion.scale_error_sigma', 'motion.scale_error_sigma_without_lidar',
        'motion.scale_error_time', 'motion.drift_sigma', 'motion.pivot_sigma',
        'local_frame', 'use_scan', 'use_reflectors', 'estimate_odometry_delay', 'trust_ids',
        # the topics of all streams but those that it reads, and reflectors, which it publishes
        *(row[0] for s, row in STREAMS.items() if s not in ('scan', 'odom', 'imu', 'reflectors')),
        'mode', 'map_directory', 'map_file_name', 'map_start_pose',
        'restore_pose', 'continue_map', 'transform_publish_period', 'map_update_interval',
        'detect_reflectors', 'provide_odom_frame', 'tf_broadcast', 'transform_tolerance', 'shadow',
    ),
}  # fmt: skip


def parameter_file(name: str) -> str:
    """The text of ``config/<name>``: defaults with meaning, unit and range as comments."""
    of, what = FILES[name]
    lines = [
        '# SPDX-License-Identifier: Apache-2.0',
        f'# {what} with its default, written by `make config`.',
        '# Copy what you change into a file of your own: names that it leaves out keep these.',
        '/**:',
        '  ros__parameters:',
    ]
    group = 'node'
    for d in declarations(of):
        if {d.name, d.name.split('.')[0]} & set(UNREAD.get(name, ())):
            continue
        if d.group != group:
            group = d.group
            lines.append(f'    {group}:')
        indent = '    ' if group == 'node' else '      '
        lines.append(f'{indent}# {_comment(d)}')
        lines.append(f'{indent}{d.field}: {_value(d.default)}')
    return '\n'.join(lines) + '\n'


def _comment(d: Declaration) -> str:
    unit = f' [{d.unit}]' if d.unit else ''
    bounds = ''
    if d.choices:
        bounds = f' ({" | ".join(d.choices)})'
    elif math.isfinite(d.low) or math.isfinite(d.high):
        bounds = f' ({d.low:g} to {d.high:g})'
    return f'{d.meaning}{unit}{bounds}'


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f'[{", ".join(_value(v) for v in value)}]'
    if isinstance(value, str):
        return f"'{value}'"
    text = repr(value)
    # YAML 1.1 takes 1e-06 for a string
    return text if 'e' not in text or '.' in text else text.replace('e', '.0e')


def main() -> None:
    """Print the file that the argument names."""
    sys.stdout.write(parameter_file(sys.argv[1]))


if __name__ == '__main__':
    main()
