# SPDX-License-Identifier: Apache-2.0
"""Speed and quality against other libraries."""
