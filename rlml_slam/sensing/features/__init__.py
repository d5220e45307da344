# SPDX-License-Identifier: Apache-2.0
"""Landmarks extracted from a scan: spikes and RANSAC lines."""
