# SPDX-License-Identifier: Apache-2.0
"""The RLML system: front end, back end, and what joins them."""
