# SPDX-License-Identifier: Apache-2.0
"""The deformable-feature system: model, EKF, NLS and active control."""
