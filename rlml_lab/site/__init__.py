# SPDX-License-Identifier: Apache-2.0
"""Many sessions of one large site."""
