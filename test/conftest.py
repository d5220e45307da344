# SPDX-License-Identifier: Apache-2.0
"""Puts test/ on the import path, so that every test finds differences.py."""
