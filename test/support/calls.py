# SPDX-License-Identifier: Apache-2.0
"""Work counted in calls of functions: the same number on every machine, however busy it is."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


def count_calls(function: Callable[[], Any]) -> int:
    """Calls of functions, those written in C too, that this thread makes in ``function``."""
    count, before = 0, sys.getprofile()

    def on_event(frame: Any, event: str, argument: Any) -> None:
        nonlocal count
        count += event in ('call', 'c_call')

    sys.setprofile(on_event)
    try:
        function()
    finally:
        sys.setprofile(before)
    return count
