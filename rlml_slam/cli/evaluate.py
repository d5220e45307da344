# SPDX-License-Identifier: Apache-2.0
"""``rlml evaluate``: how wrong a trajectory is."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from math import inf
from typing import Any

from rlml_slam.cli.main import between
from rlml_slam.datasets.tum import read_tum
from rlml_slam.evaluation.ate import trajectory_errors
from rlml_slam.evaluation.relations import read_relations, relation_errors


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml evaluate relations`` and ``rlml evaluate ate``."""
    parser = subparsers.add_parser(
        'evaluate', help='errors of a trajectory against relations or ground truth'
    )
    kinds = parser.add_subparsers(dest='kind', metavar='METRIC', required=True)

    relations = kinds.add_parser(
        'relations', help='against relative poses, metric of Kümmerle et al. 2009'
    )
    relations.add_argument('trajectory', metavar='TRAJ', help='TUM file (also .gz, .xz)')
    relations.add_argument('relations', metavar='RELATIONS', help='t1 t2 x y z roll pitch yaw')
    relations.add_argument(
        '--tolerance', type=between(0.0, inf), default=1e-3, metavar='S',
        help='a pose and a stamp farther apart do not match (default: %(default)s)',
    )  # fmt: skip

    ate = kinds.add_parser('ate', help='absolute error against ground truth')
    ate.add_argument('trajectory', metavar='TRAJ', help='TUM file (also .gz, .xz)')
    ate.add_argument('truth', metavar='TRUTH', help='TUM file (also .gz, .xz)')
    ate.add_argument('--align', action='store_true', help='fit the trajectory to the truth first')
    ate.add_argument(
        '--max-gap', type=between(0.0, inf), default=0.5, metavar='S',
        help='truth is not interpolated over longer gaps (default: %(default)s)',
    )  # fmt: skip
    for p in (relations, ate):
        p.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Evaluate and print."""
    trajectory = read_tum(args.trajectory)
    if args.kind == 'relations':
        relations = read_relations(args.relations)
        figures = relation_errors(trajectory, relations, nanoseconds(args.tolerance)).summary()
        text = _relations_text(figures)
    else:
        truth = read_tum(args.truth)
        errors = trajectory_errors(trajectory, truth, args.align, nanoseconds(args.max_gap))
        figures = errors.summary()
        text = _ate_text(figures, args.align)
    print(json.dumps(figures) if args.json else text)
    return 0


def nanoseconds(seconds: float) -> int:
    """A time [ns]; a century where it has no end."""
    return round(min(seconds, 3e9) * 1e9)


def _relations_text(f: Mapping[str, float]) -> str:
    lines = [
        f'{f["relations"]:.0f} relations, {f["relations_unmatched"]:.0f} without a pose at a stamp'
    ]
    for name, word, unit in (('trans', 'translational', 'm'), ('rot', 'rotational', 'deg')):
        lines.append(
            f'{word:<14} {f[f"{name}_mean_{unit}"]:.4f} ± {f[f"{name}_std_{unit}"]:.4f} {unit}'
            f'   (max {f[f"{name}_max_{unit}"]:.3f} {unit})   squared '
            f'{f[f"{name}_squared_mean_{unit}2"]:.5f} ± '
            f'{f[f"{name}_squared_std_{unit}2"]:.5f} {unit}²'
        )
    return '\n'.join(lines)


def _ate_text(f: Mapping[str, float], aligned: bool) -> str:
    lines = [
        f'{f["matched"]:.0f} poses with truth, {f["unmatched"]:.0f} without'
        f'{", after SE(2) alignment" if aligned else ""}',
        f'position       rmse {f["rmse_m"]:.4f} m   mean {f["mean_m"]:.4f}   '
        f'median {f["median_m"]:.4f}   std {f["std_m"]:.4f}   max {f["max_m"]:.4f}   '
        f'last {f["last_m"]:.4f}',
    ]
    if 'heading_rmse_deg' in f:
        lines.append(f'heading        rmse {f["heading_rmse_deg"]:.4f} deg')
    return '\n'.join(lines)
