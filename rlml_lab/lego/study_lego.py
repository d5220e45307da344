# SPDX-License-Identifier: Apache-2.0
"""``study lego``: spikes and EKF on the LEGO robot among cylinders, the note's own task."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.datasets.lego import (
    CAMERA_LAG,
    LASER_FRAME,
    SCAN_LAG,
    T_BASE_LASER,
    Lego,
    read_lego,
)
from rlml_lab.lego.lego_scale import Ranges, at, fit_scale, ranges_of
from rlml_lab.lego.lego_time import camera_lag, scan_lag
from rlml_slam import se2
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.params import EkfParameters, from_mapping, read_yaml
from rlml_slam.se2 import Array
from rlml_slam.types import Odometry, Reflectors, Scan

# what the laser and its cylinders are like: ranges and bearings to the true cylinders have so much
# noise; the offset, which holds the cylinder's radius and an error of this laser, makes the mapped
# cylinders as far apart as the true ones
PARAMETERS: dict[str, Any] = {
    'ekf.extractor': 'spikes',
    'ekf.min_separation': 0.35,
    'spikes.threshold': 0.1,
    'spikes.range_offset': 0.115,
    'spikes.cylindrical': False,
    'spikes.max_width': 0.15,
    'spikes.max_range': 2.0,
    'spikes.min_beams': 3,
    'spikes.sigma_range': 0.02,
    'spikes.sigma_bearing': 0.02,
}
SCANNER = np.array([T_BASE_LASER[0], T_BASE_LASER[1], 0.0])
AIM = 0.03  # [m] of position against the camera
NEAR = 0.15  # [m] a landmark farther from every cylinder is a false one


@dataclass(frozen=True)
class Result:
    """Scanner poses (n, 3) and landmarks in the map, and odometry's scanner poses (n, 3)."""

    scanner: Array
    dead_reckoning: Array
    reflectors: Reflectors


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study lego``."""
    parser = subparsers.add_parser(
        'lego', help='spikes and EKF on the LEGO robot among cylinders: figures and a picture'
    )
    parser.add_argument('folder', metavar='DIR', type=Path, help='folder of the data set')
    parser.add_argument('--config', type=Path, metavar='YAML', help='parameters that differ')
    parser.add_argument('--out', type=Path, metavar='PNG', help='picture to be written')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Run the system, print the figures, draw the picture."""
    data = read_lego(args.folder)
    result = drive(data, read_yaml(args.config, EkfParameters) if args.config else {})
    figures = evaluate(data, result) | evaluate_scale(data, result)
    if args.out is not None:
        write_atomically(args.out, picture(data, result))
    if args.json:
        print(json.dumps(figures))
    else:
        print('\n'.join(f'{name:<34} {value}' for name, value in figures.items()))
        print(verdict_text(figures))
    return 0


def verdict_text(figures: dict[str, Any]) -> str:
    """Position against the camera, as the track is and as the ranges say it is, and the proof."""
    f = figures
    scale, sigma = f['track_scale_by_ranges'], f['track_scale_sigma']
    rms, before = 100 * f['range_rms_m'], 100 * f['range_rms_without_scale_m']
    lines = [
        f'position RMSE against the camera track after rigid alignment, aim {100 * AIM:.0f} cm:',
        f'  the track as it is               {_verdict(f["position_rmse_m"])}',
        f'  the track {scale:.3f} times smaller    {_verdict(f["position_rmse_track_scaled_m"])}',
        f'{f["ranges"]} ranges to the true cylinders, without wheels and places of the filter,',
        f'say that the track is {scale:.3f} +- {sigma:.3f} times too large. They fit the true map',
        f'to {before:.1f} cm with the track as it is, to {rms:.1f} cm with it corrected. A camera',
        'calibrated to the floor, H above it, shows what is h above it H/(H-h) too large.',
        f'Scans are stamped {f["scan_lag_s"]:.2f} s late by the turns of scans and wheels '
        f'({SCAN_LAG:.2f} is taken),',
        f'pictures {f["camera_lag_s"]:.2f} s by the ways of camera and wheels '
        f'({CAMERA_LAG:.2f} is taken).',
    ]
    return '\n' + '\n'.join(lines)


def _verdict(rmse: float) -> str:
    return f'{100 * rmse:.2f} cm, {"met" if rmse <= AIM else "not met"}'


def drive(data: Lego, values: dict[str, Any] | None = None) -> Result:
    """The EKF over the whole drive."""
    params: EkfParameters = from_mapping({**PARAMETERS, **(values or {})}, EkfParameters)
    slam = EkfSlam(params)
    slam.set_sensor_pose(LASER_FRAME, T_BASE_LASER)
    inputs: list[Odometry | Scan] = [*data.odometry, *data.scans]
    # odometry before the scan of the same stamp
    for item in sorted(inputs, key=lambda i: (i.stamp, isinstance(i, Scan))):
        if isinstance(item, Scan):
            slam.add_scan(item)
        else:
            slam.add_odometry(item)
    slam.finish()
    stamps, poses = slam.trajectory()
    odometry = np.array([o.pose for o in data.odometry])
    odometry[:, 2] = np.unwrap(odometry[:, 2])
    odometry_stamps = [o.stamp for o in data.odometry]
    wheels = np.stack([np.interp(stamps, odometry_stamps, odometry[:, i]) for i in range(3)], -1)
    return Result(se2.compose(poses, SCANNER), se2.compose(wheels, SCANNER), slam.reflectors())


def track_places(data: Lego) -> Array:
    """Where the camera saw the scanner (n, 2) at the scans' stamps."""
    return at(data.track, np.array([scan.stamp for scan in data.scans]) * 1e-9)


def evaluate(data: Lego, result: Result) -> dict[str, Any]:
    """Errors [m]; the track and the landmarks are each aligned, rigidly and with a scale.

    The scales say how much larger the camera's and the arena's metre are than the laser's.
    ``position_rmse_as_camera_m`` is what remains where the camera has a metre of its own and
    follows a point of its own on the robot, ``camera_point_m`` ahead of the scanner and to its
    left.
    """
    track, points = track_places(data), result.reflectors.points
    nearest = associate(data, result)
    found = nearest >= 0
    position, _ = residual(result.scanner[:, :2], track)
    scaled, track_scale = residual(result.scanner[:, :2], track, scaled=True)
    landmark, _ = residual(points[found], data.landmarks[nearest[found]])
    _, map_scale = residual(points[found], data.landmarks[nearest[found]], scaled=True)
    view = camera_view(result.scanner, track)
    return {
        'cylinders': len(data.landmarks),
        'cylinders_found': len(np.unique(nearest[found])),
        'landmarks_false': int(np.sum(~found)),
        'landmark_rmse_m': round(landmark, 4),
        'position_rmse_m': round(position, 4),
        'position_rmse_with_scale_m': round(scaled, 4),
        'position_rmse_as_camera_m': round(rms(view.seen - track), 4),
        'dead_reckoning_rmse_m': round(residual(result.dead_reckoning[:, :2], track)[0], 4),
        'track_scale': round(track_scale, 4),
        'camera_scale': round(view.scale, 4),
        'camera_point_m': [round(float(v), 4) for v in view.point],
        'arena_scale': round(map_scale, 4),
    }


def evaluate_scale(data: Lego, result: Result) -> dict[str, Any]:
    """How large the camera's track is by the ranges to the true cylinders, and how late it is.

    The filter is used only to associate ranges with cylinders. About ``track_grows_about_m``
    the camera shows the robot's ways too large. ``position_rmse_track_scaled_m`` is what the EKF
    has to a track of the size that the ranges give. The lags are those of the streams' stamps.
    """
    track, ranges = data.track, cylinder_ranges(data, result)
    free = fit_scale(track, data.landmarks, ranges)
    rigid = fit_scale(track, data.landmarks, ranges, rigid=True)
    scans, camera = scan_lag(data, ranges, free.offset), camera_lag(data)
    scaled, _ = residual(result.scanner[:, :2], free.scale * track_places(data))
    return {
        'ranges': free.ranges,
        'track_scale_by_ranges': round(1.0 / free.scale, 4),
        'track_scale_sigma': round(free.sigma / free.scale**2, 4),
        'track_grows_about_m': [round(float(v), 3) for v in free.centre],
        'range_offset_m': round(free.offset, 4),
        'range_rms_m': round(free.rms, 4),
        'range_rms_without_scale_m': round(rigid.rms, 4),
        'position_rmse_track_scaled_m': round(scaled, 4),
        'scan_lag_s': round(SCAN_LAG + scans.seconds, 3),
        'scan_lag_sigma_s': round(scans.sigma, 3),
        'camera_lag_s': round(CAMERA_LAG + camera.seconds, 3),
        'camera_lag_sigma_s': round(camera.sigma, 3),
        'track_scale_by_wheels': round(camera.factor, 4),
    }


def cylinder_ranges(data: Lego, result: Result) -> Ranges:
    """What the scans measured of the true cylinders."""
    params: EkfParameters = from_mapping(PARAMETERS, EkfParameters)
    return ranges_of(data, result.scanner, params.spikes)


@dataclass(frozen=True)
class CameraView:
    """Where the camera would see the robot, ``seen`` (n, 2).

    Its map is ``scale`` times ours, and it follows the ``point`` (2,) [m] of the scanner's frame.
    """

    seen: Array
    scale: float
    point: Array


def camera_view(scanner: Array, track: Array) -> CameraView:
    """The similarity and the point on the robot that fit a camera's track (n, 2) best.

    In complex numbers, track = a p + b e^(i theta) + c: a similarity commutes with the robot's
    rotation, so the point is b / a, and all is linear.
    """
    p = scanner[:, 0] + 1j * scanner[:, 1]
    columns = np.stack([p, np.exp(1j * scanner[:, 2]), np.ones(len(p))], -1)
    q = track[:, 0] + 1j * track[:, 1]
    a, b, c = np.linalg.lstsq(columns, q, rcond=None)[0]
    seen = columns @ np.array([a, b, c])
    point = b / a
    return CameraView(
        np.stack([seen.real, seen.imag], -1), float(abs(a)), np.array([point.real, point.imag])
    )


def rms(errors: Array) -> float:
    """Root of the mean squared length of errors (n, 2)."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def associate(data: Lego, result: Result) -> np.ndarray[Any, np.dtype[np.int64]]:
    """(k,): the cylinder that each landmark is, -1 for none, by the alignment of the track."""
    T = se2.align(result.scanner[:, :2], track_places(data))
    gap = np.linalg.norm(
        se2.transform(T, result.reflectors.points)[:, None] - data.landmarks[None], axis=-1
    )
    return np.where(gap.min(axis=1) < NEAR, gap.argmin(axis=1), -1)


def residual(points: Array, targets: Array, scaled: bool = False) -> tuple[float, float]:
    """RMSE [m] after the best rigid alignment (or similarity), and the scale."""
    T = se2.align(points, targets)
    p = se2.transform(T, points) - targets.mean(axis=0)
    q = targets - targets.mean(axis=0)
    scale = float((p * q).sum() / (p * p).sum()) if scaled else 1.0
    e = scale * p - q
    return rms(e), scale


def picture(data: Lego, result: Result) -> bytes:
    """Truth, dead reckoning, EKF and its landmarks with 95 % ellipses, in the arena.

    Each as far as a rigid alignment brings it; on the left to the camera's track as it is, on the
    right to the track of the size that the ranges to the true cylinders give.
    """
    # matplotlib takes half a second to import, which other commands need not wait for
    from matplotlib.figure import Figure

    from rlml_slam.report.pictures import LIVE, PATH, REFLECTOR, TRUTH, ellipse, png

    track = track_places(data)
    free = fit_scale(data.track, data.landmarks, cylinder_ranges(data, result))
    corrected = free.centre + free.scale * (track - free.centre)
    figure = Figure(figsize=(13, 7), layout='constrained')
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    smaller = f'/ {1.0 / free.scale:.3f}'
    for axes, title, true in zip(panels, ('as it is', smaller), (track, corrected), strict=True):
        for poses, colour, name in (
            (result.dead_reckoning, LIVE, 'dead reckoning'),
            (result.scanner, PATH, 'EKF'),
        ):
            xy = se2.transform(se2.align(poses[:, :2], true), poses[:, :2])
            axes.plot(*xy.T, color=colour, lw=1.2, label=name)
        axes.plot(*true.T, color=TRUTH, lw=1.2, ls='--', label='camera track')
        error = residual(result.scanner[:, :2], true)[0]
        axes.set(title=f'camera track {title}: EKF {100 * error:.1f} cm RMSE')
    nearest = associate(data, result)
    found = nearest >= 0
    T = se2.align(result.reflectors.points[found], data.landmarks[nearest[found]])
    R = se2.rotation(T[2])
    points = se2.transform(T, result.reflectors.points)
    for axes in panels:
        axes.plot(*data.landmarks.T, 'o', mfc='none', color=TRUTH, ms=12, label='cylinders')
        axes.plot(*points.T, '+', color=REFLECTOR, label='landmarks, 95 %')
        for point, cov in zip(points, result.reflectors.cov, strict=True):
            patch = ellipse(point, R @ cov @ R.T)
            patch.set(fill=False, edgecolor=REFLECTOR)
            axes.add_patch(patch)
        axes.set(aspect='equal', xlabel='x [m]')
        axes.legend(
            fontsize=8, loc='upper center', bbox_to_anchor=(0.5, -0.09), ncols=5, frameon=False
        )
    panels[0].set(ylabel='y [m]')
    return png(figure)
