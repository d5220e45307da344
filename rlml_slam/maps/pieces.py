# SPDX-License-Identifier: Apache-2.0
"""A row of numbers that is never in memory as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Pieces:
    """An array (n,) in pieces of ``sizes``, each of which is made when it is written.

    ``np.asarray`` makes all of it.
    """

    def __init__(
        self, dtype: DTypeLike, make: Sequence[Callable[[], NDArray[Any]]], sizes: Sequence[int]
    ) -> None:
        self.dtype, self.shape = np.dtype(dtype), (sum(sizes),)
        self.nbytes = self.shape[0] * self.dtype.itemsize
        self._make = make

    def __len__(self) -> int:
        """How many numbers."""
        return self.shape[0]

    def pieces(self) -> Iterator[NDArray[Any]]:
        """One after the other."""
        return (make() for make in self._make)

    def __array__(
        self, dtype: DTypeLike | None = None, copy: bool | None = None
    ) -> NDArray[Any]:  # fmt: skip
        """All of it."""
        out = np.concatenate([np.zeros(0, self.dtype), *self.pieces()])
        return out if dtype is None else out.astype(dtype)
