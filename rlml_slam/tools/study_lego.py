# SPDX-License-Identifier: Apache-2.0
"""``rlml study lego``: spikes and EKF on the LEGO robot among cylinders, the note's own task."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam import se2
from rlml_slam.ekf.slam import EkfSlam
from rlml_slam.maps.atomic import write_atomically
from rlml_slam.params import EkfParameters, from_mapping, read_yaml
from rlml_slam.se2 import Array
from rlml_slam.tools.convert_lego import LASER_FRAME, T_BASE_LASER, Lego, read_lego
from rlml_slam.tools.lego_scale import ScaleFit, fit_scale, ranges_of
from rlml_slam.types import Odometry, Reflectors, Scan

# what the robot and its laser are like; the offset, which holds the cylinder's radius and an error
# of this laser, makes the mapped cylinders as far apart as the true ones
PARAMETERS: dict[str, Any] = {
    'ekf.extractor': 'spikes',
    'ekf.sightings': 6,
    'ekf.min_separation': 0.35,
    'spikes.threshold': 0.1,
    'spikes.offset': 0.115,
    'spikes.round': False,
    'spikes.max_width': 0.15,
    'spikes.max_range': 2.0,
    'spikes.min_beams': 3,
    'spikes.sigma_range': 0.05,
    'spikes.sigma_bearing': 0.05,
    'motion.a': 0.1,
    'motion.b': 0.01,
    'motion.c': 0.5,
    'motion.d': 0.2,
    'motion.interval': 0.2,
    'transform_timeout': 1.0,
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
    """Declare ``rlml study lego``."""
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
    figures = judge(data, result) | judge_scale(data, result)
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
    ahead, doubt = 100 * f['camera_point_by_ranges_m'][0], 100 * f['camera_point_sigma_m'][0]
    rms, before = 100 * f['range_rms_m'], 100 * f['range_rms_without_scale_m']
    lines = [
        f'position RMSE against the camera track after rigid alignment, aim {100 * AIM:.0f} cm:',
        f'  the track as it is               {_verdict(f["position_rmse_m"])}',
        f'  the track {scale:.3f} times smaller    {_verdict(f["position_rmse_track_scaled_m"])}',
        f'  ... and of a point {ahead:.1f} cm ahead  '
        f'{_verdict(f["position_rmse_track_corrected_m"])}',
        f'{f["ranges"]} ranges to the true cylinders, without wheels and places of the filter,',
        f'say that the track is {scale:.3f} +- {sigma:.3f} times too large and of a point',
        f'{ahead:.1f} +- {doubt:.1f} cm ahead of the laser. They fit the true map to',
        f'{before:.1f} cm with the track as it is, to {rms:.1f} cm with it corrected. A camera',
        'calibrated to the floor, H above it, shows what is h above it H/(H-h) too large.',
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
    odometry = np.array([o.pose for o in data.odometry])
    return Result(
        se2.compose(slam.trajectory()[1], SCANNER),
        se2.compose(odometry, SCANNER),
        slam.reflectors(),
    )


def judge(data: Lego, result: Result) -> dict[str, Any]:
    """Errors [m]; the track and the landmarks are each aligned, rigidly and with a scale.

    The scales tell how much larger the camera's and the arena's metre are than the laser's.
    ``position_rmse_as_camera_m`` is what remains where the camera has a metre of its own and
    follows a point of its own on the robot, ``camera_point_m`` ahead of the scanner and to its
    left.
    """
    track, points = data.track.poses[:, :2], result.reflectors.points
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


def judge_scale(data: Lego, result: Result) -> dict[str, Any]:
    """How large the camera's track is by the ranges to the true cylinders, and of what point.

    The filter tells which range is of which cylinder and where the robot heads, and no more.
    ``position_rmse_by_ranges_m`` is what the places that fit the ranges best have to the track,
    ``position_rmse_track_scaled_m`` and ``position_rmse_track_corrected_m`` what the EKF has to a
    track of the size that they tell, and to those places.
    """
    track, scanner = data.track.poses[:, :2], result.scanner[:, :2]
    free, rigid = range_fit(data, result), range_fit(data, result, rigid=True)
    return {
        'ranges': free.ranges,
        'track_scale_by_ranges': round(1.0 / free.scale, 4),
        'track_scale_sigma': round(free.sigma / free.scale**2, 4),
        'camera_point_by_ranges_m': [round(float(v), 4) for v in free.point],
        'camera_point_sigma_m': [round(float(v), 4) for v in free.point_sigma],
        'range_offset_m': round(free.offset, 4),
        'range_rms_m': round(free.rms, 4),
        'range_rms_without_scale_m': round(rigid.rms, 4),
        'position_rmse_track_scaled_m': round(residual(scanner, free.scale * track)[0], 4),
        'position_rmse_track_corrected_m': round(residual(scanner, free.places)[0], 4),
        'position_rmse_by_ranges_m': round(residual(free.places, track)[0], 4),
    }


def range_fit(data: Lego, result: Result, rigid: bool = False) -> ScaleFit:
    """The track fitted to the ranges to the true cylinders, or ``rigid``, as it is."""
    params: EkfParameters = from_mapping(PARAMETERS, EkfParameters)
    ranges = ranges_of(data, result.scanner, params.spikes)
    track = data.track.poses[:, :2]
    headings = result.scanner[:, 2] + se2.align(result.scanner[:, :2], track)[2]
    return fit_scale(track, data.landmarks, ranges, rigid, None if rigid else headings)


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
    T = se2.align(result.scanner[:, :2], data.track.poses[:, :2])
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
    right to the places of the laser that the ranges to the true cylinders make of it.
    """
    # matplotlib takes half a second to import, which other commands need not wait for
    from matplotlib.figure import Figure

    from rlml_slam.tools.pictures import LIVE, PATH, REFLECTOR, TRUTH, ellipse, png

    track = data.track.poses[:, :2]
    free = range_fit(data, result)
    figure = Figure(figsize=(13, 7), layout='constrained')
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    corrected = f'/ {1.0 / free.scale:.3f}, {100 * free.point[0]:.1f} cm ahead'
    for axes, title, true in zip(
        panels, ('as it is', corrected), (track, free.places), strict=True
    ):
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
