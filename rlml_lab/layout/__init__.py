# SPDX-License-Identifier: Apache-2.0
"""Studies of planned layouts of reflectors."""
