# SPDX-License-Identifier: Apache-2.0
"""ROS interfaces of the other executables."""
