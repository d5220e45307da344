# SPDX-License-Identifier: Apache-2.0
"""Loop closures: candidates, matching, verification, monitoring."""
