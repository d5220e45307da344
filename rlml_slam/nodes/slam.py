# SPDX-License-Identifier: Apache-2.0
"""Executable ``slam``: front end and back end in one process, for small robots.

Frames and commands pass from one to the other by reference; they are published for viewers only.
"""

from __future__ import annotations

import sys
from typing import Any

from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.run import run


def connected(front_end: FrontEndNode, **options: Any) -> BackEndNode:
    """A back end for a front end that was made with ``has_back_end``."""
    back_end = BackEndNode(front_end.command, **options)
    front_end.take = back_end.take

    def problems() -> tuple[str, ...]:
        active = back_end.is_active
        return back_end.mapper.entry_problems() if active else ('back_end is not active',)

    front_end.back_end_problems = problems
    return back_end


def main() -> int:
    """Run both nodes."""
    front_ends: list[FrontEndNode] = []

    def front_end() -> FrontEndNode:
        front_ends.append(FrontEndNode(has_back_end=True))
        return front_ends[0]

    return run(front_end, lambda: connected(front_ends[0]))


if __name__ == '__main__':
    sys.exit(main())
