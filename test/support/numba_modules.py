# SPDX-License-Identifier: Apache-2.0
"""Modules whose parts of kernels a test can call from a kernel of its own."""

import importlib
import os
import sys
from unittest import mock

from rlml_slam.kernels.library import BY_USER


def compiled_by_numba(*names):
    """The modules, imported once more beside those that have their kernels from the library."""
    kept = {n: sys.modules.pop(n) for n in list(sys.modules) if n.split('.')[0] == 'rlml_slam'}
    with mock.patch.dict(os.environ, {BY_USER: 'jit'}):
        made = [importlib.import_module(f'rlml_slam.graph.sparse.{name}') for name in names]
    for name in [n for n in sys.modules if n.split('.')[0] == 'rlml_slam']:
        del sys.modules[name]
    sys.modules.update(kept)
    return made
