# SPDX-License-Identifier: Apache-2.0
"""Batch solvers, initial guesses and marginal covariances."""
