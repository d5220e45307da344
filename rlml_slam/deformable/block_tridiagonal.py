# SPDX-License-Identifier: Apache-2.0
"""Cholesky factor and solution of a symmetric block-tridiagonal matrix.

``diagonal`` (N, n, n) holds A_ii and ``below`` (N-1, n, n) holds A_{i+1,i}. Cost N n^3 instead
of (N n)^3. Everything works in place, so that a batch needs its memory once.
"""

from __future__ import annotations

import math

from rlml_slam.compiled import kernel
from rlml_slam.se2 import Array


@kernel
def cholesky(A: Array) -> bool:
    """A <- its lower factor, zeros above; False where A is not positive definite."""
    n = len(A)
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                A[i, j] -= A[i, k] * A[j, k]
        if not A[j, j] > 0.0:
            return False
        root = math.sqrt(A[j, j])
        for i in range(j, n):
            A[i, j] /= root
        for i in range(j):
            A[i, j] = 0.0
    return True


@kernel
def solve_lower(L: Array, b: Array) -> None:
    """B <- L^-1 b for b (n,)."""
    for i in range(len(b)):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@kernel
def solve_upper(L: Array, b: Array) -> None:
    """B <- L^-T b for b (n,)."""
    for i in range(len(b) - 1, -1, -1):
        for k in range(i + 1, len(b)):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@kernel
def factorize(diagonal: Array, below: Array) -> bool:
    """A = L L^T: diagonal <- L_ii, below <- L_{i+1,i} = A_{i+1,i} L_ii^-T."""
    for i in range(len(diagonal)):
        if not cholesky(diagonal[i]):
            return False
        if i + 1 < len(diagonal):
            for r in range(len(below[i])):
                solve_lower(diagonal[i], below[i, r])
            diagonal[i + 1] -= below[i] @ below[i].T
    return True


@kernel
def solve(diagonal: Array, below: Array, b: Array) -> None:
    """B <- A^-1 b for b (N, n), after factorize."""
    N = len(diagonal)
    for i in range(N):
        if i > 0:
            b[i] -= below[i - 1] @ b[i - 1]
        solve_lower(diagonal[i], b[i])
    for i in range(N - 1, -1, -1):
        if i + 1 < N:
            b[i] -= below[i].T @ b[i + 1]
        solve_upper(diagonal[i], b[i])
