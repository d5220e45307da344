# SPDX-License-Identifier: Apache-2.0
"""``study fuzz-files``: mutated files of every format that is read.

A file is read or refused with an RlmlError; anything else is a crash. No file may take more than
seconds or hundreds of megabytes. Contents of containers are changed as well, with checksums that
fit, and so are bombs: small files that unpack to large ones.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rlml_lab.contact.file_mutation import mutated_bytes, mutated_content
from rlml_lab.contact.formats import Format, formats
from rlml_slam.errors import RlmlError
from rlml_slam.maps import map_container

SLOW = 5.0  # [s] that no file of some kilobytes may take
ROOM_FOR = 2.0  # [GB] of address space that reading may add
IN_MEMORY = Path('/dev/shm')  # opening a file on a disk takes longer than reading most of them


@dataclass
class Outcome:
    """What became of the mutated files of one format."""

    tried: int = 0
    refused: int = 0
    crashed: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0  # [s]
    grown: float = 0.0  # [MB] of the largest memory


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml-lab study fuzz-files``."""
    parser = subparsers.add_parser('fuzz-files', help='mutated files of every format that is read')
    parser.add_argument('--mutations', type=int, default=100_000, help='per format, at most')
    parser.add_argument('--seconds', type=float, default=60.0, help='per format, at most')
    parser.add_argument('--only', nargs='*', default=[], help='names of formats')
    parser.add_argument('--seed', type=int, default=0)


def run(args: argparse.Namespace) -> int:
    """A row for each format; 1 where one crashed, or took too long or too much."""
    bad = 0
    print('format             tried  refused  crashes  slowest [ms]  memory [MB]')
    place = IN_MEMORY if IN_MEMORY.is_dir() else None
    with tempfile.TemporaryDirectory(prefix='rlml_fuzz_', dir=place) as folder:
        for one in formats(Path(folder)):
            if args.only and one.name not in args.only:
                continue
            found = fuzz(one, Path(folder), args.mutations, args.seconds, args.seed)
            crashes = found.crashed.total()
            print(
                f'{one.name:15}{found.tried:9}{found.refused:9}{crashes:9}'
                f'{1e3 * found.slowest:14.1f}{found.grown:13.1f}', flush=True,
            )  # fmt: skip
            for text, n in found.crashed.most_common(10):
                print(f'  {n} x {text}')
            bad += crashes + (found.slowest > SLOW)
    return int(bad > 0)


def fuzz(one: Format, folder: Path, most: int, seconds: float, seed: int) -> Outcome:
    """Read mutated files of one format until there were ``most``, or the time [s] is over."""
    rng, found = np.random.default_rng(seed), Outcome()
    path = folder / 'mutated' / one.name
    path.parent.mkdir(exist_ok=True)
    before, began = _memory(), time.monotonic()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + int(ROOM_FOR * 1e9), limits[1]))
    try:
        while found.tried < most:
            if time.monotonic() - began > seconds:
                break
            path.write_bytes(_mutated(one, rng))
            _read(one, path, found)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    found.grown = _memory() - before
    return found


def _mutated(one: Format, rng: np.random.Generator) -> bytes:
    if not one.contents:
        return mutated_bytes(one.data, rng, one.is_text)
    which = int(rng.integers(len(one.contents)))
    return b''.join(
        part
        for k, content in enumerate(one.contents)
        for part in map_container.pack(mutated_content(content, rng) if k == which else content)
    )


def _read(one: Format, path: Path, found: Outcome) -> None:
    began = time.process_time()  # not of others on this machine
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            one.read(path)
    except RlmlError:
        found.refused += 1
    except Exception as e:
        where = traceback.extract_tb(e.__traceback__)[-1]
        text = f'{type(e).__name__}: {str(e)[:80]} ({Path(where.filename).name}:{where.lineno})'
        found.crashed[text] += 1
    found.tried += 1
    found.slowest = max(found.slowest, time.process_time() - began)


def _memory() -> float:
    """Largest resident size so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _address_space() -> int:
    """Bytes of address space of this process."""
    pages = Path('/proc/self/statm').read_text(encoding='ascii').split()[0]
    return int(pages) * resource.getpagesize()
