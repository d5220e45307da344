# SPDX-License-Identifier: Apache-2.0
"""What only a replay does: the conversation executed at once, batch association."""
