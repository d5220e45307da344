# SPDX-License-Identifier: Apache-2.0
"""``python -m rlml_slam`` is the command ``rlml``."""

import sys

from rlml_slam.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
