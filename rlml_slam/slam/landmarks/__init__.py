# SPDX-License-Identifier: Apache-2.0
"""Reflectors of the graph: birth, association, persistence, survey."""
