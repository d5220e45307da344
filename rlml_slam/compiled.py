# SPDX-License-Identifier: Apache-2.0
"""The one way kernels are compiled: Numba, cached on disk, IEEE arithmetic, GIL released.

No fastmath and no threads inside a kernel, so a replay is bit-identical from run to run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar('F', bound=Callable[..., Any])


def kernel(function: F) -> F:
    """The function, compiled at its first call with each signature and cached on disk."""
    return cast(F, numba.njit(cache=True, error_model='numpy', nogil=True)(function))


def part(function: F) -> F:
    """A kernel that kernels alone call: without an entry from Python it compiles much faster."""
    options: dict[str, Any] = {'no_cpython_wrapper': True, 'no_cfunc_wrapper': True}
    return cast(F, numba.njit(cache=True, error_model='numpy', nogil=True, **options)(function))
