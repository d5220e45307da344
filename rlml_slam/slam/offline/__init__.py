# SPDX-License-Identifier: Apache-2.0
"""What only a replay does: the back end in a process of its own, batch association."""
