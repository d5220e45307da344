# SPDX-License-Identifier: Apache-2.0
"""A scan becomes points and detections with covariances."""
