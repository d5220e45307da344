# SPDX-License-Identifier: Apache-2.0
"""Studies: each command answers one question."""
