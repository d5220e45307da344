# SPDX-License-Identifier: Apache-2.0
"""The viewer: a map and plots over time with one cursor, of a report or of running nodes."""
