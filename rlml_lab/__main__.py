# SPDX-License-Identifier: Apache-2.0
"""``python -m rlml_lab`` is the command ``rlml-lab``."""

import sys

from rlml_lab.main import main

sys.exit(main())
