# SPDX-License-Identifier: Apache-2.0
"""Where the buffers of a graph lie, in one array, and those buffers again in a kernel.

A kernel of some hundred microseconds waits longer for what Python and Numba do about some twenty
arrays, after other work has displaced it from the caches, than it takes to optimise a small graph.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlml_slam.compiled import array_at, intrinsic, part
from rlml_slam.graph.model.packed_system import Factors, Tables
from rlml_slam.graph.sparse.symbolic_analysis import Ints
from rlml_slam.se2 import Array


class Buffers(NamedTuple):
    """Address and length of each of the ``buffers``, as rows of ``at`` (k, 2).

    The addresses hold as long as this keeps the buffers.
    """

    at: Ints
    buffers: tuple[NDArray[Any], ...]


def buffers_of(buffers: tuple[NDArray[Any], ...], last: Buffers | None = None) -> Buffers:
    """The places of contiguous arrays, each the first rows of its base.

    Only those are looked up that have another base than in ``last``, which are few where a graph
    grows: it takes longer than to have a kernel take the array.
    """
    at = np.zeros((len(buffers), 2), np.int64) if last is None else last.at.copy()
    for k, buffer in enumerate(buffers):
        if last is not None and buffer is last.buffers[k]:
            continue
        base: Any = buffer.base
        if last is None or base is not last.buffers[k].base:
            at[k, 0] = ctypes.addressof(ctypes.c_char.from_buffer(base))
        at[k, 1] = len(buffer)
    return Buffers(at, buffers)


def _to_pointer(_typing: Any, address: Any) -> Any:
    """Typing and code of pointer: an address is taken for one."""
    from numba import types
    from numba.core import cgutils

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], cgutils.voidptr_t)

    return types.voidptr(address), generate


_pointer: Any = intrinsic(_to_pointer)


@part
def nodes_at(at: Ints) -> tuple[Array, Array]:
    """Poses (n, 3) and landmarks (m, 2) of a graph with its buffers ``at`` (Graph.addresses)."""
    poses = array_at(_pointer(at[0, 0]), (at[0, 1], 3), np.float64)
    landmarks = array_at(_pointer(at[1, 0]), (at[1, 1], 2), np.float64)
    return poses, landmarks


@part
def tables_at(at: Ints, losses: Array) -> Tables:
    """The tables of a graph with its buffers ``at``, as Graph.tables."""
    return Tables(
        array_at(_pointer(at[2, 0]), (at[2, 1],), np.bool_),
        array_at(_pointer(at[3, 0]), (at[3, 1],), np.bool_),
        _factors_at(at[4:9], 2, 3), _factors_at(at[9:14], 2, 2),
        _factors_at(at[14:19], 1, 3), _factors_at(at[19:24], 1, 2), losses,
    )  # fmt: skip


@part
def _factors_at(at: Ints, nodes: int, size: int) -> Factors:
    k = at[0, 1]
    return Factors(
        array_at(_pointer(at[0, 0]), (k, nodes), np.int64),
        array_at(_pointer(at[1, 0]), (k, size), np.float64),
        array_at(_pointer(at[2, 0]), (k, size, size), np.float64),
        array_at(_pointer(at[3, 0]), (k,), np.int64),
        array_at(_pointer(at[4, 0]), (k,), np.bool_),
    )
