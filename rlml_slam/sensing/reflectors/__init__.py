# SPDX-License-Identifier: Apache-2.0
"""Reflectors detected in the intensities of a scan."""
