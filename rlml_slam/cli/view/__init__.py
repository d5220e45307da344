# SPDX-License-Identifier: Apache-2.0
"""``rlml view``: running nodes in a browser."""
