# SPDX-License-Identifier: Apache-2.0
"""Readers of public data sets and their text formats."""
