# SPDX-License-Identifier: Apache-2.0
"""Poses, landmarks and factors, and the normal equations that they make."""
