# SPDX-License-Identifier: Apache-2.0
"""Studies of running nodes, over DDS."""
