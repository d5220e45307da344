# SPDX-License-Identifier: Apache-2.0
"""The pose of every scan by odometry, reflectors and submaps."""
