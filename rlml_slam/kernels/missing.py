# SPDX-License-Identifier: Apache-2.0
"""Kernels that the library lacks, as those of another package: compiled when first called."""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any

from rlml_slam.kernels import jit, library

_COMPILED: dict[Callable[..., Any], Any] = {}  # by function


def compiled(function: Callable[..., Any], decorator: str = 'kernel') -> Any:
    """The function as Numba compiles it, with all kernels and parts that it calls."""
    if function not in _COMPILED:
        _COMPILED[function] = getattr(jit, decorator)(_with_compiled(function))
    return _COMPILED[function]


def _with_compiled(function: Callable[..., Any]) -> Any:
    """A copy whose globals are what Numba understands."""
    of: Any = function
    known = dict(of.__globals__)
    for name in of.__code__.co_names:
        if name in known:
            known[name] = _callee(known[name])
    copy = types.FunctionType(of.__code__, known, of.__name__, of.__defaults__, of.__closure__)
    copy.__module__, copy.__kwdefaults__ = of.__module__, of.__kwdefaults__
    copy.__qualname__, copy.__doc__ = of.__qualname__, of.__doc__
    return copy


def _callee(value: Any) -> Any:
    """What stands for a global in compiled code."""
    if type(value).__name__ == 'Kernel' and hasattr(value, '__wrapped__'):
        return compiled(value.__wrapped__)
    decorator = getattr(value, library.DECORATOR, None)
    if decorator in ('part', 'formula'):
        return compiled(value, decorator)
    if decorator == 'intrinsic':
        return _COMPILED.setdefault(value, jit.intrinsic(value))
    return getattr(jit, decorator) if decorator else value
