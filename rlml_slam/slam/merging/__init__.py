# SPDX-License-Identifier: Apache-2.0
"""Maps of many sessions become the map of one site."""
