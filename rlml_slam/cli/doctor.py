# SPDX-License-Identifier: Apache-2.0
"""``rlml doctor``: the scans of a bag in figures, and a threshold for its reflectors."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rlml_slam.cli.support.doctor_evidence import KEPT, Evidence
from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import BagError, InputError
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.params import DetectorParameters, from_mapping, read_yaml
from rlml_slam.ros.bags.bag import BagReader, choose_topics
from rlml_slam.ros.codecs import decode
from rlml_slam.se2 import Array
from rlml_slam.sensing.reflectors.background_intensity import VENDOR_BIT
from rlml_slam.sensing.reflectors.reflector_calibration import calibrated
from rlml_slam.sensing.reflectors.reflector_detector import detect, threshold
from rlml_slam.sensing.reflectors.scan_reflectors import in_words
from rlml_slam.sensing.synchronization.synchronizer import invalid_geometry
from rlml_slam.types import Scan

MOST_SCANS = 500  # looked at, spread over the bag
QUANTILES = (0.05, 0.5, 0.95, 0.999)
DECAYS = np.concatenate([[0.0], np.geomspace(0.005, 2.0, 60)])  # [1/m] tried for the curve
WELL_SEEN = 5.0  # beams on a spot whose width counts
FEW = 10  # bright spots that an octave needs for an estimate of the brightness of reflectors


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml doctor``."""
    parser = subparsers.add_parser(
        'doctor',
        help='what the scans of a bag are like, and a threshold for its reflectors',
        description='Looks for reflectors with the automatic threshold, and says in words what '
        'it sees and which parameters of reflector_detector fit.',
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='with scans that have intensities')
    parser.add_argument('--topic', default='', metavar='NAME', help='of the scans')
    parser.add_argument('--config', type=Path, metavar='YAML', help="the detector's parameters")
    parser.add_argument('--out', type=Path, metavar='PNG', help='picture to be written')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Look at the bag, print what is seen and draw it."""
    values = {
        **(read_yaml(args.config, DetectorParameters) if args.config else {}),
        'detector.threshold': 'automatic',
    }
    given: DetectorParameters = from_mapping(values, DetectorParameters)
    evidence = gather(args.bag, args.topic, given, args.json, learns=args.config is None)
    figures = examine(evidence)
    if args.out is not None:
        from rlml_slam.cli.support.doctor_picture import picture

        write_atomically(args.out, picture(evidence, figures))
    print(json.dumps(figures) if args.json else '\n'.join(words(figures)))
    return 0


def gather(
    path: Path, topic: str, given: DetectorParameters, quiet: bool, learns: bool = True
) -> Evidence:
    """The scans of a bag, spread over it, and what the automatic threshold finds in them.

    With ``learns``, size and threshold are those that the scans show, as far as they do.
    """
    seen = scans_of(path, topic, given, quiet)
    bright = [s for s in seen if len(s.intensities) == len(s.ranges) and len(s.ranges)]
    detector, floor, found_by = given.detector, None, ''
    if learns:
        calibration = calibrated(bright, detector)
        if calibration is not None:
            detector, floor = calibration.detector, calibration.floor
            found_by = in_words(calibration)
    counts: list[int] = []
    beams, levels, spots, widths, is_spot = [], [], [], [], []
    for scan in bright:
        found = detect(scan, detector, floor)
        level = threshold(scan, detector)
        counts.append(len(found))
        on = _on_spots(scan, found.beams, found.widths, np.hypot(*found.points.T))
        with np.errstate(invalid='ignore'):
            valid = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
        valid &= np.isfinite(scan.intensities)
        beams.append(np.stack([scan.ranges, scan.intensities], -1)[valid])
        is_spot.append(on[valid])
        levels.append(level[valid] / detector.contrast)
        r = np.hypot(found.points[:, 0], found.points[:, 1])
        spots.append(np.stack([r, found.intensities], -1))
        widths.append(found.widths)
    return Evidence(
        seen[-1], np.array(counts, dtype=np.float64),
        np.concatenate([*beams, np.zeros((0, 2))]).astype(np.float64),
        np.concatenate([*is_spot, np.zeros(0, dtype=bool)]),
        np.concatenate([*levels, np.zeros(0)]),
        np.concatenate([*spots, np.zeros((0, 2))]), np.concatenate([*widths, np.zeros(0)]),
        found_by,
    )  # fmt: skip


def scans_of(path: Path, topic: str, given: DetectorParameters, quiet: bool) -> list[Scan]:
    """At most MOST_SCANS of the scans of a bag, spread over it."""
    seen, error = list[Scan](), ''
    with BagReader(path) as bag:
        name = topic or choose_topics(bag.topics, given.node, ('imu', 'odom')).get('scan', '')
        if name not in bag.topics or 'LaserScan' not in bag.topics[name].msgtype:
            raise BagError(f'{path}: no LaserScan topic {name or given.node.scan_topic!r}')
        total = bag.count([name])
        stride = max(1, math.ceil(total / MOST_SCANS))
        with Progress('scans', total, quiet) as progress:
            for k, (_, _, message) in enumerate(bag.messages([name])):
                if k % stride:
                    continue
                try:
                    scan = decode.scan(message, name)
                    error = invalid_geometry(scan)
                except InputError as e:
                    error = str(e)
                if not error:
                    seen.append(scan)
                progress.update(k + 1, '')
    if not seen:
        raise BagError(f'{path}: {name} has no scan that can be used{error and ": "}{error}')
    return seen


def _on_spots(scan: Scan, middles: Array, widths: Array, ranges: Array) -> NDArray[np.bool_]:
    """Which beams (n,) lie on the spots, or a beam beside them."""
    n = len(scan.ranges)
    on = np.zeros(n, dtype=bool)
    half = 0.5 * widths / (np.maximum(ranges, 1e-3) * abs(scan.angle_increment)) + 1.0
    for middle, reach in zip(middles, half, strict=True):
        on[np.arange(int(middle - reach), int(middle + reach) + 2) % n] = True
    return on


def examine(e: Evidence) -> dict[str, Any]:
    """The figures: the sensor, its intensities, its reflectors, and the parameters proposed."""
    s = e.scan
    figures: dict[str, Any] = {
        'scans': len(e.counts),
        'beams': len(s.ranges),
        'step_deg': abs(math.degrees(s.angle_increment)),
        'frame': s.frame_id,
        'has_intensities': bool(len(e.counts)),
    }
    if not len(e.beams):
        return figures
    bright = e.beams[:, 1]
    marked = float(np.mean(bright >= VENDOR_BIT))
    if len(e.spots) and np.median(e.spots[:, 1]) < VENDOR_BIT:
        marked = 0.0  # a few of them are merely as bright
    values = len(np.unique(bright[:KEPT]))
    figures |= {
        'intensity_quantiles': {f'{q:g}': float(np.quantile(bright, q)) for q in QUANTILES},
        'intensity_max': float(bright.max()),
        'intensity_values': values,
        'vendor_bit_share': marked,
        'reflectors_mean': float(e.counts.mean()),
        'reflectors_min': int(e.counts.min()),
        'reflectors_max': int(e.counts.max()),
        'found_by': e.found_by,
    }
    if marked > 0.0:
        figures['proposed'] = {'detector.threshold': 'bit'}
        return figures
    if len(e.spots):
        # a width is measured where several beams hit
        measured = e.widths > WELL_SEEN * e.spots[:, 0] * abs(s.angle_increment)
        figures['width_median_m'] = (
            float(np.median(e.widths[measured])) if measured.any() else None
        )
        figures['brightness_of_reflectors'] = float(np.median(e.spots[:, 1]))
        figures['range_of_reflectors_m'] = [float(v) for v in np.quantile(e.spots[:, 0], [0, 1])]
        a, k, floor, margin = propose(e)
        figures['margin'] = margin if math.isfinite(margin) else None
        figures['proposed'] = {
            'detector.threshold': 'curve', 'detector.curve_gain': a, 'detector.curve_decay': k,
            'detector.intensity_floor': floor,
        }  # fmt: skip
    return figures


def propose(e: Evidence) -> tuple[float, float, float, float]:
    """a, k and floor of a threshold halfway, in ratio, between reflectors and all else.

    Per octave of range: reflectors by the lowest tenth of their brightest beams, all else by the
    automatic threshold over its contrast. The fourth is the smallest ratio of the two, infinite
    where all else has no intensity.
    """
    r, others = e.beams[~e.is_spot, 0], e.levels[~e.is_spot]
    octave, of_spot = np.floor(np.log2(np.maximum(r, 1e-3))), np.floor(np.log2(e.spots[:, 0]))
    at, middle, ratios, alone = [], [], [], []
    for o in np.unique(octave):
        here, there = others[octave == o], e.spots[of_spot == o]
        low = float(np.median(here))
        if len(there) < min(FEW, len(e.spots)):
            alone += [(float(np.median(r[octave == o])), low)] if low > 0.0 else []
            continue
        high = float(np.quantile(there[:, 1], 0.1))
        at.append(float(np.median(there[:, 0])))
        middle.append(math.sqrt(low * high) if low > 0.0 else 0.5 * high)
        ratios.append(high / low if low > 0.0 else math.inf)
    least = min(ratios, default=math.nan)
    if math.isinf(least):  # any threshold below them will do
        return 0.0, 0.0, round(0.5 * float(e.spots[:, 1].min()), 1), math.inf
    if math.isfinite(least):  # where there is no reflector, as far above the rest as elsewhere
        at += [x for x, _ in alone]
        middle += [low * math.sqrt(least) for _, low in alone]
    if not at:
        at = [float(np.median(e.spots[:, 0]))]
        middle = [0.5 * float(np.quantile(e.spots[:, 1], 0.1))]
        ratios = [math.nan]
    x, y = np.array(at), np.array(middle)
    best: tuple[float, float, float, float] | None = None
    for k in DECAYS:
        # relative errors count: rows are divided by what they are to meet
        A = np.stack([np.exp(-k * x), np.ones_like(x)], -1) / y[:, None]
        weights, error = nnls(A, np.ones_like(y))
        if best is None or error < best[0] - 1e-9:
            best = (float(error), float(weights[0]), float(k), float(weights[1]))
    assert best is not None
    a, k, floor = best[1:]
    if k == 0.0:
        a, floor = 0.0, a + floor
    return round(a, 1), round(k, 4), round(floor, 1), float(min(ratios))


def words(f: dict[str, Any]) -> list[str]:
    """What is seen, in sentences."""
    out = [f'{f["scans"]} scans of {f["beams"]} beams, one every {f["step_deg"]:.3g} degrees.']
    if not f['has_intensities']:
        return [
            f'{f["beams"]} beams, one every {f["step_deg"]:.3g} degrees.',
            'The scans have no intensities: reflectors cannot be detected. Switch them on in the '
            "laser's driver.",
        ]
    if 'intensity_quantiles' not in f:
        return [*out, 'No beam came back.']
    q = f['intensity_quantiles']
    out.append(
        f'Intensities go up to {f["intensity_max"]:g}; half of all beams have less than '
        f'{q["0.5"]:g}, 19 of 20 less than {q["0.95"]:g}.'
    )
    if f['vendor_bit_share'] > 0.0:
        out.append(
            f'{f["vendor_bit_share"]:.2%} of the beams carry the mark of reflectors that some '
            'vendors set (65534 and more).'
        )
    elif f['intensity_values'] <= 2:
        out.append('All intensities are equal: reflectors cannot be detected by them.')
    if f['reflectors_mean'] == 0.0:
        out.append('No reflector is seen: nothing is bright enough and of the right shape.')
    else:
        out.append(
            f'{f["reflectors_mean"]:.1f} reflectors are seen per scan ({f["reflectors_min"]} to '
            f'{f["reflectors_max"]}).'
        )
    if f['found_by']:
        out.append(f'They are {f["found_by"]}.')
    if 'width_median_m' in f:
        near, far = f['range_of_reflectors_m']
        width = f['width_median_m']
        look = f' and look {1e3 * width:.0f} mm wide' if width else ''
        out.append(
            f'They stand {near:.1f} to {far:.1f} m away{look}; set detector.diameter or '
            'detector.flat_width to what they measure.'
        )
        if f['margin'] is None:
            out.append('All else has no intensity.')
        elif f['margin'] < 2.0:
            out.append(
                f'They are only {f["margin"]:.1f} times as bright as the rest: expect mistakes.'
            )
        else:
            out.append(f'They are at least {f["margin"]:.1f} times as bright as the rest.')
    if 'proposed' in f:
        found = f['found_by'] and f['reflectors_mean'] > 0.0
        out.append(
            'Nothing has to be set: slam and replay find them as they are. For a node '
            'reflector_detector of its own:' if found else 'To be set:'
        )  # fmt: skip
    for name, value in f.get('proposed', {}).items():
        out.append(f'  {name}: {value}')
    return out
