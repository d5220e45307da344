# SPDX-License-Identifier: Apache-2.0
"""``rlml map``: saved maps."""
