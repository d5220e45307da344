# SPDX-License-Identifier: Apache-2.0
"""Which loop closures to believe: consistency, GNC, noise calibration."""
