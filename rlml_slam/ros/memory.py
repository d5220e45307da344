# SPDX-License-Identifier: Apache-2.0
"""Gives memory back that is free: glibc keeps it where anything behind it is still in use.

A map is drawn from arrays of many megabytes that live for a moment, and between them keyframes and
factors are made that stay; so the gaps add up over hours, though nothing holds them.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable


def _trim() -> Callable[[int], int] | None:
    """malloc_trim() of glibc, None where there is another library."""
    if not sys.platform.startswith('linux'):
        return None
    try:
        trim: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None
    return trim


_TRIM = _trim()


def give_back() -> None:
    """Let the system have all whole pages that nothing is in; takes some milliseconds."""
    if _TRIM is not None:
        _TRIM(0)
