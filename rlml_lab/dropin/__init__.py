# SPDX-License-Identifier: Apache-2.0
"""Studies of a robot that has nav2, AMCL and robot_localization, and of bags as robots record."""
