# SPDX-License-Identifier: Apache-2.0
"""Errors of a run against truth, relations or a survey."""
