# SPDX-License-Identifier: Apache-2.0
"""Maps as files: save and load."""
