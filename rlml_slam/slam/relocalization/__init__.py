# SPDX-License-Identifier: Apache-2.0
"""Where a lost robot is in a map."""
