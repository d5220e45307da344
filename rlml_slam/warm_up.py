# SPDX-License-Identifier: Apache-2.0
"""Compiles all kernels, so that no first scan has to wait for the compiler.

A module with kernels has a function ``warm_up()`` that calls each with every signature in use.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

OTHER_SYSTEMS = ('deformable', 'ekf')  # compiled when they are first used
# tiers without kernels
OUTER = ('ros', 'nodes', 'cli', 'datasets', 'evaluation', 'recordings', 'report')


def core_modules() -> Iterator[str]:
    """Names of all modules of the core."""
    for module in pkgutil.walk_packages([str(Path(__file__).parent)], 'rlml_slam.'):
        if module.name.split('.')[1] not in OUTER:
            yield module.name


def import_core(also_others: bool = True) -> None:
    """Import every module of the core; without ``also_others``, those of the main job alone."""
    for name in core_modules():
        if also_others or name.split('.')[1] not in OTHER_SYSTEMS:
            importlib.import_module(name)


def loaded() -> list[tuple[str, Callable[[], None]]]:
    """(module, its warm_up) of every module imported so far that has kernels."""
    names = sorted(n for n in sys.modules if n.startswith('rlml_slam.') and n != __name__)
    return [
        (n, sys.modules[n].warm_up) for n in names if callable(vars(sys.modules[n]).get('warm_up'))
    ]


def compile_loaded(note: Callable[[str], None] = lambda text: None) -> None:
    """Compile the kernels of every module imported so far; quick if they are cached on disk.

    Where there is no library of them, ``note`` is called before each module with what is done.
    """
    modules = loaded()
    for k, (_, warm_up) in enumerate(modules):
        if not has_library():
            note(f'compiling kernels, {k} of {len(modules)} modules; `rlml warm-up` keeps them')
        warm_up()


def has_library() -> bool:
    """Whether the kernels come from a library: then nothing is compiled."""
    compiled = sys.modules.get('rlml_slam.compiled')
    return compiled is not None and compiled.LIBRARY is not None
