# SPDX-License-Identifier: Apache-2.0
"""Dense kernels of one front, column-major in flat arrays, lower triangle.

The innermost loops run down four columns at a time over contiguous memory, in the form that LLVM
turns into vector code. On fronts of up to some hundred rows this is faster than a call to BLAS,
has no threads to switch off, and gives the same bits in every process.
"""

from __future__ import annotations

import math

from rlml_slam.compiled import part
from rlml_slam.se2 import Array


@part
def rank_update(
    C: Array, c: int, ldc: int, num: int, A: Array, a: int, lda: int, depth: int, rows: int
) -> None:
    """Columns 0..num of C minus A A^T, where row 0 of both is the diagonal of column 0.

    C starts at ``c`` with stride ``ldc``, A (rows, depth) at ``a`` with ``lda``; ``num`` <= 4
    columns are updated from their diagonal down, ``rows`` >= num. The upper triangle of the num
    by num corner is overwritten with values of no meaning.
    """
    p = 0
    if num == 4:
        C0 = C[c : c + rows]
        C1 = C[c + ldc : c + ldc + rows]
        C2 = C[c + 2 * ldc : c + 2 * ldc + rows]
        C3 = C[c + 3 * ldc : c + 3 * ldc + rows]
        while p + 3 < depth:
            A0 = A[a : a + rows]
            A1 = A[a + lda : a + lda + rows]
            A2 = A[a + 2 * lda : a + 2 * lda + rows]
            A3 = A[a + 3 * lda : a + 3 * lda + rows]
            x0, x1, x2, x3 = A0[0], A1[0], A2[0], A3[0]
            y0, y1, y2, y3 = A0[1], A1[1], A2[1], A3[1]
            z0, z1, z2, z3 = A0[2], A1[2], A2[2], A3[2]
            w0, w1, w2, w3 = A0[3], A1[3], A2[3], A3[3]
            for i in range(rows):
                u0, u1, u2, u3 = A0[i], A1[i], A2[i], A3[i]
                C0[i] -= (x0 * u0 + x1 * u1) + (x2 * u2 + x3 * u3)
                C1[i] -= (y0 * u0 + y1 * u1) + (y2 * u2 + y3 * u3)
                C2[i] -= (z0 * u0 + z1 * u1) + (z2 * u2 + z3 * u3)
                C3[i] -= (w0 * u0 + w1 * u1) + (w2 * u2 + w3 * u3)
            a += 4 * lda
            p += 4
        while p < depth:
            A0 = A[a : a + rows]
            x0, y0, z0, w0 = A0[0], A0[1], A0[2], A0[3]
            for i in range(rows):
                u0 = A0[i]
                C0[i] -= x0 * u0
                C1[i] -= y0 * u0
                C2[i] -= z0 * u0
                C3[i] -= w0 * u0
            a += lda
            p += 1
        return
    for k in range(num):
        C0 = C[c + k * ldc + k : c + k * ldc + rows]
        b = a + k
        p = 0
        while p + 3 < depth:
            A0 = A[b : b + rows - k]
            A1 = A[b + lda : b + lda + rows - k]
            A2 = A[b + 2 * lda : b + 2 * lda + rows - k]
            A3 = A[b + 3 * lda : b + 3 * lda + rows - k]
            x0, x1, x2, x3 = A0[0], A1[0], A2[0], A3[0]
            for i in range(rows - k):
                C0[i] -= (x0 * A0[i] + x1 * A1[i]) + (x2 * A2[i] + x3 * A3[i])
            b += 4 * lda
            p += 4
        while p < depth:
            A0 = A[b : b + rows - k]
            x0 = A0[0]
            for i in range(rows - k):
                C0[i] -= x0 * A0[i]
            b += lda
            p += 1


@part
def partial_cholesky(F: Array, f: int, width: int, height: int, floor: Array) -> bool:
    """Factor the first ``width`` columns of a front in place; False if that is impossible.

    F starts at ``f`` with stride ``height`` and holds ``width`` columns of ``height`` rows. A
    pivot not above ``floor`` (width,) means that the matrix is not positive definite.
    """
    for j in range(0, width, 4):
        num = min(4, width - j)
        at = f + j * height + j
        rows = height - j
        rank_update(F, at, height, num, F, f + j, height, j, rows)
        if not _pivots(F, at, height, num, floor, j):
            return False
        if num == 4:
            _below_four(F, at, height, rows)
        else:
            for k in range(num):
                L0 = F[at + k * height + num : at + k * height + rows]
                for m in range(k):
                    x = F[at + m * height + k]
                    A0 = F[at + m * height + num : at + m * height + rows]
                    for i in range(rows - num):
                        L0[i] -= x * A0[i]
                scale = 1.0 / F[at + k * height + k]
                for i in range(rows - num):
                    L0[i] *= scale
    return True


@part
def _pivots(F: Array, at: int, height: int, num: int, floor: Array, j: int) -> bool:
    """Cholesky factor of the num by num block at ``at``; False if it is not definite."""
    for k in range(num):
        pivot = F[at + k * height + k]
        if not pivot > floor[j + k]:
            return False
        root = math.sqrt(pivot)
        F[at + k * height + k] = root
        scale = 1.0 / root
        for i in range(k + 1, num):
            F[at + k * height + i] *= scale
        for m in range(k + 1, num):
            x = F[at + k * height + m]
            for i in range(m, num):
                F[at + m * height + i] -= x * F[at + k * height + i]
    return True


@part
def _below_four(F: Array, at: int, height: int, rows: int) -> None:
    """Rows below a factored four by four block: X becomes X L^-T, in one pass."""
    r0, r1 = 1.0 / F[at], 1.0 / F[at + height + 1]
    r2, r3 = 1.0 / F[at + 2 * height + 2], 1.0 / F[at + 3 * height + 3]
    l10, l20, l30 = F[at + 1], F[at + 2], F[at + 3]
    l21, l31, l32 = F[at + height + 2], F[at + height + 3], F[at + 2 * height + 3]
    X0 = F[at + 4 : at + rows]
    X1 = F[at + height + 4 : at + height + rows]
    X2 = F[at + 2 * height + 4 : at + 2 * height + rows]
    X3 = F[at + 3 * height + 4 : at + 3 * height + rows]
    for i in range(rows - 4):
        x0 = X0[i] * r0
        x1 = (X1[i] - l10 * x0) * r1
        x2 = (X2[i] - l20 * x0 - l21 * x1) * r2
        X3[i] = (X3[i] - l30 * x0 - l31 * x1 - l32 * x2) * r3
        X0[i] = x0
        X1[i] = x1
        X2[i] = x2


@part
def schur_update(F: Array, f: int, width: int, height: int, U: Array, u: int) -> None:
    """U = -L21 L21^T for the rows below ``width`` of a factored front."""
    size = height - width
    for j in range(0, size, 4):
        num = min(4, size - j)
        at = u + j * size + j
        for k in range(num):
            for i in range(at + k * size, at + k * size + size - j):
                U[i] = 0.0
        rank_update(U, at, size, num, F, f + width + j, height, width, size - j)
