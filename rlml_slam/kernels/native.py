# SPDX-License-Identifier: Apache-2.0
"""Decorators of kernels that are in the library: no compiler is loaded."""

from __future__ import annotations

import functools
import inspect
import numbers
import pickle
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from rlml_slam.kernels.library import DECORATOR, Library

F = TypeVar('F', bound=Callable[..., Any])

# Calls whose arguments had to be converted, by kernel: each costs some microseconds more.
CONVERTED: Counter[str] = Counter()


def kernel_of(library: Library) -> Callable[[F], F]:
    """Decorator: the function as the library has it."""

    def kernel(function: F) -> F:
        name = f'{function.__module__}.{function.__name__}'
        native: Any = library.module.Kernel(
            _Conversion(function, library.module, library.index.entries.get(name, []))
        )
        return cast(F, functools.update_wrapper(native, function))

    return kernel


def _within_kernels(decorator: str) -> Callable[[F], F]:
    """Of what kernels alone call: it is built into them, and called from Python as it is."""

    def mark(function: F) -> F:
        setattr(function, DECORATOR, decorator)
        return function

    return mark


part = _within_kernels('part')
formula = _within_kernels('formula')
intrinsic = _within_kernels('intrinsic')


def _for_kernels(name: str) -> Callable[..., Any]:
    """What is a function within kernels only."""

    def function(*_args: Any) -> Any:
        raise TypeError(f'{name} is for kernels only')

    setattr(function, DECORATOR, name)
    return function


load8, fetch, array_at = map(_for_kernels, ('load8', 'fetch', 'array_at'))


class _Conversion:
    """What a kernel calls whose arguments are not of the types that it was compiled for.

    Numba would compile it once more; here they are converted: a view becomes a contiguous array,
    and what the kernel writes into it is copied back. TypeError where nothing fits. A kernel that
    the library lacks, of another package, is compiled by Numba.
    """

    def __init__(
        self, function: Callable[..., Any], module: Any, entries: list[tuple[bytes, str]]
    ) -> None:
        self.function, self.module, self.entries = function, module, entries
        self.checks: list[Any] = []

    def __call__(self, kernel: Any, args: tuple[Any, ...], kwargs: dict[str, Any] | None) -> Any:
        if not self.checks:
            # at the first call, when the classes of all tuples have been imported
            for pickled, name in self.entries:
                self.checks.append(pickle.loads(pickled))
                kernel.add(self.checks[-1], getattr(self.module, name))
            if self.checks:
                return kernel(*args, **(kwargs or {}))
        if not self.checks:
            from rlml_slam.kernels.missing import compiled

            return compiled(self.function)(*args, **(kwargs or {}))
        if kwargs:
            args = inspect.signature(self.function).bind(*args, **kwargs).args
        name = f'{self.function.__module__}.{self.function.__name__}'
        for check in self.checks:
            copies: list[tuple[Any, Any]] = []
            try:
                converted = _convert(check, args, copies)
            except TypeError as e:
                reason = str(e)
                continue
            CONVERTED[name] += not kwargs
            result = kernel(*converted)
            for original, copy in copies:
                original[...] = copy
            return result
        raise TypeError(f'{name}: {reason}')


def _convert(check: Any, value: Any, copies: list[tuple[Any, Any]]) -> Any:
    """The value as a check of table.c wants it; ``copies``: (array, what is to be copied back)."""
    kind = check[0]
    if kind == 'T':
        _, of, parts = check
        if not isinstance(value, tuple) or len(value) != len(parts):
            raise TypeError(f'a {of.__name__} of {len(parts)} is needed, not {value!r:.60}')
        elements = [_convert(p, v, copies) for p, v in zip(parts, value, strict=True)]
        return tuple(elements) if of is tuple else of(*elements)
    if kind == 'A':
        return _contiguous(check, value, copies)
    if kind == 'n' and value is None:
        return None
    if kind == 'b' and isinstance(value, bool | np.bool_):
        return bool(value)
    if kind == 'i' and isinstance(value, numbers.Integral):
        return int(value)
    if kind == 'f' and isinstance(value, numbers.Real):
        return float(value)
    names = {'f': 'a number', 'i': 'an integer', 'b': 'True or False', 'n': 'None'}
    raise TypeError(f'{names[kind]} is needed, not {value!r:.60}')


def _contiguous(check: Any, value: Any, copies: list[tuple[Any, Any]]) -> Any:
    _, ndim, flags, dtype = check
    if not isinstance(value, np.ndarray) or value.ndim != ndim:
        raise TypeError(f'an array of {ndim} dimensions is needed, not {value!r:.60}')
    if not np.can_cast(value.dtype, dtype, 'same_kind'):
        raise TypeError(f'an array of {dtype} is needed, not of {value.dtype}')
    if type(value) is np.ndarray and value.dtype == dtype and value.flags.num & flags == flags:
        return value
    copy = np.array(value, dtype, order='C', subok=False)
    if value.flags.writeable and value.dtype == dtype:
        copies.append((value, copy))
    return copy
