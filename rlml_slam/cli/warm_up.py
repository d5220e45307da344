# SPDX-License-Identifier: Apache-2.0
"""``rlml warm-up``: compile the kernels into the library that every process then loads."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

from rlml_slam.cli.support.progress import Progress
from rlml_slam.errors import InputError
from rlml_slam.kernels import library

PACKAGE = Path(library.__file__).parents[1]
LINE_EVERY = 2.0  # [s]


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml warm-up``."""
    parser = subparsers.add_parser(
        'warm-up',
        help='compile the kernels once, into the package or else for this user',
        description='Compiles the kernels into a library beside the package, or where that is '
        'read-only into ~/.cache/rlml_slam, or copies what was compiled there from the same '
        'sources. An installation does it by itself.',
    )
    parser.add_argument(
        '--into', metavar='DIR', type=Path, help='folder of the package that the library is for'
    )
    parser.add_argument(
        '--processor', choices=[*library.LEVELS, 'generic'],
        help='the code runs on all processors of this level (default: the best that this one has)',
    )  # fmt: skip
    parser.add_argument('--force', action='store_true', help='compile though it was done already')


def run(args: argparse.Namespace) -> int:
    """Compile what is missing."""
    processor = args.processor or library.best_processor()
    into = [args.into] if args.into else list(library.folders(PACKAGE))
    found = next((f for f in into if _is_there(f, args.processor)), None)
    if found is not None and not args.force:
        print(f'{found / library.LIBRARY}: the kernels are compiled')
        return 0
    folder = next((f for f in into if _is_writable(f)), None)
    if folder is None:
        raise InputError(f'{into[0]}: cannot be written to')
    try:
        print(_build(folder, processor, args.force))
    except ImportError as e:
        raise InputError(f'the kernels cannot be compiled: {e}') from e
    return 0


def _build(folder: Path, processor: str, force: bool) -> str:
    """Build with progress, or copy; what was written, and in which time."""
    from rlml_slam.kernels.build import build

    began = time.monotonic()
    with Progress('compiling the kernels', 1.0, every=LINE_EVERY) as bar:
        path = build(
            folder, processor,
            lambda done, of, name: bar.update(
                done / of, f'{time.monotonic() - began:.0f} s {name.removeprefix("rlml_slam.")}'
            ),
            force,
        )  # fmt: skip
    return f'{path}: {path.stat().st_size / 1e6:.1f} MB in {time.monotonic() - began:.0f} s'


def _is_there(folder: Path, processor: str | None) -> bool:
    index = library.read_index(folder)
    return (
        index is not None and processor in (None, index.processor) and library.fits(index, PACKAGE)
    )


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
