# SPDX-License-Identifier: Apache-2.0
"""A simulated carrier with deforming features, as a node and in process."""
