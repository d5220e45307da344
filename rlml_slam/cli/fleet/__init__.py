# SPDX-License-Identifier: Apache-2.0
"""``rlml fleet …``."""
