# SPDX-License-Identifier: Apache-2.0
"""``rlml map merge``: the saved maps of many sessions become the map of one site."""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rlml_slam import warm_up
from rlml_slam.cli.main import between
from rlml_slam.cli.support.usage import usage
from rlml_slam.errors import ClusterError
from rlml_slam.maps import map_container, survey
from rlml_slam.params import Parameters, from_mapping, read_yaml
from rlml_slam.slam.merging.map_merging import merge_files
from rlml_slam.slam.merging.site_tree import Mapper, in_this_process

CONNECT_S = 30.0  # [s] within which a scheduler has to answer


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml map merge``."""
    parser = subparsers.add_parser(
        'merge',
        help='saved maps of many sessions as one',
        description='Places each map by a survey, the constellation of its reflectors or its '
        'scans, ties what several have seen, and solves the whole graph. A map that fits in '
        'several places or in none is left out, with the reason.',
    )
    parser.add_argument(
        'maps', metavar='MAP', type=Path, nargs='+', help='map.rlml; the first frame is kept'
    )
    parser.add_argument('--out', metavar='SITE', type=Path, required=True, help='the map of all')
    parser.add_argument('--survey', metavar='FILE', type=Path, help='.csv, .json or SICK .imk')
    parser.add_argument('--config', metavar='YAML', type=Path, help='ROS parameter file')
    parser.add_argument(
        '--jobs', metavar='N', type=number_of_jobs, default=1,
        help='worker processes, 0 for one per core; 1: this process (default)',
    )  # fmt: skip
    parser.add_argument('--cluster', metavar='tcp://HOST:PORT', help='scheduler of Dask')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def number_of_jobs(text: str) -> int:
    """The ``type`` of --jobs."""
    return int(between(0, 256)(text))


def run(args: argparse.Namespace) -> int:
    """Merge, save, and say what came of it."""
    params = from_mapping(read_yaml(args.config)) if args.config else Parameters()
    surveyed = survey.load(args.survey) if args.survey else None
    warm_up.compile_loaded()
    with mapper(args.cluster, args.jobs) as workers:
        merged, placed = merge_files(args.maps, params, surveyed, workers)
    map_container.write(args.out, merged.content)
    figures = {
        'sessions': [
            {'map': s.name, 'T_map_session': T.tolist(), 'why': placed.why[s.name]}
            for s, T in zip(placed.site.sessions, merged.poses, strict=True)
        ],
        'left_out': {name: doubt.why for name, doubt in placed.left_out.items()},
        'id': merged.content.description['id'],
        'in_survey_frame': placed.is_in_survey_frame,
        'keyframes': len(merged.back_end.keyframes),
        'reflectors': len(merged.back_end.reflector_graph.keys()),
        'reflectors_joined': merged.joined,
        'closures_between': merged.closures,
        'peak_rss_mb': peak_mb(),
    }
    print(json.dumps(figures) if args.json else text(figures, args.out))
    return 0


def peak_mb() -> float | None:
    """Largest memory of this process so far [MB], without that of workers; None if unknown.

    Linux counts the memory of who started a process in ``ru_maxrss``, but not here.
    """
    used = usage(os.getpid(), 0.0)
    return None if used is None else round(used.peak_rss_mb, 1)


@contextmanager
def mapper(cluster: str | None, jobs: int) -> Iterator[Mapper]:
    """What runs a function over many arguments: this process, worker processes, or Dask's.

    Raises ClusterError where there is no scheduler, or no package to reach it.
    """
    if cluster is not None:
        try:
            from distributed import Client

            client = Client(cluster, timeout=CONNECT_S)
        except ModuleNotFoundError as e:
            wanted = 'pip install "rlml_slam[fleet]"'
            raise ClusterError(f'a cluster needs the Python package {e.name!r}: {wanted}') from e
        except (OSError, ValueError, TypeError) as e:
            raise ClusterError(f'no scheduler of Dask answers at {cluster}: {e}') from e
        with client:
            yield lambda f, *of: list(client.gather(client.map(f, *of, pure=False)))
    elif jobs == 1:
        yield in_this_process
    else:
        with ProcessPoolExecutor(jobs or None, get_context('spawn')) as pool:
            yield lambda f, *of: list(pool.map(f, *of))


def text(f: dict[str, Any], out: Path) -> str:
    """The figures for people."""
    lines = []
    for session in f['sessions']:
        x, y, theta = session['T_map_session']
        place = f'x = {x:.3f} m, y = {y:.3f} m, {math.degrees(theta):.2f}°'
        lines.append(f'{session["map"]}: {place}: {session["why"]}')
    lines += [f'{name}: LEFT OUT: {why}' for name, why in f['left_out'].items()]
    lines += [
        f'{f["reflectors_joined"]} reflectors in both of two sessions, '
        f'{f["closures_between"]} loop closures between sessions',
        f'{out}: map {f["id"]} of {len(f["sessions"])} sessions, {len(f["left_out"])} left out, '
        f'{f["keyframes"]} keyframes, {f["reflectors"]} reflectors',
    ]
    return '\n'.join(lines)
