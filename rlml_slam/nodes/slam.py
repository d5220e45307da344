# SPDX-License-Identifier: Apache-2.0
"""Executable ``slam``: front end and back end in one process, for small robots."""

from __future__ import annotations

import sys

from rlml_slam.nodes.back_end import BackEndNode
from rlml_slam.nodes.front_end import FrontEndNode
from rlml_slam.ros.run import run


def main() -> int:
    """Run both nodes."""
    return run(FrontEndNode, BackEndNode)


if __name__ == '__main__':
    sys.exit(main())
