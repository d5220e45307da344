# SPDX-License-Identifier: Apache-2.0
"""Incremental least squares over a growing graph."""
