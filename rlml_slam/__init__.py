# SPDX-License-Identifier: Apache-2.0
"""2D localization and SLAM with retro-reflective markers and a 2D laser."""

__version__ = '0.1.0'
