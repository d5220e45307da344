# SPDX-License-Identifier: Apache-2.0
"""Factor tables: growing columns, appended to in amortised O(1), read as views of the buffer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlml_slam.compiled import brief
from rlml_slam.errors import SolverError
from rlml_slam.graph.model.factors import COUNTED, FactorKind
from rlml_slam.graph.model.packed_system import Factors
from rlml_slam.se2 import Array


class Column:
    """A growing array ``(n, *shape)``; ``view`` is writable and valid until the next append."""

    def __init__(self, shape: tuple[int, ...], dtype: Any = np.float64) -> None:
        self._buffer = np.zeros((16, *shape), dtype=dtype)
        self.view: NDArray[Any] = self._buffer[:0]

    def __len__(self) -> int:
        return len(self.view)

    def __getstate__(self) -> NDArray[Any]:
        """The rows: copied each on its own, the view would no longer be one of the buffer."""
        return self.view

    def __setstate__(self, rows: NDArray[Any]) -> None:
        self._buffer = np.zeros((max(16, len(rows)), *rows.shape[1:]), dtype=rows.dtype)
        self.view = self._buffer[: len(rows)]
        self.view[:] = rows

    def read_only(self) -> NDArray[Any]:
        """The rows so far, not to be written to."""
        view = self.view[:]
        view.flags.writeable = False
        return view

    def append(self, rows: NDArray[Any]) -> None:
        """Add ``rows`` (k, *shape); doubles the buffer when it is full."""
        first, size = len(self.view), len(self.view) + len(rows)
        if size > len(self._buffer):
            grown = np.zeros((max(size, 2 * len(self._buffer)), *self._buffer.shape[1:]),
                             dtype=self._buffer.dtype)  # fmt: skip
            grown[:first] = self.view
            self._buffer = grown
        self._buffer[first:size] = rows
        self.view = self._buffer[:size]

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Remove the other rows, and shrink the buffer to twice what is left."""
        rows = self.view[kept]
        self._buffer = np.zeros((max(16, 2 * len(rows)), *rows.shape[1:]), dtype=rows.dtype)
        self.view = self._buffer[: len(rows)]
        self.view[:] = rows


class FactorTable:
    """Factors of one form: nodes (n, a), measured (n, d), information (n, d, d), kinds, enabled.

    A table is for the nodes that its factors join: ``node_names``, for messages ('pose',
    'landmark'). Kinds have no information on the residuals that are not COUNTED.
    """

    def __init__(self, node_names: tuple[str, ...], dimension: int) -> None:
        self.node_names = node_names
        self.dimension = dimension
        self._nodes = Column((len(node_names),), np.int64)
        self._measured = Column((dimension,))
        self._information = Column((dimension, dimension))
        self._kinds = Column((), np.int64)
        self._enabled = Column((), np.bool_)
        # in the order of Factors
        self.columns = (
            self._nodes, self._measured, self._information, self._kinds, self._enabled,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def nodes(self) -> NDArray[np.int64]:
        """Indices of the poses and landmarks of each factor; read only."""
        return self._nodes.read_only()

    @property
    def measured(self) -> Array:
        """Measured values, read only."""
        return self._measured.read_only()

    @property
    def information(self) -> Array:
        """Information matrices, read only."""
        return self._information.read_only()

    @property
    def kinds(self) -> NDArray[np.int64]:
        """FactorKind of each factor, read only."""
        return self._kinds.read_only()

    @property
    def enabled(self) -> NDArray[np.bool_]:
        """Whether each factor takes part; writable."""
        return self._enabled.view

    def factors(self) -> Factors:
        """The buffers themselves, as the kernels take them."""
        return Factors(
            self._nodes.view, self._measured.view, self._information.view, self._kinds.view,
            self._enabled.view,
        )  # fmt: skip

    def keep(self, kept: NDArray[np.bool_], new: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
        """Remove the other factors; the new index of each one (n,), -1 if removed.

        ``new`` has the new indices of the nodes, per column.
        """
        for column in self.columns:
            column.keep(kept)
        for k, indices in enumerate(new):
            self._nodes.view[:, k] = indices[self._nodes.view[:, k]]
        return renumbered(kept)

    def describe(self, index: int) -> str:
        """Like 'factor 17 (closure, pose 3 to pose 9)', for messages."""
        return self._describe(index, self.nodes[index], int(self.kinds[index]))

    def _describe(self, index: int, nodes: NDArray[np.int64], code: int) -> str:
        kind = FactorKind(code).name.lower().replace('_', ' ')
        ends = ' to '.join(f'{n} {i}' for n, i in zip(self.node_names, nodes, strict=True))
        return f'factor {index} ({kind}, {ends})'

    def append(
        self,
        kinds: FactorKind | Sequence[FactorKind],
        nodes: ArrayLike,
        measured: ArrayLike,
        information: ArrayLike,
        sizes: tuple[int, ...],
    ) -> NDArray[np.int64]:
        """Add factors (k, a), (k, d), (k, d, d) and return their indices.

        ``sizes`` are the numbers of existing nodes per column. Raises SolverError, naming the
        factor, on an unknown node, a value that is not finite or an information matrix that is
        not symmetric positive definite; then nothing is added.
        """
        d = self.dimension
        nodes = np.asarray(nodes, dtype=np.int64).reshape(-1, len(self.node_names))
        k = len(nodes)
        codes = np.broadcast_to(np.asarray(kinds, dtype=np.int64), (k,))
        try:
            measured = np.asarray(measured, dtype=np.float64).reshape(k, d)
            information = np.asarray(information, dtype=np.float64).reshape(k, d, d)
        except ValueError as error:
            raise SolverError(f'{k} factors between {self.node_names}: {error}') from None
        self._validate(codes, nodes, measured, information, sizes)
        first = len(self)
        self._nodes.append(nodes)
        self._measured.append(measured)
        self._information.append(0.5 * (information + np.swapaxes(information, 1, 2)))
        self._kinds.append(codes)
        self._enabled.append(np.ones(k, dtype=np.bool_))
        return np.arange(first, first + k)

    def _validate(
        self,
        codes: NDArray[np.int64],
        nodes: NDArray[np.int64],
        measured: Array,
        information: Array,
        sizes: tuple[int, ...],
    ) -> None:
        known = np.greater_equal(nodes, 0) & np.less(nodes, np.asarray(sizes))
        nonfinite = np.logical_not(np.isfinite(measured).all(-1, keepdims=True))[:, 0]
        same = np.zeros(len(nodes), dtype=np.bool_)
        if self.node_names == ('pose', 'pose'):
            same = nodes[:, 0] == nodes[:, 1]
        # there is no information on residuals that do not count: any will do for the test
        unused = ~COUNTED[codes, : self.dimension]
        filled = information + unused[:, :, None] * np.eye(self.dimension)
        regular = is_positive_definite(filled)
        bad = ~known.all(-1) | nonfinite | ~regular | same
        if not bad.any():
            return
        i = int(np.argmax(bad))
        where = self._describe(len(self) + i, nodes[i], int(codes[i]))
        if not known[i].all():
            raise SolverError(f'{where}: unknown node; there are {sizes} of {self.node_names}')
        if same[i]:
            raise SolverError(f'{where}: both ends are the same node')
        if nonfinite[i]:
            raise SolverError(f'{where}: measured value {measured[i].tolist()} is not finite')
        raise SolverError(
            f'{where}: information {information[i].tolist()} is not symmetric positive definite'
        )


def renumbered(kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """New index of each of the kept ones, -1 for those removed (n,)."""
    return np.where(kept, np.cumsum(kept) - 1, -1)


@brief
def is_positive_definite(matrices: Array) -> NDArray[np.bool_]:
    """Per matrix ``(k, d, d)``, d <= 3: finite, symmetric to 1e-6 and all leading minors > 0."""
    d = matrices.shape[1]
    out = np.zeros(len(matrices), dtype=np.bool_)
    c = np.zeros((3, 3))
    for k in range(len(matrices)):
        M = matrices[k]
        scale, asymmetry, good = 0.0, 0.0, True
        for i in range(d):
            good = good and M[i, i] > 0.0
            for j in range(d):
                good = good and math.isfinite(M[i, j])
                scale = max(scale, abs(M[i, j]))
                asymmetry = max(asymmetry, abs(M[i, j] - M[j, i]))
        if not good or asymmetry > 1e-6 * scale:
            continue
        # scaled to a unit diagonal: units of metres and radians may lie far apart
        for i in range(d):
            for j in range(d):
                c[i, j] = M[i, j] / (math.sqrt(M[i, i]) * math.sqrt(M[j, j]))
        if d >= 2:
            good = 1.0 - c[0, 1] ** 2 > 1e-12
        if d == 3:
            minor = 1.0 + 2.0 * c[0, 1] * c[0, 2] * c[1, 2]
            good = good and minor - c[0, 1] ** 2 - c[0, 2] ** 2 - c[1, 2] ** 2 > 1e-12
        out[k] = good
    return out
