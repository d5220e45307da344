# SPDX-License-Identifier: Apache-2.0
"""Scan matching: probability grids, correlative search, registration."""
