# SPDX-License-Identifier: Apache-2.0
"""Faults put into recordings: what they cost, and whether the system says so."""
