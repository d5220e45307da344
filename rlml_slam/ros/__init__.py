# SPDX-License-Identifier: Apache-2.0
"""Between ROS and the core: parameters, messages, bags and TF."""
