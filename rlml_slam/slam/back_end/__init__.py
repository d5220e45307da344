# SPDX-License-Identifier: Apache-2.0
"""The graph of keyframes and reflectors."""
