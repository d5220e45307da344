# SPDX-License-Identifier: Apache-2.0
"""The study of messages that nobody should send."""
