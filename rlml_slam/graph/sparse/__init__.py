# SPDX-License-Identifier: Apache-2.0
"""Sparse block Cholesky factorization: ordering, symbolic analysis, fronts."""
