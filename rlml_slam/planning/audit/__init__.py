# SPDX-License-Identifier: Apache-2.0
"""Compares a run with the plan of its layout: which reflectors are not as planned, and why."""
