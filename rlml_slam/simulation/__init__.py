# SPDX-License-Identifier: Apache-2.0
"""Synthetic worlds, robots and sensors."""
