# SPDX-License-Identifier: Apache-2.0
"""Submaps, scan matching, association and constellations."""
