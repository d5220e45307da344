# SPDX-License-Identifier: Apache-2.0
"""Association of detections with reflectors, and constellations."""
