# SPDX-License-Identifier: Apache-2.0
"""Decorators of kernels that Numba compiles when they are first called, and keeps on disk.

Those on disk that were compiled from other sources go when the package is first used.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import register_jitable
from numba.np.numpy_support import carray

from rlml_slam.kernels.cache import remove_stale

F = TypeVar('F', bound=Callable[..., Any])


PACKAGE = Path(__file__).parents[1]
# set by the process that makes the library: what is on disk lacks what it needs
CACHE = 'RLML_SLAM_NO_CACHE' not in os.environ
OPTIONS: dict[str, Any] = {'cache': CACHE, 'error_model': 'numpy', 'no_cfunc_wrapper': True}
KERNELS: dict[str, Any] = {}  # by module and name, those that are called from Python

if CACHE:
    remove_stale(PACKAGE)


def kernel(function: F) -> F:
    """The function, compiled at its first call with each signature and cached on disk."""
    return cast(F, _called(numba.njit(nogil=True, **OPTIONS)(function)))


def brief(function: F) -> F:
    """A kernel of some microseconds, which keeps the GIL.

    One that lets go of it waits to get it back, for as long as another thread is in Python.
    """
    return cast(F, _called(numba.njit(**OPTIONS)(function)))


def _called(dispatcher: Any) -> Any:
    KERNELS[f'{dispatcher.__module__}.{dispatcher.__name__}'] = dispatcher
    return dispatcher


def part(function: F) -> F:
    """A kernel that kernels alone call: without an entry from Python it compiles much faster."""
    options: dict[str, Any] = {'no_cpython_wrapper': True, **OPTIONS}
    return cast(F, numba.njit(nogil=True, **options)(function))


def formula(function: F) -> F:
    """An expression of numbers that kernels inline; called from Python, NumPy evaluates it.

    So that an equation is written once: kernels call it with scalars, batched code with arrays.
    """
    inlined: F = register_jitable(forceinline=True, error_model='numpy')(function)
    return inlined


def _load_word(_typing: Any, array: Any, _at: Any) -> Any:
    """Typing and code of load8: one load that need not be aligned."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        word = context.get_value_type(signature.return_type)
        place = builder.bitcast(builder.gep(data, [args[1]]), word.as_pointer())
        return builder.load(place, align=1)

    return numba.uint64(array, numba.int64), generate


# load8(bytes, at): the eight bytes of a contiguous uint8 array from ``at`` on as one word, the
# first one lowest (little-endian); for kernels only, and not checked
load8: Any = numba_intrinsic(_load_word)


def _fetch_line(_typing: Any, array: Any, _at: Any, _offset: Any) -> Any:
    """Typing and code of fetch: a hint to the processor."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        hint = builder.module.declare_intrinsic('llvm.prefetch', [byte], kind)
        place = builder.bitcast(builder.gep(data, [args[1]]), byte)
        # to be read, to be kept near, data
        builder.call(hint, [builder.gep(place, [args[2]]), flag(0), flag(3), flag(1)])
        return context.get_dummy_value()

    return numba.void(array, numba.int64, numba.int64), generate


# fetch(array, at, offset): bring near the line of memory that holds the byte ``offset`` of an
# element, which is needed soon; for kernels only
fetch: Any = numba_intrinsic(_fetch_line)


# intrinsic(function): code that a kernel has in the place of a call
intrinsic: Any = numba_intrinsic
# array_at(pointer, shape, dtype): the array of that address, for kernels only
array_at: Any = carray
