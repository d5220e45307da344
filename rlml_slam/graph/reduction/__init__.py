# SPDX-License-Identifier: Apache-2.0
"""Bounded growth: marginalization and edge pruning."""
