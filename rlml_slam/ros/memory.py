# SPDX-License-Identifier: Apache-2.0
"""Gives memory back that is free: glibc keeps it where anything behind it is still in use.

A map is drawn from arrays of many megabytes that live for a moment, and between them keyframes and
factors are made that stay; so the gaps add up over hours, though nothing holds them.
"""

from __future__ import annotations

import ctypes
import sys

# As mallopt() names them, and to what they are set. glibc raises both, to 32 and 64 MB, with every
# large array that is given back; then such arrays come from the heap, which small things that stay
# tear into pieces: 20 MB an hour in a hall where nothing is new.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
LARGE, SPARE = 1 << 18, 1 << 20  # [bytes] of an array; free at the end of the heap


def _glibc() -> ctypes.CDLL | None:
    """The C library, None where it is another one."""
    if not sys.platform.startswith('linux'):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, 'malloc_trim') else None


_GLIBC = _glibc()


def give_back() -> None:
    """Let the system have all whole pages that nothing is in; takes some milliseconds."""
    if _GLIBC is not None:
        _GLIBC.malloc_trim(0)


def keep_large_apart() -> None:
    """From now on, let the system have each large array back as soon as it is let go of."""
    if _GLIBC is not None:
        _GLIBC.mallopt(M_MMAP_THRESHOLD, LARGE)
        _GLIBC.mallopt(M_TRIM_THRESHOLD, SPARE)
