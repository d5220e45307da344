# SPDX-License-Identifier: Apache-2.0
"""Batched factors and the sparse solver of pose-landmark graphs."""
