# SPDX-License-Identifier: Apache-2.0
"""What RLML and EKF-SLAM share: health, kidnapping detection, tracks, smoother."""
