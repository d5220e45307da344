# SPDX-License-Identifier: Apache-2.0
"""What the commands on a fleet share: bags, parameters, cluster."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rlml_slam.errors import ParameterError
from rlml_slam.params import read_yaml
from rlml_slam.recordings.bag_replay import SYSTEMS


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add them to a parser."""
    parser.add_argument(
        'bags', metavar='BAG', nargs='+',
        help='bags, folders of bags, globs, or URLs of fsspec such as s3://BUCKET/FOLDER',
    )  # fmt: skip
    parser.add_argument('--out', metavar='DIR', required=True, help='folder or URL of the results')
    parser.add_argument(
        '--config', metavar='YAML', type=Path, action='append', default=[],
        help='ROS parameter file; of several, the later ones win',
    )  # fmt: skip
    parser.add_argument(
        '--system', choices=sorted(SYSTEMS), default='rlml', help='default: %(default)s'
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')
    add_cluster(parser)


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Who works: processes of this machine, or a cluster."""
    who = parser.add_mutually_exclusive_group()
    who.add_argument(
        '--jobs', metavar='N', type=int, default=0, help='processes (default: one per core)'
    )
    who.add_argument(
        '--cluster', metavar='URL', help='scheduler of Dask, such as tcp://HOST:8786'
    )  # fmt: skip


def values_of(args: argparse.Namespace) -> dict[str, Any]:
    """The parameters of the files. ParameterError where --jobs is no number of processes."""
    if not 0 <= args.jobs <= 10_000:
        raise ParameterError('--jobs must be 0 (one per core) or more')
    values: dict[str, Any] = {}
    for path in args.config:
        values |= read_yaml(path, SYSTEMS[args.system][0])
    return values
