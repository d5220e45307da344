# SPDX-License-Identifier: Apache-2.0
"""The one way kernels are compiled: IEEE arithmetic, the same code from either compiler.

No fastmath and no threads inside a kernel, so a replay is bit-identical from run to run. An
installed package has them in a library, and its processes need no compiler: they start in a
second and keep 200 MB less. Where there is none of these sources, Numba compiles a kernel at its
first call and caches it on disk.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rlml_slam.kernels.library import open_library

LIBRARY = open_library(Path(__file__).parent)  # None: Numba compiles
if TYPE_CHECKING or LIBRARY is None:
    from rlml_slam.kernels.jit import (
        array_at,
        brief,
        fetch,
        formula,
        intrinsic,
        kernel,
        load8,
        part,
    )
else:
    from rlml_slam.kernels.native import (
        array_at,
        fetch,
        formula,
        intrinsic,
        kernel_of,
        load8,
        part,
    )

    kernel = brief = kernel_of(LIBRARY)

__all__ = [
    'LIBRARY', 'array_at', 'brief', 'fetch', 'formula', 'intrinsic', 'kernel', 'load8', 'part',
]  # fmt: skip
