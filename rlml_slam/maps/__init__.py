# SPDX-License-Identifier: Apache-2.0
"""Reflector map, occupancy grid and the map store."""
