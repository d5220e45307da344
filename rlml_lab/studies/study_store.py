# SPDX-License-Identifier: Apache-2.0
"""``study store``: whether a map file survives being cut off, flipped and killed while saved.

A child process saves one version of a map after the other and is killed at a random moment. What
is read then must be one of the versions, whole, and so must the one before. Files that are cut
off or have a bit flipped must be refused, and the one before named. A cut of the power, which
also loses what the system has not written yet, is not tried.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import FileFormatError, MapError, ParameterError
from rlml_slam.maps import map_container
from rlml_slam.maps.atomic_file import PREVIOUS
from rlml_slam.maps.map_container import Content

SAVED = 3  # versions that a child saves before it may be killed, at most
SIDE = 400  # cells of the grid: a save takes some milliseconds
WHOLE, OLDER, LOST, WRONG, CRASHED = 'whole', 'older', 'lost', 'wrong', 'crashed'
BAD = [f'{p}{what}' for p in ('', 'previous ') for what in (LOST, WRONG, CRASHED)]
WRITER = textwrap.dedent("""
    import sys
    from rlml_slam.maps import map_container
    from rlml_lab.studies.study_store import version
    which = int(sys.argv[2])
    while True:
        which += 1
        print(which, flush=True)
        map_container.write(sys.argv[1], version(which))
""")


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study store``."""
    parser = subparsers.add_parser(
        'store',
        help='map files that are cut off, flipped, or killed while saved',
        description='Counts what is read after a SIGKILL during a save, and after cuts and bit '
        'flips. Nothing may be lost, wrong or crash.',
    )
    parser.add_argument('--kills', type=int, default=100, help='default: %(default)s')
    parser.add_argument('--damages', type=int, default=900, help='default: %(default)s')
    parser.add_argument('--seed', type=int, default=0, help='default: %(default)s')
    parser.add_argument('--json', action='store_true', help='print one JSON object and no more')


def run(args: argparse.Namespace) -> int:
    """Kill, damage, count; exit code 1 where anything was lost or wrong."""
    if args.kills < 0 or args.damages < 0:
        raise ParameterError('study store: --kills and --damages must not be negative')
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory() as folder:
        killed = kill(Path(folder) / 'killed.rlml', args.kills, rng, args.json)
        damaged = damage(Path(folder) / 'damaged.rlml', args.damages, rng)
    figures = {'kills': dict(killed), 'damages': dict(damaged)}
    print(json.dumps(figures) if args.json else text(figures))
    return int(any(f.get(bad, 0) for f in figures.values() for bad in BAD))


def version(which: int) -> Content:
    """A map whose every number is that of its version."""
    grid = np.full((SIDE, SIDE), which, dtype=np.int64)
    return Content({'pose': np.full((1000, 3), float(which)), 'grid': grid}, {'version': which})


def kill(path: Path, kills: int, rng: np.random.Generator, quiet: bool = True) -> Counter[str]:
    """What is read after each kill: the newest version or the one before, never anything else."""
    map_container.write(path, version(0))
    map_container.write(path, version(1))
    last, out = 1, Counter[str]()
    with Progress('kills', max(kills, 1), quiet) as progress:
        for k in range(kills):
            newest = _kill_once(path, last, rng)
            found = _classify(path, newest)
            out[found] += 1
            out['previous ' + _classify(path.with_name(path.name + PREVIOUS), newest - 1)] += 1
            if found in (WHOLE, OLDER):
                last = int(map_container.read(path).description['version'])
            progress.update(k + 1, '')
    return out


def _kill_once(path: Path, last: int, rng: np.random.Generator) -> int:
    """Let a child save, and kill it in the middle of a save; the version that it was at."""
    newest = last
    command = [sys.executable, '-c', WRITER, str(path), str(last)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for _ in range(int(rng.integers(1, SAVED + 1))):
            newest = int(child.stdout.readline())
        try:
            child.wait(float(rng.uniform(0.0, 0.02)))
        except subprocess.TimeoutExpired:
            os.kill(child.pid, signal.SIGKILL)
        rest = child.stdout.read().split()
    return int(rest[-1]) if rest else newest


def _classify(path: Path, newest: int) -> str:
    """What a file is, where versions up to ``newest`` were begun to be saved."""
    try:
        content = map_container.read(path)
    except (MapError, FileFormatError):
        return LOST
    except Exception:  # of whatever kind: that is what is looked for
        return CRASHED
    which = content.description['version']
    right = all((array == which).all() for array in content.arrays.values())
    return (WHOLE if which >= newest - 1 else OLDER) if right and which <= newest else WRONG


def damage(path: Path, times: int, rng: np.random.Generator) -> Counter[str]:
    """Whether a file that is cut off or flipped is refused, and the one before is named."""
    map_container.write(path, version(1))
    map_container.write(path, version(2))
    data, out = path.read_bytes(), Counter[str]()
    for k in range(times):
        broken = bytearray(data)
        if k % 2:
            del broken[int(rng.integers(len(data))) :]
        else:
            broken[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        out[_refusal(path)] += 1
    return out


def _refusal(path: Path) -> str:
    try:
        map_container.read(path)
    except FileFormatError as e:
        named = path.name + PREVIOUS in str(e)
        return 'refused' if named and _classify(path.with_name(path.name + PREVIOUS), 1) == WHOLE \
            else LOST  # fmt: skip
    except Exception:  # of whatever kind: that is what is looked for
        return CRASHED
    return WRONG


def text(figures: dict[str, dict[str, int]]) -> str:
    """The counts for people."""
    return '\n'.join(
        f'{sum(n for what, n in counts.items() if not what.startswith("previous"))} {name}: '
        + (', '.join(f'{n} {what}' for what, n in sorted(counts.items())) or 'none')
        for name, counts in figures.items()
    )
